// share.glsl - gives every lane of a subgroup the value that lane `turn` has loaded. Needs kShare,
// GL_KHR_shader_subgroup_shuffle.

float shared_by(float x, uint turn) { return kShare > 1u ? subgroupShuffle(x, turn) : x; }
uint shared_by(uint x, uint turn) { return kShare > 1u ? subgroupShuffle(x, turn) : x; }
vec3 shared_by(vec3 x, uint turn) { return vec3(shared_by(x.x, turn), shared_by(x.y, turn), shared_by(x.z, turn)); }
vec4 shared_by(vec4 x, uint turn) { return vec4(shared_by(x.xyz, turn), shared_by(x.w, turn)); }

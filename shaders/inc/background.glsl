// background.glsl - a premultiplied color over the gray that the loss lays it on (LossWeights::background); `p` is the
// pass's SplatPush.
vec3 on_background(vec4 rgba) { return rgba.xyz + p.background * (1.0 - rgba.w); }

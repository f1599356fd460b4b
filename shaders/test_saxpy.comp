// test_saxpy.comp - one invocation per element: y = scale * x + y. A minimal kernel for the tests of the gpu module.
#version 460
layout(local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint count; float scale; };
layout(std430) readonly buffer X { float x[]; };
layout(std430) buffer Y { float y[]; };

void main() {
  uint i = gl_GlobalInvocationID.x + gl_GlobalInvocationID.y * gl_NumWorkGroups.x * gl_WorkGroupSize.x;
  if (i < count) y[i] = scale * x[i] + y[i];
}

// test_add.comp - one invocation per element: to[i] = from[i] + kAdd. It reads one buffer and writes another, so that a
// chain of these passes needs barriers, whose absence synchronization validation detects.
#version 460
layout(local_size_x_id = 0) in;
layout(constant_id = 1) const uint kAdd = 0u;
layout(std430) readonly buffer From { uint from[]; };
layout(std430) writeonly buffer To { uint to[]; };

void main() {
  uint i = gl_GlobalInvocationID.x;
  if (i < from.length()) to[i] = from[i] + kAdd;
}

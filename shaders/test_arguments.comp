// test_arguments.comp - one invocation: writes the group counts of an indirect dispatch for `count` elements in work
// groups of kLanes, at an offset of three words.
#version 460
layout(local_size_x = 1) in;
layout(constant_id = 0) const uint kLanes = 64u;
layout(push_constant) uniform Push { uint count; };
layout(std430) writeonly buffer Arguments { uint arguments[]; };

void main() {
  arguments[3] = (count + kLanes - 1u) / kLanes;
  arguments[4] = 1u;
  arguments[5] = 1u;
}

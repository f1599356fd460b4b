// test_limits.comp - one invocation with sixteen buffers and 128 bytes of push constants, the most that a kernel may
// ask for: out[0] = sum over all buffers and all push words, each weighted with its number.
#version 460
layout(local_size_x = 1) in;
layout(push_constant) uniform Push { uvec4 words[8]; };
layout(std430) buffer Result { uint result[]; };
layout(std430) readonly buffer B1 { uint b1[]; };
layout(std430) readonly buffer B2 { uint b2[]; };
layout(std430) readonly buffer B3 { uint b3[]; };
layout(std430) readonly buffer B4 { uint b4[]; };
layout(std430) readonly buffer B5 { uint b5[]; };
layout(std430) readonly buffer B6 { uint b6[]; };
layout(std430) readonly buffer B7 { uint b7[]; };
layout(std430) readonly buffer B8 { uint b8[]; };
layout(std430) readonly buffer B9 { uint b9[]; };
layout(std430) readonly buffer B10 { uint b10[]; };
layout(std430) readonly buffer B11 { uint b11[]; };
layout(std430) readonly buffer B12 { uint b12[]; };
layout(std430) readonly buffer B13 { uint b13[]; };
layout(std430) readonly buffer B14 { uint b14[]; };
layout(std430) readonly buffer B15 { uint b15[]; };

void main() {
  uint sum = b1[0] + 2u * b2[0] + 3u * b3[0] + 4u * b4[0] + 5u * b5[0] + 6u * b6[0] + 7u * b7[0] + 8u * b8[0] +
             9u * b9[0] + 10u * b10[0] + 11u * b11[0] + 12u * b12[0] + 13u * b13[0] + 14u * b14[0] + 15u * b15[0];
  for (uint i = 0u; i < 32u; ++i) sum += (i + 1u) * words[i / 4u][i % 4u];
  result[0] = sum;
}

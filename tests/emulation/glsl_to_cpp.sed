# glsl_to_cpp.sed - translates the kernels' GLSL to C++ (sed -E), so that the very files of shaders/ run on the host
# (lanes.h, kernels.h). Line numbers are kept. A kernel becomes the body of a class template: variables of file scope are
# its members, specialization constants its arguments. These are substitutions, not a parser: a construct that is not
# listed here does not compile.

# preprocessor; shared headers are C++ already
s/^#(version|extension) .*//
s/^#include "(shared|chainsplat)\/.*//

# interface
s/^layout\(local_size_x = ([0-9]+)\) in;/static constexpr WorkGroupSize gl_WorkGroupSize{\1u};/
s/^layout\(local_size_x_id = ([0-9]+)\) in;/static constexpr WorkGroupSize gl_WorkGroupSize{specialized<\1, kConstants...>(1u)};/
s/^layout\(constant_id = ([0-9]+)\) const uint (\w+) = (\w+);/static constexpr uint \2 = specialized<\1, kConstants...>(\3);/
s/^layout\(push_constant\) uniform Push \{ (\w+) (\w+); \};/Push<\1> push_constants; const \1\& \2 = push_constants.value;/
s/^layout\(push_constant\) uniform Push \{ uint (\w+); \};/Push<uint> push_constants; const uint\& \1 = push_constants.value;/
s/^layout\(std430\) [a-z ]*buffer \w+ \{ (\w+) (\w+)\[\]; \};/Storage<\1> \2{"\2"};/
s/^const /static constexpr /
s/^shared //

# statements
s/\[\[(dont_)?unroll\]\] //g
s/\b(inout|out) (\w+) (\w+)\[/\2 \3[/g
s/\b(inout|out) (\w+) (\w+)/\2\& \3/g
s/\.([xyzw]{2,4})\b/.\1()/g
s/\b([0-9]+\.[0-9]+(e-?[0-9]+)?|[0-9]+e-?[0-9]+)\b/\1f/g

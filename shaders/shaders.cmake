# Compiles every shaders/*.comp to SPIR-V at build time and embeds it; gpu::shader_code(name) returns it. glslang numbers
# the bindings (--auto-map-bindings) and keeps the names of the buffers, by which gpu::Pipeline binds them.
file(GLOB shader_sources CONFIGURE_DEPENDS ${CMAKE_SOURCE_DIR}/shaders/*.comp)
set(shader_dir ${CMAKE_BINARY_DIR}/shaders)
file(MAKE_DIRECTORY ${shader_dir})
set(shader_headers)
set(shader_includes "")
set(shader_table "")
foreach(source ${shader_sources})
  get_filename_component(name ${source} NAME_WE)
  set(header ${shader_dir}/${name}.spv.h)
  add_custom_command(OUTPUT ${header}
    COMMAND Vulkan::glslangValidator --quiet --target-env vulkan1.3 --auto-map-bindings -I${CMAKE_SOURCE_DIR}/shaders -I${CMAKE_SOURCE_DIR}/include --vn ${name}_spv
            --depfile ${header}.d -o ${header} ${source}
    DEPENDS ${source} DEPFILE ${header}.d COMMENT "Shader ${name}" VERBATIM)
  list(APPEND shader_headers ${header})
  string(APPEND shader_includes "#include \"${name}.spv.h\"\n")
  string(APPEND shader_table "  if (name == \"${name}\") return ${name}_spv;\n")
endforeach()
file(CONFIGURE OUTPUT ${shader_dir}/shader_code.cpp @ONLY CONTENT
"// Made by shaders/shaders.cmake.
#include <cstdint>
#include <span>
#include <stdexcept>
#include <string>
#include <string_view>
@shader_includes@
namespace chainsplat::gpu {
std::span<const std::uint32_t> shader_code(std::string_view name) {
@shader_table@  throw std::logic_error(\"no shader named \" + std::string(name));
}
}
")
add_library(chainsplat_shaders STATIC ${shader_dir}/shader_code.cpp ${shader_headers})
target_include_directories(chainsplat_shaders PRIVATE ${shader_dir})
target_compile_features(chainsplat_shaders PRIVATE cxx_std_20)
set_target_properties(chainsplat_shaders PROPERTIES POSITION_INDEPENDENT_CODE ON)

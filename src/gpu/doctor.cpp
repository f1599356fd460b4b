#include <cstdio>

#include "gpu/device.h"

namespace chainsplat::gpu {

Doctor examine(const std::string& selector) {
  Doctor doctor;
  std::string why;
  doctor.devices = list_devices(&why);
  doctor.validation_layer = validation_layer_present();
  doctor.pipeline_cache = pipeline_cache_folder().string();
  try {
    doctor.chosen = static_cast<int>(choose(doctor.devices, selector, why, &doctor.reason));
  } catch (const InputError& error) {
    doctor.reason = error.what();
  }
  if (doctor.chosen >= 0) {
    const DeviceInfo& d = doctor.devices[static_cast<std::size_t>(doctor.chosen)];
    if (d.software) doctor.missing.push_back("a GPU: " + d.name + " computes on the processor, many times slower");
    if (!d.timestamps) doctor.missing.push_back("timestamps: timings of single passes cannot be shown");
  }
  if (doctor.pipeline_cache.empty()) {
    doctor.missing.push_back("a home folder (XDG_CACHE_HOME or HOME): compiled shaders are not kept between runs");
  }
  if (!doctor.validation_layer) {
    doctor.missing.push_back("the Vulkan validation layer: only the tests need it (Debian: vulkan-validationlayers)");
  }
  return doctor;
}

std::string doctor_text(const Doctor& doctor) {
  std::string text;
  char line[512];
  for (const DeviceInfo& d : doctor.devices) {
    std::snprintf(line, sizeof line, "%s device %d: %s (%s), %s, Vulkan %u.%u.%u\n",
                  d.index == doctor.chosen ? "*" : " ", d.index, d.name.c_str(), d.type.c_str(), d.driver.c_str(),
                  VK_API_VERSION_MAJOR(d.api_version), VK_API_VERSION_MINOR(d.api_version),
                  VK_API_VERSION_PATCH(d.api_version));
    text += line;
    std::snprintf(line, sizeof line,
                  "    subgroup %u, work group %u, shared memory %u KiB, %u buffers a kernel, largest buffer %llu MiB, "
                  "memory %llu MiB%s\n",
                  d.subgroup_size, d.max_workgroup_invocations, d.shared_memory_bytes >> 10, d.storage_buffers,
                  static_cast<unsigned long long>(d.max_storage_range >> 20),
                  static_cast<unsigned long long>(d.heap_bytes >> 20),
                  d.unified_memory ? " (shared with the host)" : "");
    text += line;
    for (const std::string& reason : d.refused) text += "    cannot be used: " + reason + "\n";
  }
  if (doctor.chosen >= 0) {
    text += "  chosen: device " + std::to_string(doctor.chosen) + ", " + doctor.reason + "\n";
  } else {
    text += "  chosen: none; " + doctor.reason + "\n";
  }
  for (const std::string& what : doctor.missing) text += "  missing: " + what + "\n";
  if (!doctor.pipeline_cache.empty()) text += "  pipeline cache: " + doctor.pipeline_cache + "\n";
  return text;
}

}  // namespace chainsplat::gpu

// machine.h - what the machine can do at this moment, so that times of two machines, or of two hours, can be compared.
#pragma once

namespace chainsplat::tools {

struct MachineRates {
  double gflops = 0.0;  // 1e9 operations a second: fused multiply-adds in float, each of which counts as two
  double gigabytes_per_second = 0.0;  // 1e9 bytes a second, read and written, of a copy that no cache holds
};

// Measures both on core::threads() threads at once, some 0.2 s together. What else runs on the machine counts, as it
// does for the work that is measured beside it.
MachineRates measure_machine();

}  // namespace chainsplat::tools

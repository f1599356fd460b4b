#include "memory.h"

#include <malloc.h>

namespace chainsplat::tools {

void keep_memory_together() {
#ifdef __GLIBC__
  mallopt(M_ARENA_MAX, 1);
#endif
}

void trim_memory() {
#ifdef __GLIBC__
  malloc_trim(0);
#endif
}

}  // namespace chainsplat::tools

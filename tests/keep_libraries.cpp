// keep_libraries.cpp - stands before the C library's function in builds with sanitizers: nothing is unloaded.
extern "C" int dlclose(void*) { return 0; }

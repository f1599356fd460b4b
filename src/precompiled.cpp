// precompiled.cpp - an object beside the headers that all modules read precompiled (CMakeLists.txt).

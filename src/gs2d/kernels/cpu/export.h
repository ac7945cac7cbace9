// How to add an exported function.
//
// Define it in any cpu/*.cpp (collected by a CMake glob) with plain C types:
//     GS2D_EXPORT void gs2d_my_function(const float* in, float* out, int64_t n) { ... }
// Python calls it by `library.load().call("gs2d_my_function", ...)`, which reads the parameters from the source.
// Each library of CMakeLists.txt has its own copy under the same name, compiled for its instruction set; dispatch needs
// nothing else. Include "cpu/simd.h" for vectors, "cpu/threads.h" for threads. Do not throw or use the C++ library at
// run time: the libraries are linked without it. ctypes releases the GIL during the call.
#pragma once

#define GS2D_EXPORT extern "C" __attribute__((visibility("default")))

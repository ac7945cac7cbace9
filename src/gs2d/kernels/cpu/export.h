// How to add an exported function.
//
// Write it in any cpu/*.cpp (CMake globs them), in plain C types, as
//     GS2D_EXPORT void gs2d_my_function(const float* in, float* out, int64_t n) { ... }
// and declare it in kernels/library.py (or call `library.load().function("gs2d_my_function", restype, argtypes)`).
// Every library of CMakeLists.txt gets its own copy, compiled for its instruction set, under the same name; nothing
// else is needed for dispatch. Include "cpu/simd.h" for vectors, "cpu/threads.h" for threads. Do not throw, and do not
// use the C++ library at run time: the libraries link without it. ctypes releases the GIL during the call.
#pragma once

#define GS2D_EXPORT extern "C" __attribute__((visibility("default")))

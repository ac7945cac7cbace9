// Properties of this library, and the instruction set level of this CPU.
#include "cpu/export.h"
#include "cpu/simd.h"

// 4: x86-64-v4, 3: x86-64-v3, 0: neither. Meaningful in the portable library, which any CPU can load.
GS2D_EXPORT int gs2d_cpu_level() {
#if defined(__x86_64__)
    __builtin_cpu_init();
    const bool v3 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi") &&
                    __builtin_cpu_supports("bmi2");
    const bool v4 = v3 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
                    __builtin_cpu_supports("avx512cd") && __builtin_cpu_supports("avx512dq") &&
                    __builtin_cpu_supports("avx512vl");
    return v4 ? 4 : v3 ? 3 : 0;
#else
    return 0;
#endif
}

GS2D_EXPORT int gs2d_lanes() { return gs2d::LANES; }
GS2D_EXPORT int gs2d_real_bytes() { return sizeof(gs2d::real); }
GS2D_EXPORT int gs2d_abi_version() { return 10; }

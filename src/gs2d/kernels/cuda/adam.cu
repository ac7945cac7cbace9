// Adam over all attributes in one launch, with the arithmetic of torch's fused kernels. Rows that are not trained are
// not written.
#include "core/adam.h"
#include "cuda/common.h"

namespace gs2d {

constexpr int ATTRIBUTES = 6, ADAM_THREADS = 128, ADAM_PER_THREAD = 4;  // elements; same values in cuda_adam.py

struct AdamAttribute {
    float *parameter, *mean, *square;  // [N, columns]
    const float* gradient;             // [N, columns], or [M, columns] with `compact`
    const uchar* trained;              // [N], 0: not trained; null: all are trained
    const int64* rows;                 // [M]: rows to update; null: all
    int64 elements;                    // columns * (M or N)
    int64 first_block;
    int columns, compact;
    float step_size, root_2;  // rate / (1 - beta1^t), sqrt(1 - beta2^t)
};

struct AdamArguments {
    AdamAttribute attributes[ATTRIBUTES];
    int count;                             // attributes in use
    float weight_1, beta2, weight_2, eps;  // weight_k = 1 - beta_k
    const int* skip;                       // does nothing if nonzero; may be null
};

__device__ __forceinline__ void update(const AdamAttribute& p, const AdamArguments& a, int64 at, float g) {
    float parameter = p.parameter[at], mean = p.mean[at], square = p.square[at];
    adam(g, parameter, mean, square,
         AdamConstants<float>{a.weight_1, a.beta2, a.weight_2, a.eps, p.step_size, p.root_2});
    p.mean[at] = mean, p.square[at] = square, p.parameter[at] = parameter;
}

extern "C" __global__ void __launch_bounds__(128) adam_step(AdamArguments a) {
    if (a.skip && *a.skip) return;
    int which = 0;
    for (int k = 1; k < a.count; ++k)
        if (int64(blockIdx.x) >= a.attributes[k].first_block) which = k;
    const AdamAttribute& p = a.attributes[which];
    const int64 first = (int64(blockIdx.x) - p.first_block) * (ADAM_THREADS * ADAM_PER_THREAD);
    const int64 first_row = first / p.columns;
    const int first_column = int(first - first_row * p.columns);
#pragma unroll
    for (int k = 0; k < ADAM_PER_THREAD; ++k) {
        const int i = k * ADAM_THREADS + int(threadIdx.x);
        if (first + i >= p.elements) continue;
        int64 at = first + i;
        if (p.trained || p.rows) {
            const int down = (first_column + i) / p.columns, column = first_column + i - down * p.columns;
            if (p.rows)
                at = p.rows[first_row + down] * p.columns + column;
            else if (!p.trained[first_row + down])
                continue;
        }
        update(p, a, at, p.gradient[p.compact ? first + i : at]);
    }
}

}  // namespace gs2d

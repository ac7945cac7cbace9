// Adam step of one element, with the arithmetic of torch's fused kernels.
#pragma once

#include "core/base.h"

namespace gs2d {

// At step t (from 1): weight_k = 1 - beta_k, step_size = rate / (1 - beta1^t), root_2 = sqrt(1 - beta2^t).
template <class V> struct AdamConstants {
    V weight_1, beta2, weight_2, eps, step_size, root_2;
};

template <class V> GS2D_HD void adam(V g, V& parameter, V& mean, V& square, const AdamConstants<V>& k) {
    mean = fma(k.weight_1, g - mean, mean);
    square = fma(k.weight_2 * g, g, square * k.beta2);
    parameter = parameter - k.step_size * mean / (sqrt(square) / k.root_2 + k.eps);
}

}  // namespace gs2d

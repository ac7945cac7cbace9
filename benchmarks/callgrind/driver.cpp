// Render a small fixed view with a built kernel library, to count instructions. Uses no Python, threads, clock or C
// library random numbers. Usage: driver LIBRARY all|color
#include <dlfcn.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>
#include <vector>

#include "cpu/frame.h"  // for the structure layouts only; the library does the arithmetic

using namespace gs2d;

static uint32_t state = 12345;
static float uniform(float low, float high) {
    state = state * 1664525u + 1013904223u;
    return low + (high - low) * (float(state >> 8) / 16777216.0f);
}

int main(int argc, char** argv) {
    if (argc != 3) return 2;
    void* library = dlopen(argv[1], RTLD_NOW);
    if (!library) {
        fprintf(stderr, "%s\n", dlerror());
        return 3;
    }
    const bool color_only = strcmp(argv[2], "color") == 0;
    auto set_threads = reinterpret_cast<void (*)(int)>(dlsym(library, "gs2d_set_threads"));
    auto forward = reinterpret_cast<int (*)(const View*, const Parameters*, const Images*, Frame**)>(
        dlsym(library, "gs2d_raster_forward"));
    auto backward = reinterpret_cast<int (*)(Frame*, const Parameters*, const Images*, const ImageGradients*,
                                             const ParameterGradients*)>(dlsym(library, "gs2d_raster_backward"));
    if (!set_threads || !forward || !backward) return 4;
    set_threads(1);

    const int N = 3000, REST = 15, W = 128, H = 112;
    std::vector<float> means, quats, scales, logits, sh0, shN;
    for (int i = 0; i < N; ++i) {
        const float z = uniform(2.0f, 6.0f);
        means.insert(means.end(), {uniform(-0.6f, 0.6f) * z, uniform(-0.5f, 0.5f) * z, z});
        for (int k = 0; k < 4; ++k) quats.push_back(uniform(-1.0f, 1.0f));
        for (int k = 0; k < 2; ++k) scales.push_back(uniform(-3.6f, -2.2f));
        logits.push_back(uniform(-2.0f, 3.0f));
        for (int k = 0; k < 3; ++k) sh0.push_back(uniform(-1.0f, 1.0f));
        for (int k = 0; k < 3 * REST; ++k) shN.push_back(uniform(-0.2f, 0.2f));
    }
    const Parameters splats = {N, REST, means.data(), quats.data(), scales.data(), logits.data(), sh0.data(), shN.data()};
    View view = {};
    view.R[0] = view.R[4] = view.R[8] = 1;
    view.fx = view.fy = 115, view.cx = W / 2.0, view.cy = H / 2.0;
    view.near = 0.2, view.far = 1000, view.alpha_min = 1.0 / 255, view.alpha_max = 0.99, view.transmittance_min = 1e-4;
    view.error_cutoff = 3, view.lowpass_px = 0.70710678;
    view.width = W, view.height = H, view.sh_degree = 3, view.exact_masks = 1;

    std::vector<float> images(8 * W * H + 2 * W * H), upstream(10 * W * H), radii(N);
    for (float& g : upstream) g = uniform(-1.0f, 1.0f);
    const auto planes = [&](std::vector<float>& v) {
        float* p = v.data();
        return std::vector<float*>{p, p + 3 * W * H, p + 4 * W * H, p + 7 * W * H, p + 8 * W * H, p + 9 * W * H};
    };
    const std::vector<float*> to = planes(images), from = planes(upstream);
    const Images out = {to[0], to[1], to[2], to[3], to[4], to[5], radii.data()};
    Frame* frame = nullptr;
    if (forward(&view, &splats, &out, &frame) != 0) return 5;

    std::vector<float> g(N * (3 + 4 + 2 + 1 + 3 + 3 * REST + 2));
    float* p = g.data();
    ParameterGradients wanted = {p, p + 3 * N, p + 7 * N, p + 9 * N, p + 10 * N, p + 13 * N, p + (13 + 3 * REST) * N, 2};
    ImageGradients given = {from[0], from[1], from[2], from[3], from[4], from[5]};
    if (color_only) {
        wanted.means = wanted.quats = wanted.log_scales = wanted.opacity_logits = wanted.probe = nullptr;
        given = {from[0], nullptr, nullptr, nullptr, nullptr, nullptr};
    }
    return backward(frame, &splats, &out, &given, &wanted) == 0 ? 0 : 6;
}

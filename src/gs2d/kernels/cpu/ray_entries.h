// The exported functions of api.cpp for cameras with rays: the same source, compiled with GS2D_RAYS under other names.
// The functions for pinhole cameras call them where the view has rays. A Frame begins with its View in both.
#pragma once

#include "cpu/frame.h"

#if GS2D_RAYS
#undef GS2D_EXPORT
#define GS2D_EXPORT extern "C" __attribute__((visibility("hidden")))
#define OF_RAYS(view) false
#define gs2d_raster_forward gs2d_rays_forward
#define gs2d_transmittance_depth gs2d_rays_transmittance_depth
#define gs2d_raster_features gs2d_rays_features
#define gs2d_raster_backward_features gs2d_rays_backward
#define gs2d_splat_errors gs2d_rays_splat_errors
#define gs2d_frame_release gs2d_rays_release
#define gs2d_frame_bytes gs2d_rays_bytes
#define gs2d_trim gs2d_rays_trim
#else
#define OF_RAYS(view) ((view)->rays != nullptr)
#endif

extern "C" {
using namespace gs2d;
int gs2d_rays_forward(const View*, const Parameters*, const Images*, Frame**);
int gs2d_rays_transmittance_depth(Frame*, const Images*, double, real*);
int gs2d_rays_features(Frame*, const Features*);
int gs2d_rays_backward(Frame*, const Parameters*, const Images*, const ImageGradients*, const ParameterGradients*,
                       real*, const Features*);
int gs2d_rays_splat_errors(const View*, const Parameters*, const real*, const uint8_t*, int, real*);
void gs2d_rays_release(Frame*);
int64_t gs2d_rays_bytes(Frame*);
void gs2d_rays_trim();
}

// The rasterizer's exported functions. render/cpu_backend.py calls them and checks sizes and types.
#include <pthread.h>

#include "cpu/export.h"
#include "cpu/frame.h"
#include "cpu/ray_entries.h"
#include "cpu/stages.h"

namespace gs2d {
namespace {

pthread_mutex_t free_lock = PTHREAD_MUTEX_INITIALIZER;
Frame* free_frames = nullptr;
int free_count = 0;
constexpr int KEEP = 2;  // frames whose memory is kept for the next views

template <class F> void for_each_buffer(Frame& f, F&& visit) {
    visit(f.records), visit(f.tile_begin), visit(f.entries), visit(f.tile_count), visit(f.taken), visit(f.saved),
        visit(f.depth_slope), visit(f.scratch);
    visit(f.histogram), visit(f.slot_begin), visit(f.chunks), visit(f.own_sums), visit(f.feature_planes);
#if GS2D_RAYS
    visit(f.areas), visit(f.ray_tiles);
#endif
    visit(f.target), visit(f.splat_begin), visit(f.splat_slots);
}

void release_all(Frame& f) {
    for_each_buffer(f, [](auto& buffer) { buffer.release(); });
}

void set_view(Frame& f, const View& v) {
    f.view = v;
    for (int i = 0; i < 9; ++i) f.camera.R[i] = real(v.R[i]);
    for (int i = 0; i < 3; ++i) f.camera.t[i] = real(v.t[i]), f.camera.center[i] = real(v.center[i]);
    f.camera.fx = real(v.fx), f.camera.fy = real(v.fy), f.camera.cx = real(v.cx), f.camera.cy = real(v.cy);
    f.tiles_x = (v.width + TILE - 1) / TILE;
    f.tiles_y = (v.height + TILE - 1) / TILE;
    f.tiles = int64_t(f.tiles_x) * f.tiles_y;
    f.largest_chunk = 0;
}

}  // namespace

Frame* take_frame() {
    pthread_mutex_lock(&free_lock);
    Frame* f = free_frames;
    if (f) {
        free_frames = f->next_free;
        --free_count;
    }
    pthread_mutex_unlock(&free_lock);
    if (f) return f;
    return static_cast<Frame*>(calloc(1, sizeof(Frame)));  // all zeros is an empty frame
}

void give_back(Frame* f) {
    if (!f) return;
    pthread_mutex_lock(&free_lock);
    if (free_count < KEEP) {
        f->next_free = free_frames;
        free_frames = f;
        ++free_count;
        f = nullptr;
    }
    pthread_mutex_unlock(&free_lock);
    if (f) {
        release_all(*f);
        free(f);
    }
}

}  // namespace gs2d

using namespace gs2d;

// Status codes of the functions below.
enum { OK = 0, NO_MEMORY = 1 };

// Renders one view. `*frame` holds the state for the backward pass until gs2d_frame_release.
GS2D_EXPORT int gs2d_raster_forward(const View* view, const Parameters* splats, const Images* out, Frame** frame) {
    *frame = take_frame();
    if (!*frame) return NO_MEMORY;
    Frame& f = **frame;
    set_view(f, *view);
    StageClock clock;
    bool ok = project_splats(f, *splats, Reach::BLEND, out->radii);
    clock.done(PROJECT);
    ok = ok && bin_splats(f);  // measures its own time
    StageClock blending;
    ok = ok && blend_tiles(f, *out);
    blending.done(BLEND_FORWARD);
    if (ok) return OK;
    give_back(*frame);
    *frame = nullptr;
    return NO_MEMORY;
}

// Computes the depth by transmittance [H, W] of the last rendered view; `images` are its outputs.
GS2D_EXPORT int gs2d_transmittance_depth(Frame* frame, const Images* images, double width, real* depth) {
    if (OF_RAYS(&frame->view)) return gs2d_rays_transmittance_depth(frame, images, width, depth);
    return find_transmittance_depth(*frame, images->alpha, images->depth_median, width, depth) ? OK : NO_MEMORY;
}

// Renders further channels of the last rendered view.
GS2D_EXPORT int gs2d_raster_features(Frame* frame, const Features* features) {
    if (OF_RAYS(&frame->view)) return gs2d_rays_features(frame, features);
    return blend_features(*frame, *features) ? OK : NO_MEMORY;
}

// Computes the gradients of the splat parameters; `images` are the outputs of the same view. `intrinsics`: per-splat
// gradients [N, 4] of fx, fy, cx and cy, or null. `features`: further channels of the same view, or null.
GS2D_EXPORT int gs2d_raster_backward_features(Frame* frame, const Parameters* splats, const Images* images,
                                              const ImageGradients* upstream, const ParameterGradients* out,
                                              real* intrinsics, const Features* features) {
    if (OF_RAYS(&frame->view))
        return gs2d_rays_backward(frame, splats, images, upstream, out, intrinsics, features);
    const bool geometry = intrinsics || features || wants_geometry(*out);
    if (!blend_tiles_vjp(*frame, *images, *upstream, splats->sh_rest, *out, geometry, features)) return NO_MEMORY;
    StageClock clock;
    project_splats_vjp(*frame, *splats, *out, intrinsics);
    clock.done(PROJECT_BACKWARD);
    return OK;
}

#if !GS2D_RAYS
GS2D_EXPORT int gs2d_raster_backward_intrinsics(Frame* frame, const Parameters* splats, const Images* images,
                                                const ImageGradients* upstream, const ParameterGradients* out,
                                                real* intrinsics) {
    return gs2d_raster_backward_features(frame, splats, images, upstream, out, intrinsics, nullptr);
}

GS2D_EXPORT int gs2d_raster_backward(Frame* frame, const Parameters* splats, const Images* images,
                                     const ImageGradients* upstream, const ParameterGradients* out) {
    return gs2d_raster_backward_features(frame, splats, images, upstream, out, nullptr, nullptr);
}
#endif

// Computes the inner sum of E_i: `image` [H, W, 3], `mask` [H, W] bytes or null, `errors` [N].
GS2D_EXPORT int gs2d_splat_errors(const View* view, const Parameters* splats, const real* image, const uint8_t* mask,
                                  int occlusion, real* errors) {
    Frame* f = take_frame();
    if (!f) return NO_MEMORY;
    set_view(*f, *view);
    const bool ok =
        project_splats(*f, *splats, occlusion ? Reach::ERRORS_OCCLUDED : Reach::ERRORS, nullptr) &&
        (occlusion ? occluded_splat_errors(*f, image, mask, errors) : splat_errors(*f, image, mask, errors));
    give_back(f);
    return ok ? OK : NO_MEMORY;
}

GS2D_EXPORT void gs2d_frame_release(Frame* frame) {
    if (frame && OF_RAYS(&frame->view)) return gs2d_rays_release(frame);
    give_back(frame);
}

// Returns the bytes that a view occupies between forward and backward pass.
GS2D_EXPORT int64_t gs2d_frame_bytes(Frame* frame) {
    if (OF_RAYS(&frame->view)) return gs2d_rays_bytes(frame);
    size_t bytes = 0;
    for_each_buffer(*frame, [&](auto& buffer) { bytes += buffer.capacity * sizeof(*buffer.data); });
    return static_cast<int64_t>(bytes);
}

// Frees the memory reserved for the next view.
GS2D_EXPORT void gs2d_trim() {
#if !GS2D_RAYS
    gs2d_rays_trim();
#endif
    pthread_mutex_lock(&free_lock);
    Frame* f = free_frames;
    free_frames = nullptr;
    free_count = 0;
    pthread_mutex_unlock(&free_lock);
    while (f) {
        Frame* next = f->next_free;
        release_all(*f);
        free(f);
        f = next;
    }
}

#if !GS2D_RAYS
// The same for a view with rays. These are separate names, so that an older library is an error instead of a pinhole.
GS2D_EXPORT int gs2d_raster_forward_rays(const View* view, const Parameters* splats, const Images* out, Frame** frame) {
    return gs2d_rays_forward(view, splats, out, frame);
}
GS2D_EXPORT int gs2d_splat_errors_rays(const View* view, const Parameters* splats, const real* image,
                                       const uint8_t* mask, int occlusion, real* errors) {
    return gs2d_rays_splat_errors(view, splats, image, mask, occlusion, errors);
}
#endif

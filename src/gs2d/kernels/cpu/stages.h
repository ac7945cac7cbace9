// Nanoseconds of each pass of this thread's last calls, for benchmarks. Costs one clock read per pass and view.
#pragma once

#include <cstdint>
#include <time.h>

namespace gs2d_shared {  // by the rasterizers of both kinds of cameras

enum Stage { PROJECT, SORT, BIN, BLEND_FORWARD, INDEX_SLOTS, BLEND_BACKWARD, PROJECT_BACKWARD, STAGES };

extern __thread int64_t stage_ns[STAGES];  // a forward or backward pass overwrites its own stages

class StageClock {
  public:
    StageClock() { clock_gettime(CLOCK_MONOTONIC, &last_); }
    // Adds the time since the last call (or construction) to `stage`.
    void done(Stage stage) {
        timespec now;
        clock_gettime(CLOCK_MONOTONIC, &now);
        stage_ns[stage] = int64_t(now.tv_sec - last_.tv_sec) * 1000000000 + (now.tv_nsec - last_.tv_nsec);
        last_ = now;
    }

  private:
    timespec last_;
};

}  // namespace gs2d_shared
namespace gs2d {
using namespace gs2d_shared;
}

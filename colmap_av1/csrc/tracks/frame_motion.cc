#include "tracks/frame_motion.h"

#include <stdexcept>

namespace colmap_av1::tracks {
namespace {

constexpr int kMaxSide = 65536;  // a frame header has 16 bits for a size less one

}  // namespace

void check_frame_motion(const FrameMotion& frame) {
  if (frame.frame_width < 1 || frame.frame_width > kMaxSide || frame.height < 1 ||
      frame.height > kMaxSide) {
    throw std::invalid_argument("a frame's width and height are 1 to 65536 pixels");
  }
  if (frame.frame_width > 4 * frame.mi_cols || frame.height > 4 * frame.mi_rows) {
    throw std::invalid_argument("the picture is larger than its 4x4 units cover");
  }
  const int n = frame.num_units();
  for (int u = 0; u < n; ++u) {
    if (frame.mi_size[u] >= kNumBlockSizes) {
      throw std::invalid_argument("mi_size holds a value above 21 (BLOCK_64X16)");
    }
    if (frame.ref_frame[2 * u] >= kNumRefs || frame.ref_frame[2 * u + 1] >= kNumRefs) {
      throw std::invalid_argument("ref_frame holds a value above 7 (ALTREF_FRAME)");
    }
    if (frame.warp_index[u] >= frame.num_local_warps) {
      throw std::invalid_argument("warp_index points past the rows of local_warp_params");
    }
  }
}

}  // namespace colmap_av1::tracks

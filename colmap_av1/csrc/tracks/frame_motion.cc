#include "tracks/frame_motion.h"

#include <stdexcept>

namespace colmap_av1::tracks {
namespace {

constexpr int kMaxSide = 65536;  // a frame header has 16 bits for a size minus one

}  // namespace

void check_frame_motion(const FrameMotion& frame) {
  if (frame.frame_width < 1 || frame.frame_width > kMaxSide || frame.height < 1 ||
      frame.height > kMaxSide) {
    throw std::invalid_argument("a frame's width and height are 1 to 65536 pixels");
  }
  if (frame.frame_width > 4 * frame.mi_cols || frame.height > 4 * frame.mi_rows) {
    throw std::invalid_argument("the picture is larger than its 4x4 units cover");
  }
  const auto has = [](std::size_t size, std::int32_t index) {
    return index >= 0 && static_cast<std::size_t>(index) < size;
  };
  for (const std::int32_t index : frame.block_index) {
    if (!has(frame.blocks.size(), index)) {
      throw std::invalid_argument("block_index points to no block");
    }
  }
  for (const av1::BlockInfo& block : frame.blocks) {
    if (block.mi_size >= av1::BLOCK_SIZES) {
      throw std::invalid_argument("mi_size holds a value above 21 (BLOCK_64X16)");
    }
    if (block.ref_frame[0] >= kNumRefs || block.ref_frame[1] >= kNumRefs) {
      throw std::invalid_argument("ref_frame holds a value above 7 (ALTREF_FRAME)");
    }
    if (block.warp_index >= 0 && !has(frame.local_warp_params.size(), block.warp_index)) {
      throw std::invalid_argument("warp_index points past the rows of local_warp_params");
    }
  }
}

}  // namespace colmap_av1::tracks

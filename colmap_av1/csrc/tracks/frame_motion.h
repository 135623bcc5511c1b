// Block data of one coded frame: the part of the package's FrameMotion that tracks need.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <span>

#include "av1/frame_state.h"

namespace colmap_av1::tracks {

inline constexpr int kNumRefs = av1::TOTAL_REFS_PER_FRAME;  // RefFrame 0..7; 0 is INTRA_FRAME

// Values under the specification's names. Arrays are indexed by RefFrame; those of blocks are
// views.
struct FrameMotion {
  int decode_index = 0;
  int display_index = -1;
  bool show_frame = true;
  int width = 0;        // UpscaledWidth
  int height = 0;       // FrameHeight
  int frame_width = 0;  // FrameWidth: the units lie in the picture before super-resolution
  bool force_integer_mv = false;
  std::array<std::int32_t, kNumRefs> gm_type{};
  av1::GmParams gm_params{};
  std::array<std::int32_t, kNumRefs> ref_decode_index{};
  std::array<std::int32_t, kNumRefs> ref_display_index{};
  std::array<std::array<std::int32_t, 2>, kNumRefs> ref_size{};  // (width, height)
  std::array<std::int32_t, kNumRefs> slot_decode_index{};        // by reference slot
  int mi_rows = 0;
  int mi_cols = 0;
  std::span<const av1::BlockInfo> blocks;
  std::span<const std::int32_t> block_index;  // [mi_rows][mi_cols], block of each 4x4 luma unit
  std::span<const av1::WarpParams> local_warp_params;

  int num_units() const { return mi_rows * mi_cols; }
  const av1::BlockInfo& block(int unit) const {
    return blocks[static_cast<std::size_t>(block_index[static_cast<std::size_t>(unit)])];
  }
};

// Throws std::invalid_argument for an invalid size, a size that the units do not cover, or a value
// that would index outside a table.
void check_frame_motion(const FrameMotion& frame);

}  // namespace colmap_av1::tracks

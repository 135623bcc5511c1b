// Block data of one coded frame: the package's FrameMotion, as far as tracks need it.
#pragma once

#include <cstdint>

namespace colmap_av1::tracks {

inline constexpr int kNumRefs = 8;         // RefFrame 0..7, 0 is INTRA_FRAME
inline constexpr int kNumBlockSizes = 22;  // BLOCK_4X4 .. BLOCK_64X16

// Borrowed arrays under the specification's names; those of units have one entry per 4x4 luma
// unit, n = mi_rows * mi_cols in raster order.
struct FrameMotion {
  int decode_index = 0;
  int display_index = -1;
  bool show_frame = true;
  int width = 0;        // UpscaledWidth
  int height = 0;       // FrameHeight
  int frame_width = 0;  // FrameWidth: the units lie in the picture before super-resolution
  bool force_integer_mv = false;
  const std::int32_t* gm_type = nullptr;            // [7], LAST..ALTREF
  const std::int32_t* gm_params = nullptr;          // [7][6]
  const std::int32_t* ref_decode_index = nullptr;   // [8]
  const std::int32_t* ref_display_index = nullptr;  // [8]
  const std::int32_t* ref_size = nullptr;           // [8][2] (width, height)
  const std::int32_t* slot_decode_index = nullptr;  // [8]
  int mi_rows = 0;
  int mi_cols = 0;
  const std::int8_t* ref_frame = nullptr;  // [n][2]
  const std::int16_t* mv = nullptr;        // [n][list][0 = row, 1 = column], 1/8 px
  const std::uint8_t* mi_size = nullptr;
  const std::uint8_t* y_mode = nullptr;
  const std::uint8_t* is_inter = nullptr;
  const std::uint8_t* skip = nullptr;
  const std::uint8_t* motion_mode = nullptr;
  const std::uint8_t* interintra = nullptr;
  const std::uint8_t* use_intrabc = nullptr;
  const std::int32_t* warp_index = nullptr;
  const std::int32_t* local_warp_params = nullptr;  // [num_local_warps][6]
  int num_local_warps = 0;

  int num_units() const { return mi_rows * mi_cols; }
};

// Throws std::invalid_argument for a size that no frame has or that the units do not cover, and
// where a unit's value would index outside a table.
void check_frame_motion(const FrameMotion& frame);

}  // namespace colmap_av1::tracks

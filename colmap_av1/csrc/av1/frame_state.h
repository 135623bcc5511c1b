// State of a frame: its blocks while it is parsed, and the parts that later frames refer to.
#pragma once

#include <algorithm>
#include <array>
#include <bit>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <new>
#include <vector>

#include "av1/cdf.h"
#include "av1/headers.h"
#include "av1/spec_tables.h"

namespace colmap_av1::av1 {

// A motion vector in units of 1/8 luma sample.
struct Mv {
  std::int16_t row = 0;
  std::int16_t col = 0;
  friend bool operator==(Mv a, Mv b) {  // one comparison
    return std::bit_cast<std::uint32_t>(a) == std::bit_cast<std::uint32_t>(b);
  }
};

constexpr std::uint8_t kAbsent = 255;  // a syntax element that a block does not have

// One block (decode_block) under the specification's names. Python reads its memory with the dtype
// of block_dtype( ) in bindings/frame_motion.cc, and may pass blocks to the core that hold any
// bytes.
struct BlockInfo {
  std::array<Mv, 2> mv{};
  std::uint8_t mi_size = 0;
  std::uint8_t y_mode = DC_PRED;
  std::uint8_t is_inter = 0;
  std::uint8_t skip = 0;
  std::uint8_t skip_mode = 0;
  std::uint8_t segment_id = 0;
  std::uint8_t motion_mode = SIMPLE;
  std::uint8_t compound_type = kAbsent;
  std::uint8_t interintra = 0;
  std::uint8_t use_intrabc = 0;
  std::array<std::int8_t, 2> ref_frame{INTRA_FRAME, NONE};
  std::int32_t local_warp = -1;  // index of the frame's LocalWarp; -1: none
  std::int32_t warp_index = -1;  // the same; -1 also if it is not valid
  std::uint16_t mi_row = 0;
  std::uint16_t mi_col = 0;
  std::uint8_t uv_mode = kAbsent;
  std::uint8_t partition = 0;
  std::uint8_t use_filter_intra = 0;
  std::uint8_t has_chroma = 0;
  std::array<std::uint8_t, 2> interp_filter{kAbsent, kAbsent};
  std::array<std::uint8_t, 2> palette_size{};  // PaletteSizeY, PaletteSizeUV
  std::uint8_t comp_group_idx = 0;
  std::uint8_t compound_idx = 0;
  std::uint8_t tx_size = TX_4X4;
  std::int8_t angle_delta_y = 0;
  std::int8_t angle_delta_uv = 0;
  std::uint8_t filter_intra_mode = 0;
  std::uint8_t cfl_alpha_idx = 0;
  std::uint8_t cfl_alpha_signs = 0;
  std::uint8_t interintra_mode = kAbsent;
  std::uint8_t wedge_interintra = 0;
  std::uint8_t wedge_index = kAbsent;
  std::uint8_t wedge_sign = 0;
  std::uint8_t mask_type = 0;
  std::uint8_t num_samples = 0;
  std::int16_t current_q_index = 0;
  std::array<std::int8_t, FRAME_LF_COUNT> delta_lf{};

  int bw4() const { return kNum4x4BlocksWide[mi_size]; }
  int bh4() const { return kNum4x4BlocksHigh[mi_size]; }
  bool is_at_least_8x8() const { return std::min(bw4(), bh4()) >= 2; }
  bool is_compound() const { return ref_frame[1] > INTRA_FRAME; }
};

// LocalWarpParams and LocalValid of one block (7.11.3.8)
struct LocalWarp {
  bool valid = false;
  WarpParams params{};
};

// Motion saved for the motion field estimation of later frames, one entry per 8x8 luma
// samples (only odd rows and columns of MfRefFrames and MfMvs are ever read, 7.19).
struct SavedMotion {
  Mv mv;
  std::int8_t ref_frame = NONE;
  friend bool operator==(const SavedMotion&, const SavedMotion&) = default;
};

// The parts of a decoded frame that are saved in a reference slot (7.20).
struct FrameState {
  FrameHeader header;
  int decode_index = -1;
  int bit_depth = 8;
  int subsampling_x = 1;
  int subsampling_y = 1;
  CdfContext cdfs;
  std::vector<SavedMotion> saved_motion;  // [mi_rows / 2][mi_cols / 2]
  std::vector<std::uint8_t> segment_ids;  // [mi_rows][mi_cols]; empty: all 0
};

// An entry of the projected motion field (7.9): the saved vector and the distance it covers;
// ref_offset 0 marks a hole. Projection to a reference happens on use.
struct MotionFieldEntry {
  Mv mv;
  std::int8_t ref_offset = 0;
  friend bool operator==(const MotionFieldEntry&, const MotionFieldEntry&) = default;
};

// Memory for blocks, which the system provides only where a block is written. Most frames have far
// fewer blocks than units, and a header must not allocate the memory of a whole frame.
struct FreeBlocks {
  void operator()(BlockInfo* blocks) const { ::operator delete(blocks); }
};
using BlockBuffer = std::unique_ptr<BlockInfo[], FreeBlocks>;

inline BlockBuffer make_block_buffer(std::size_t size) {
  return BlockBuffer(static_cast<BlockInfo*>(::operator new(size * sizeof(BlockInfo))));
}

// The position of a tile in its frame, in units.
struct TileBounds {
  int mi_row_start = 0;
  int mi_row_end = 0;
  int mi_col_start = 0;
  int mi_col_end = 0;

  // is_inside( ) of 5.11.51
  bool contains(int row, int col) const {
    return col >= mi_col_start && col < mi_col_end && row >= mi_row_start && row < mi_row_end;
  }
};

// Width of a superblock in units. Contexts to the left are stored by the row in the superblock.
inline constexpr int kMaxSb4 = 32;
inline constexpr int kSbMask = kMaxSb4 - 1;

// Everything the tiles of one frame share.
struct FrameContext {
  const SequenceHeader* seq = nullptr;
  const FrameHeader* header = nullptr;
  CdfContext cdfs;               // at the start of each tile
  std::vector<BlockInfo*> grid;  // [mi_rows][mi_cols]; null: not decoded yet
  BlockBuffer blocks;            // memory for as many blocks as units
  std::size_t blocks_capacity = 0;
  std::vector<MotionFieldEntry> motion_field;      // [mi_rows / 2][mi_cols / 2]
  const std::uint8_t* prev_segment_ids = nullptr;  // null: all 0
  std::array<bool, TOTAL_REFS_PER_FRAME> ref_usable{};
  std::array<bool, TOTAL_REFS_PER_FRAME> ref_scaled{};   // is_scaled( )
  std::array<int, TOTAL_REFS_PER_FRAME> ref_distance{};  // this frame's OrderHint less theirs

  BlockInfo*& at(int row, int col) { return grid[unit(row, col)]; }
  const BlockInfo* at(int row, int col) const { return grid[unit(row, col)]; }

 private:
  std::size_t unit(int row, int col) const {
    return static_cast<std::size_t>(row) * static_cast<std::size_t>(header->mi_cols) +
           static_cast<std::size_t>(col);
  }
};

}  // namespace colmap_av1::av1

// Parsing of one tile (specification sections 5.11.2 and following).
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "av1/coefficients.h"
#include "av1/frame_state.h"
#include "av1/mv_prediction.h"
#include "av1/symbol_decoder.h"

namespace colmap_av1::av1 {

// Parses the blocks of a tile into FrameContext::grid and FrameContext::blocks. Nothing is
// reconstructed. Its buffers are reused for later tiles and frames.
//
// The methods are divided among files by subject: partition.cc, mode_info.cc, ref_frames.cc,
// palette.cc, mv_syntax.cc, residual.cc.
class TileParser {
 public:
  // Parses a tile; blocks are written to the memory that starts at `blocks`. Throws BitstreamError.
  void parse(FrameContext& frame, int tile_row, int tile_col, std::span<const std::uint8_t> data,
             BlockInfo* blocks);

  // Blocks of the last tile in decoding order.
  std::size_t num_blocks() const { return static_cast<std::size_t>(next_block_ - first_block_); }
  const std::vector<LocalWarp>& local_warps() const { return local_warps_; }
  // Whether the tile ends with the bits that the specification requires.
  bool trailing_bits_valid() const { return trailing_bits_valid_; }
  // CDFs after the last symbol (the "Saved" arrays of the exit process, 8.2.4).
  const CdfContext& cdfs() const { return cdf_; }

 private:
  // partition.cc
  void decode_tile();
  void decode_partition(int r, int c, int b_size);
  void decode_block(int r, int c, int sub_size, int partition);
  void clear_cdef() { cdef_idx_.fill(-1); }
  void read_cdef();
  void read_delta_qindex();
  void read_delta_lf();
  void read_lr(int r, int c, int b_size);
  void read_lr_unit(int plane);

  // mode_info.cc
  void intra_frame_mode_info();
  void inter_frame_mode_info();
  void intra_segment_id();
  void read_segment_id();
  void inter_segment_id(bool pre_skip);
  int predicted_segment_id() const;
  void set_seg_pred_context(bool predicted);
  void read_skip_mode();
  void read_skip();
  void read_is_inter();
  void intra_block_mode_info();
  void inter_block_mode_info();
  void intra_modes_after_y_mode();
  void read_cfl_alphas();
  void filter_intra_mode_info();
  void read_motion_mode();
  void read_interintra_mode();
  void read_compound_type();
  int read_drl(const MvStack& stack, int first);
  void read_interp_filters();
  bool needs_interp_filter() const;
  bool seg_feature_active(int feature) const {
    return header_->seg_feature_active(b_->segment_id, feature);
  }

  // ref_frames.cc
  void read_ref_frames();
  int comp_mode_context() const;
  int comp_ref_type_context() const;

  // palette.cc
  void palette_mode_info();
  int palette_cache(int plane, std::array<std::uint16_t, 16>& cache) const;
  void save_palette_colors();
  void palette_tokens();
  template <typename Cdfs>
  void read_color_map(int size, int width, int height, Cdfs&& read_index);

  // mv_syntax.cc
  void assign_mv(const MvStack& stack, int ref_mv_idx);
  Mv read_mv(Mv predicted);

  // residual.cc
  void read_block_tx_size();
  void read_tx_size(bool allow_select);
  void read_var_tx_size(int row, int col, int tx_size, int depth);
  int above_tx_width(int row, int col) const;
  int left_tx_height(int row, int col) const;
  void set_tx_context(int row, int col, int w4, int h4, int width, int height);
  void residual();
  void transform_tree(int start_x, int start_y, int w, int h);
  void transform_block(int plane, int start_x, int start_y, int tx_size);
  int uv_tx_size() const;

  template <std::size_t M>
  int read(std::uint16_t (&cdf)[M]) {
    return symbols_.read(cdf);
  }
  bool read_flag(std::uint16_t (&cdf)[3]) { return symbols_.flag(cdf); }

  // The tile
  SymbolDecoder symbols_;
  CdfContext cdf_;
  FrameContext* frame_ = nullptr;
  const SequenceHeader* seq_ = nullptr;
  const FrameHeader* header_ = nullptr;
  TileBounds tile_;
  BlockInfo* first_block_ = nullptr;
  BlockInfo* next_block_ = nullptr;
  std::vector<LocalWarp> local_warps_;
  bool trailing_bits_valid_ = true;
  int current_q_index_ = 0;
  std::array<std::int8_t, FRAME_LF_COUNT> delta_lf_{};
  bool read_deltas_ = false;
  std::array<int, 4> cdef_idx_{};  // of the superblock's 64x64 areas
  int ref_lr_wiener_[3][2][WIENER_COEFFS] = {};
  int ref_sgr_xqd_[3][2] = {};

  CoefficientReader coefficients_;
  // Contexts above (by column of the frame) and left (by row of the superblock)
  std::vector<std::uint8_t> above_tx_width_;
  std::array<std::uint8_t, kMaxSb4 + 16> left_tx_height_{};
  std::vector<std::uint8_t> above_seg_pred_;
  std::array<std::uint8_t, kMaxSb4> left_seg_pred_{};
  std::array<std::vector<std::array<std::uint16_t, PALETTE_COLORS>>, 2> above_palette_;
  std::array<std::array<std::array<std::uint16_t, PALETTE_COLORS>, kMaxSb4>, 2> left_palette_{};

  // The block
  BlockInfo* b_ = nullptr;
  const BlockInfo* above_ = nullptr;  // null if AvailU is 0
  const BlockInfo* left_ = nullptr;   // null if AvailL is 0
  int bw4_ = 0, bh4_ = 0;
  bool lossless_ = false;
  std::array<std::array<std::uint16_t, PALETTE_COLORS>, 2> palette_colors_{};
  std::array<std::uint8_t, 64 * 64> color_map_{};
  std::array<std::uint8_t, kMaxSb4 * kMaxSb4> inter_tx_sizes_{};
  // RefFrame of the neighbours, set by inter_frame_mode_info( )
  std::array<int, 2> above_ref_frame_{}, left_ref_frame_{};
  bool above_intra_ = false, left_intra_ = false, above_single_ = false, left_single_ = false;
  std::array<std::uint8_t, TOTAL_REFS_PER_FRAME> ref_counts_{};  // count_refs( )
};

}  // namespace colmap_av1::av1

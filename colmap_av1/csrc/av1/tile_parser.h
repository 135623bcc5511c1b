// Parsing of one tile (specification sections 5.11.2 and following).
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "av1/frame_state.h"
#include "av1/symbol_decoder.h"
#include "av1/warp.h"

namespace colmap_av1::av1 {

// Parses the blocks of a tile into FrameContext::grid and FrameContext::blocks. Nothing is
// reconstructed. Its buffers are kept between tiles and frames.
//
// The methods are spread over files by subject: partition.cc, mode_info.cc, ref_frames.cc,
// palette.cc, mv_prediction.cc, residual.cc.
class TileParser {
 public:
  // Parses a tile; blocks are written from `blocks` on. Throws BitstreamError.
  void parse(FrameContext& frame, int tile_row, int tile_col, const std::uint8_t* data,
             std::size_t size, BlockInfo* blocks);

  // Blocks of the last tile in decoding order.
  std::size_t num_blocks() const { return static_cast<std::size_t>(next_block_ - first_block_); }
  const std::vector<LocalWarp>& local_warps() const { return local_warps_; }
  // Whether the tile ends with the bits that the specification demands.
  bool trailing_bits_valid() const { return trailing_bits_valid_; }
  // CDFs after the last symbol (the "Saved" arrays of the exit process, 8.2.4).
  const CdfContext& cdfs() const { return cdf_; }

 private:
  static constexpr int kMaxSb4 = 32;  // units in a superblock's edge
  static constexpr int kSbMask = kMaxSb4 - 1;

  // partition.cc
  void decode_tile();
  void decode_partition(int r, int c, int b_size);
  void decode_block(int r, int c, int sub_size, int partition);
  bool is_inside(int row, int col) const {
    return col >= mi_col_start_ && col < mi_col_end_ && row >= mi_row_start_ && row < mi_row_end_;
  }
  void clear_cdef() { cdef_idx_.fill(-1); }
  void read_cdef();
  void read_delta_qindex();
  void read_delta_lf();
  void read_lr(int r, int c, int b_size);
  void read_lr_unit(int plane);
  int decode_signed_subexp_with_ref_bool(int low, int high, int k, int reference);

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
  void read_motion_mode(bool is_compound);
  void read_interintra_mode(bool is_compound);
  void read_compound_type(bool is_compound);
  int read_drl(int first);
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

  // mv_prediction.cc
  void find_mv_stack(bool is_compound);
  Mv setup_global_mv(int ref_list) const;
  void scan_row(int delta_row, bool is_compound);
  void scan_col(int delta_col, bool is_compound);
  void scan_point(int delta_row, int delta_col, bool is_compound);
  void temporal_scan(bool is_compound);
  void temporal_sample(const MotionFieldEntry& entry, bool first, bool is_compound);
  void add_ref_mv_candidate(const BlockInfo& candidate, bool is_compound, int weight);
  // Returns the entry's index, -1 where the stack is full.
  int add_to_stack(Mv mv0, Mv mv1, bool is_compound, int weight);
  void lower_mv_precision(Mv& mv) const;
  void sort_stack(int start, int end);
  void extra_search(bool is_compound);
  void context_and_clamping(bool is_compound, int num_new);
  bool has_overlappable_candidates() const;
  void find_warp_samples();
  void add_warp_sample(int delta_row, int delta_col);
  void assign_mv(bool is_compound);
  void read_mv(int list, Mv predicted);
  int read_mv_component(MvComponentCdfs& cdf);
  bool is_mv_valid(bool is_compound) const;

  // residual.cc
  void read_block_tx_size();
  void read_tx_size(bool allow_select);
  void read_var_tx_size(int row, int col, int tx_size, int depth);
  int above_tx_width(int row, int col) const;
  int left_tx_height(int row, int col) const;
  void set_tx_context(int row, int col, int w4, int h4, int width, int height);
  void reset_block_context();
  void residual();
  void transform_tree(int start_x, int start_y, int w, int h);
  void transform_block(int plane, int start_x, int start_y, int tx_size);
  int uv_tx_size() const;
  int tx_set(int tx_size) const;
  int read_transform_type(int tx_size);
  int plane_tx_type(int plane, int tx_size, int x4, int y4) const;
  void coeffs(int plane, int x4, int y4, int tx_size);
  int read_eob(int tx_size, int tx_size_ctx, int ptype, int tx_class);
  template <int kTxClass>
  std::uint8_t read_levels(int tx_size, int tx_size_ctx, int ptype, int eob, int dc_sign_ctx);

  // A symbol of a CDF array with M - 1 values.
  template <std::size_t M>
  int read(std::uint16_t (&cdf)[M]) {
    return symbols_.symbol<static_cast<int>(M) - 1>(cdf);
  }
  bool read_flag(std::uint16_t (&cdf)[3]) { return symbols_.flag(cdf); }

  // The tile
  SymbolDecoder symbols_;
  CdfContext cdf_;
  FrameContext* frame_ = nullptr;
  const SequenceHeader* seq_ = nullptr;
  const FrameHeader* header_ = nullptr;
  int mi_row_start_ = 0, mi_row_end_ = 0, mi_col_start_ = 0, mi_col_end_ = 0;
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

  // Contexts above (by column of the frame) and left (by row of the superblock). A coefficient
  // context holds the level in the low six bits and the sign category of DC above.
  std::array<std::vector<std::uint8_t>, 3> above_coef_context_;
  std::array<std::array<std::uint8_t, kMaxSb4 + 16>, 3> left_coef_context_{};
  std::vector<std::uint8_t> above_tx_width_;
  std::array<std::uint8_t, kMaxSb4 + 16> left_tx_height_{};
  std::vector<std::uint8_t> above_seg_pred_;
  std::array<std::uint8_t, kMaxSb4> left_seg_pred_{};
  std::array<std::vector<std::array<std::uint16_t, PALETTE_COLORS>>, 2> above_palette_;
  std::array<std::array<std::array<std::uint16_t, PALETTE_COLORS>, kMaxSb4>, 2> left_palette_{};

  // The block
  BlockInfo* b_ = nullptr;
  const BlockInfo* above_ = nullptr;  // null where AvailU is 0
  const BlockInfo* left_ = nullptr;   // null where AvailL is 0
  int bw4_ = 0, bh4_ = 0;
  bool lossless_ = false;
  std::array<std::array<std::uint16_t, PALETTE_COLORS>, 2> palette_colors_{};
  std::array<std::uint8_t, 64 * 64> color_map_{};
  std::array<std::uint8_t, kMaxSb4 * kMaxSb4> inter_tx_sizes_{};
  std::array<std::uint8_t, kMaxSb4 * kMaxSb4> tx_types_{};
  // RefFrame of the neighbours, as inter_frame_mode_info( ) sets them up
  std::array<int, 2> above_ref_frame_{}, left_ref_frame_{};
  bool above_intra_ = false, left_intra_ = false, above_single_ = false, left_single_ = false;
  std::array<std::uint8_t, TOTAL_REFS_PER_FRAME> ref_counts_{};  // count_refs( )

  // Motion vector prediction (7.10)
  struct StackEntry {
    std::array<Mv, 2> mv;
    int weight;
  };
  std::array<StackEntry, MAX_REF_MV_STACK_SIZE + 2> stack_{};
  int num_mv_found_ = 0;
  int new_mv_count_ = 0;
  MotionFieldEntry temporal_entry_;  // the last one projected, and its index in the stack
  int temporal_index_ = -1;
  bool found_match_ = false;
  int close_matches_ = 0, total_matches_ = 0;
  int new_mv_context_ = 0, ref_mv_context_ = 0, zero_mv_context_ = 0;
  std::array<Mv, 2> global_mvs_{};
  std::array<int, MAX_REF_MV_STACK_SIZE + 2> drl_context_{};
  int ref_mv_idx_ = 0;
  WarpSamples warp_samples_{};
  int num_samples_ = 0, num_samples_scanned_ = 0;

  // Coefficient levels of a transform block with a margin of 4 behind each row and below, and for
  // each that a Golomb code follows how many that are not 0 were read before
  std::array<std::uint8_t, 36 * 36> levels_{};
  std::array<std::uint16_t, 32 * 32> large_{};
};

}  // namespace colmap_av1::av1

// Sequence and frame headers (specification sections 5.5, 5.9, 6.4, 6.8 and 7.8).
#pragma once

#include <array>
#include <cstdint>

#include "av1/bit_reader.h"
#include "av1/constants.h"

namespace colmap_av1::av1 {

struct SequenceHeader {
  int seq_profile = 0;
  bool still_picture = false;
  bool reduced_still_picture_header = false;
  bool decoder_model_info_present_flag = false;
  bool equal_picture_interval = false;
  int buffer_delay_length_minus_1 = 0;
  int buffer_removal_time_length_minus_1 = 0;
  int frame_presentation_time_length_minus_1 = 0;
  int operating_points_cnt_minus_1 = 0;
  std::array<int, 32> operating_point_idc{};
  std::array<bool, 32> decoder_model_present_for_this_op{};
  int frame_width_bits_minus_1 = 0;
  int frame_height_bits_minus_1 = 0;
  int max_frame_width_minus_1 = 0;
  int max_frame_height_minus_1 = 0;
  bool frame_id_numbers_present_flag = false;
  int delta_frame_id_length_minus_2 = 0;
  int additional_frame_id_length_minus_1 = 0;
  bool use_128x128_superblock = false;
  bool enable_filter_intra = false;
  bool enable_intra_edge_filter = false;
  bool enable_interintra_compound = false;
  bool enable_masked_compound = false;
  bool enable_warped_motion = false;
  bool enable_dual_filter = false;
  bool enable_order_hint = false;
  bool enable_jnt_comp = false;
  bool enable_ref_frame_mvs = false;
  int seq_force_screen_content_tools = SELECT_SCREEN_CONTENT_TOOLS;
  int seq_force_integer_mv = SELECT_INTEGER_MV;
  int order_hint_bits = 0;
  bool enable_superres = false;
  bool enable_cdef = false;
  bool enable_restoration = false;
  int bit_depth = 8;
  bool mono_chrome = false;
  int num_planes = 3;
  int subsampling_x = 1;
  int subsampling_y = 1;
  bool separate_uv_delta_q = false;
  bool film_grain_params_present = false;

  // 5.9.3 Get relative distance function
  int relative_dist(int a, int b) const {
    if (!enable_order_hint) return 0;
    const int diff = a - b;
    const int m = 1 << (order_hint_bits - 1);
    return (diff & (m - 1)) - (diff & m);
  }
};

struct SegmentationParams {
  std::array<std::array<bool, SEG_LVL_MAX>, MAX_SEGMENTS> feature_enabled{};
  std::array<std::array<std::int16_t, SEG_LVL_MAX>, MAX_SEGMENTS> feature_data{};
};

// An affine model with 16 fractional bits: gm_params of one reference, LocalWarpParams
using WarpParams = std::array<std::int32_t, 6>;
using GmParams = std::array<WarpParams, TOTAL_REFS_PER_FRAME>;

// gm_params of a frame without global motion (setup_past_independence)
GmParams default_gm_params();

// Values of one frame header under the specification's names. Arrays indexed by reference
// frame use the numbers INTRA_FRAME .. ALTREF_FRAME.
struct FrameHeader {
  bool is_shown() const { return show_frame || show_existing_frame; }
  bool is_shown_key_frame() const { return frame_type == KEY_FRAME && show_frame; }

  int temporal_id = 0;
  int spatial_id = 0;
  bool show_existing_frame = false;
  int frame_to_show_map_idx = -1;
  int frame_type = KEY_FRAME;
  bool frame_is_intra = false;
  bool show_frame = false;
  bool showable_frame = false;
  bool error_resilient_mode = false;
  bool disable_cdf_update = false;
  bool allow_screen_content_tools = false;
  bool force_integer_mv = false;
  int current_frame_id = 0;
  bool frame_size_override_flag = false;
  int order_hint = 0;
  int primary_ref_frame = PRIMARY_REF_NONE;
  int refresh_frame_flags = 0;
  bool allow_intrabc = false;
  bool frame_refs_short_signaling = false;
  std::array<int, REFS_PER_FRAME> ref_frame_idx{};
  bool allow_high_precision_mv = false;
  int interpolation_filter = EIGHTTAP;
  bool is_motion_mode_switchable = false;
  bool use_ref_frame_mvs = false;
  bool disable_frame_end_update_cdf = false;
  std::array<int, TOTAL_REFS_PER_FRAME> order_hints{};
  std::array<bool, TOTAL_REFS_PER_FRAME> ref_frame_sign_bias{};

  int frame_width = 0;
  int frame_height = 0;
  int upscaled_width = 0;
  int render_width = 0;
  int render_height = 0;
  bool use_superres = false;
  int superres_denom = SUPERRES_NUM;
  int mi_rows = 0;
  int mi_cols = 0;

  bool uniform_tile_spacing_flag = false;
  int tile_cols = 1;
  int tile_rows = 1;
  int tile_cols_log2 = 0;
  int tile_rows_log2 = 0;
  int context_update_tile_id = 0;
  int tile_size_bytes = 0;
  std::array<int, MAX_TILE_COLS + 1> mi_col_starts{};
  std::array<int, MAX_TILE_ROWS + 1> mi_row_starts{};

  int base_q_idx = 0;
  int delta_q_y_dc = 0;
  int delta_q_u_dc = 0;
  int delta_q_u_ac = 0;
  int delta_q_v_dc = 0;
  int delta_q_v_ac = 0;
  bool using_qmatrix = false;
  bool segmentation_enabled = false;
  bool segmentation_update_map = false;
  bool segmentation_temporal_update = false;
  bool segmentation_update_data = false;
  bool seg_id_pre_skip = false;
  int last_active_seg_id = 0;
  SegmentationParams segmentation;
  bool delta_q_present = false;
  int delta_q_res = 0;
  bool delta_lf_present = false;
  int delta_lf_res = 0;
  bool delta_lf_multi = false;
  bool coded_lossless = false;
  bool all_lossless = false;
  std::array<bool, MAX_SEGMENTS> lossless_array{};
  std::array<int, 4> loop_filter_level{};
  int cdef_bits = 0;
  std::array<int, 3> frame_restoration_type{};
  std::array<int, 3> loop_restoration_size{};
  int tx_mode = ONLY_4X4;
  bool reference_select = false;
  bool skip_mode_present = false;
  std::array<int, 2> skip_mode_frame{-1, -1};
  bool allow_warped_motion = false;
  bool reduced_tx_set = false;
  std::array<int, TOTAL_REFS_PER_FRAME> gm_type{};
  GmParams gm_params = default_gm_params();

  // 7.12.2 get_qindex with ignoreDeltaQ equal to 1
  int qindex(int segment_id) const;
  bool seg_feature_active(int segment_id, int feature) const {
    return segmentation_enabled && segmentation.feature_enabled[segment_id][feature];
  }
};

// The values of the frame in a reference slot that a header may refer to (section 7.20).
struct ReferenceInfo {
  bool valid = false;                   // RefValid
  int frame_id = 0;                     // RefFrameId
  int order_hint = 0;                   // RefOrderHint
  const FrameHeader* header = nullptr;  // null for an empty slot
  int bit_depth = 0;
  int subsampling_x = 0;
  int subsampling_y = 0;
};

using References = std::array<ReferenceInfo, NUM_REF_FRAMES>;

// 5.5 Sequence header OBU. Throws BitstreamError.
SequenceHeader read_sequence_header(BitReader& reader);

// 5.9 uncompressed_header( ). `references` may be changed: a shown key frame invalidates
// all of them, ref_order_hint may invalidate some (their header pointer becomes null).
// Throws BitstreamError, and LimitError for a frame of more than max_frame_size samples.
FrameHeader read_frame_header(BitReader& reader, const SequenceHeader& seq, References& references,
                              int temporal_id, int spatial_id, std::int64_t max_frame_size);

}  // namespace colmap_av1::av1

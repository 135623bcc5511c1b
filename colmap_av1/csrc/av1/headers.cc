#include "av1/headers.h"

#include <algorithm>

#include "av1/spec_tables.h"
#include "av1/subexp.h"

namespace colmap_av1::av1 {
namespace {

constexpr int kAllFrames = (1 << NUM_REF_FRAMES) - 1;
constexpr int kGmParamsK = 3;  // k of 5.9.27

// 5.5.2 Color config syntax
void read_color_config(BitReader& r, SequenceHeader& seq) {
  const bool high_bitdepth = r.flag();
  if (seq.seq_profile == 2 && high_bitdepth) {
    seq.bit_depth = r.flag() ? 12 : 10;
  } else {
    seq.bit_depth = high_bitdepth ? 10 : 8;
  }
  seq.mono_chrome = seq.seq_profile == 1 ? false : r.flag();
  seq.num_planes = seq.mono_chrome ? 1 : 3;
  int color_primaries = CP_UNSPECIFIED;
  int transfer_characteristics = TC_UNSPECIFIED;
  int matrix_coefficients = MC_UNSPECIFIED;
  if (r.flag()) {  // color_description_present_flag
    color_primaries = r.literal(8);
    transfer_characteristics = r.literal(8);
    matrix_coefficients = r.literal(8);
  }
  if (seq.mono_chrome) {
    r.bit();  // color_range
    seq.subsampling_x = seq.subsampling_y = 1;
    return;
  }
  if (color_primaries == CP_BT_709 && transfer_characteristics == TC_SRGB &&
      matrix_coefficients == MC_IDENTITY) {
    seq.subsampling_x = seq.subsampling_y = 0;
  } else {
    r.bit();  // color_range
    if (seq.seq_profile == 0) {
      seq.subsampling_x = seq.subsampling_y = 1;
    } else if (seq.seq_profile == 1) {
      seq.subsampling_x = seq.subsampling_y = 0;
    } else if (seq.bit_depth == 12) {
      seq.subsampling_x = r.bit();
      seq.subsampling_y = seq.subsampling_x ? r.bit() : 0;
    } else {
      seq.subsampling_x = 1;
      seq.subsampling_y = 0;
    }
    if (seq.subsampling_x && seq.subsampling_y) r.literal(2);  // chroma_sample_position
  }
  seq.separate_uv_delta_q = r.flag();
}

// 5.9.2 uncompressed_header( ) and the syntax it calls, one method per table.
class FrameHeaderReader {
 public:
  FrameHeaderReader(BitReader& reader, const SequenceHeader& seq, References& references,
                    std::int64_t max_frame_size)
      : r(reader), seq_(seq), refs_(references), max_frame_size_(max_frame_size) {}

  FrameHeader read(int temporal_id, int spatial_id) {
    h.temporal_id = temporal_id;
    h.spatial_id = spatial_id;
    uncompressed_header();
    return h;
  }

 private:
  BitReader& r;
  const SequenceHeader& seq_;
  References& refs_;
  std::int64_t max_frame_size_;
  FrameHeader h;

  const FrameHeader& reference(int i) const {
    const ReferenceInfo& ref = refs_[h.ref_frame_idx[i]];
    if (!ref.valid || ref.header == nullptr) {
      throw BitstreamError("frame refers to a reference slot that holds no frame");
    }
    return *ref.header;
  }

  void uncompressed_header();
  void temporal_point_info() { r.f(seq_.frame_presentation_time_length_minus_1 + 1); }
  void mark_ref_frames(int id_len);
  void set_frame_refs(int last_frame_idx, int gold_frame_idx);
  void frame_size();
  void render_size();
  void frame_size_with_refs();
  void superres_params();
  void compute_image_size();
  void check_references();
  void tile_info();
  int read_delta_q() { return r.flag() ? r.su(7) : 0; }
  void quantization_params();
  void segmentation_params();
  void delta_q_params();
  void delta_lf_params();
  void loop_filter_params();
  void cdef_params();
  void lr_params();
  void skip_mode_params();
  void global_motion_params();
  void read_global_param(const GmParams& previous, int type, int ref, int idx);
  void film_grain_params();
};

void FrameHeaderReader::uncompressed_header() {
  int id_len = 0;
  if (seq_.frame_id_numbers_present_flag) {
    id_len = seq_.additional_frame_id_length_minus_1 + seq_.delta_frame_id_length_minus_2 + 3;
  }
  const bool has_temporal_point =
      seq_.decoder_model_info_present_flag && !seq_.equal_picture_interval;
  if (seq_.reduced_still_picture_header) {
    h.frame_type = KEY_FRAME;
    h.frame_is_intra = true;
    h.show_frame = true;
    h.error_resilient_mode = true;
  } else {
    h.show_existing_frame = r.flag();
    if (h.show_existing_frame) {
      h.frame_to_show_map_idx = r.literal(3);
      if (has_temporal_point) temporal_point_info();
      if (seq_.frame_id_numbers_present_flag) r.f(id_len);  // display_frame_id
      const ReferenceInfo& ref = refs_[h.frame_to_show_map_idx];
      if (ref.header == nullptr) {
        throw BitstreamError("show_existing_frame names a slot that holds no frame");
      }
      h.frame_type = ref.header->frame_type;
      if (h.frame_type == KEY_FRAME) h.refresh_frame_flags = kAllFrames;
      return;
    }
    h.frame_type = r.literal(2);
    h.frame_is_intra = h.frame_type == INTRA_ONLY_FRAME || h.frame_type == KEY_FRAME;
    h.show_frame = r.flag();
    if (h.show_frame && has_temporal_point) temporal_point_info();
    h.showable_frame = h.show_frame ? h.frame_type != KEY_FRAME : r.flag();
    if (h.frame_type == SWITCH_FRAME || h.is_shown_key_frame()) {
      h.error_resilient_mode = true;
    } else {
      h.error_resilient_mode = r.flag();
    }
  }
  if (h.is_shown_key_frame()) {
    for (ReferenceInfo& ref : refs_) {
      ref.valid = false;
      ref.order_hint = 0;
    }
  }
  h.disable_cdf_update = r.flag();
  h.allow_screen_content_tools = seq_.seq_force_screen_content_tools == SELECT_SCREEN_CONTENT_TOOLS
                                     ? r.flag()
                                     : seq_.seq_force_screen_content_tools != 0;
  if (h.allow_screen_content_tools) {
    h.force_integer_mv =
        seq_.seq_force_integer_mv == SELECT_INTEGER_MV ? r.flag() : seq_.seq_force_integer_mv != 0;
  }
  if (h.frame_is_intra) h.force_integer_mv = true;
  if (seq_.frame_id_numbers_present_flag) {
    h.current_frame_id = r.literal(id_len);
    mark_ref_frames(id_len);
  }
  if (h.frame_type == SWITCH_FRAME) {
    h.frame_size_override_flag = true;
  } else if (!seq_.reduced_still_picture_header) {
    h.frame_size_override_flag = r.flag();
  }
  h.order_hint = r.literal(seq_.order_hint_bits);
  if (!h.frame_is_intra && !h.error_resilient_mode) h.primary_ref_frame = r.literal(3);
  if (seq_.decoder_model_info_present_flag && r.flag()) {  // buffer_removal_time_present_flag
    for (int op = 0; op <= seq_.operating_points_cnt_minus_1; ++op) {
      if (!seq_.decoder_model_present_for_this_op[op]) continue;
      const int idc = seq_.operating_point_idc[op];
      const bool in_temporal_layer = (idc >> h.temporal_id) & 1;
      const bool in_spatial_layer = (idc >> (h.spatial_id + 8)) & 1;
      if (idc == 0 || (in_temporal_layer && in_spatial_layer)) {
        r.f(seq_.buffer_removal_time_length_minus_1 + 1);
      }
    }
  }
  if (h.frame_type == SWITCH_FRAME || h.is_shown_key_frame()) {
    h.refresh_frame_flags = kAllFrames;
  } else {
    h.refresh_frame_flags = r.literal(8);
    if (h.frame_type == INTRA_ONLY_FRAME && h.refresh_frame_flags == kAllFrames) {
      throw BitstreamError("intra-only frame refreshes every reference slot");
    }
  }
  if ((!h.frame_is_intra || h.refresh_frame_flags != kAllFrames) && h.error_resilient_mode &&
      seq_.enable_order_hint) {
    for (ReferenceInfo& ref : refs_) {
      const int ref_order_hint = r.literal(seq_.order_hint_bits);
      if (ref_order_hint != ref.order_hint || !ref.valid) {
        // The frame was lost. The slot keeps the order hint, so that everything that depends only
        // on hints is parsed correctly. Using the slot as a reference is an error.
        ref.valid = false;
        ref.header = nullptr;
        ref.order_hint = ref_order_hint;
      }
    }
  }
  if (h.frame_is_intra) {
    frame_size();
    render_size();
    if (h.allow_screen_content_tools && h.upscaled_width == h.frame_width) {
      h.allow_intrabc = r.flag();
    }
  } else {
    if (seq_.enable_order_hint) {
      h.frame_refs_short_signaling = r.flag();
      if (h.frame_refs_short_signaling) {
        const int last_frame_idx = r.literal(3);
        const int gold_frame_idx = r.literal(3);
        set_frame_refs(last_frame_idx, gold_frame_idx);
      }
    }
    for (int i = 0; i < REFS_PER_FRAME; ++i) {
      if (!h.frame_refs_short_signaling) h.ref_frame_idx[i] = r.literal(3);
      if (seq_.frame_id_numbers_present_flag) {
        const int delta_frame_id = r.literal(seq_.delta_frame_id_length_minus_2 + 2) + 1;
        const int expected = (h.current_frame_id + (1 << id_len) - delta_frame_id) % (1 << id_len);
        const ReferenceInfo& ref = refs_[h.ref_frame_idx[i]];
        if (ref.frame_id != expected || !ref.valid) {
          throw BitstreamError("reference has not the frame id that the header expects");
        }
      }
    }
    if (h.frame_size_override_flag && !h.error_resilient_mode) {
      frame_size_with_refs();
    } else {
      frame_size();
      render_size();
    }
    check_references();
    h.allow_high_precision_mv = h.force_integer_mv ? false : r.flag();
    h.interpolation_filter = r.flag() ? SWITCHABLE : r.literal(2);
    h.is_motion_mode_switchable = r.flag();
    h.use_ref_frame_mvs = h.error_resilient_mode || !seq_.enable_ref_frame_mvs ? false : r.flag();
    for (int i = 0; i < REFS_PER_FRAME; ++i) {
      const int ref_frame = LAST_FRAME + i;
      const int hint = refs_[h.ref_frame_idx[i]].order_hint;
      h.order_hints[ref_frame] = hint;
      h.ref_frame_sign_bias[ref_frame] = seq_.relative_dist(hint, h.order_hint) > 0;
    }
  }
  h.disable_frame_end_update_cdf =
      seq_.reduced_still_picture_header || h.disable_cdf_update ? true : r.flag();
  if (h.primary_ref_frame != PRIMARY_REF_NONE) {
    h.segmentation = reference(h.primary_ref_frame).segmentation;
  }
  tile_info();
  quantization_params();
  segmentation_params();
  delta_q_params();
  delta_lf_params();
  h.coded_lossless = true;
  for (int segment_id = 0; segment_id < MAX_SEGMENTS; ++segment_id) {
    h.lossless_array[segment_id] = h.qindex(segment_id) == 0 && h.delta_q_y_dc == 0 &&
                                   h.delta_q_u_ac == 0 && h.delta_q_u_dc == 0 &&
                                   h.delta_q_v_ac == 0 && h.delta_q_v_dc == 0;
    if (!h.lossless_array[segment_id]) h.coded_lossless = false;
  }
  h.all_lossless = h.coded_lossless && h.frame_width == h.upscaled_width;
  loop_filter_params();
  cdef_params();
  lr_params();
  h.tx_mode = h.coded_lossless ? ONLY_4X4 : r.flag() ? TX_MODE_SELECT : TX_MODE_LARGEST;
  h.reference_select = h.frame_is_intra ? false : r.flag();
  skip_mode_params();
  h.allow_warped_motion =
      h.frame_is_intra || h.error_resilient_mode || !seq_.enable_warped_motion ? false : r.flag();
  h.reduced_tx_set = r.flag();
  global_motion_params();
  film_grain_params();
}

// 5.9.4 Reference frame marking function
void FrameHeaderReader::mark_ref_frames(int id_len) {
  const int diff_len = seq_.delta_frame_id_length_minus_2 + 2;
  const int id = h.current_frame_id;
  for (ReferenceInfo& ref : refs_) {
    if (id > (1 << diff_len)) {
      if (ref.frame_id > id || ref.frame_id < id - (1 << diff_len)) ref.valid = false;
    } else if (ref.frame_id > id && ref.frame_id < (1 << id_len) + id - (1 << diff_len)) {
      ref.valid = false;
    }
  }
}

// 7.8 Set frame refs process
void FrameHeaderReader::set_frame_refs(int last_frame_idx, int gold_frame_idx) {
  h.ref_frame_idx.fill(-1);
  h.ref_frame_idx[LAST_FRAME - LAST_FRAME] = last_frame_idx;
  h.ref_frame_idx[GOLDEN_FRAME - LAST_FRAME] = gold_frame_idx;
  std::array<bool, NUM_REF_FRAMES> used{};
  used[last_frame_idx] = used[gold_frame_idx] = true;
  const int current = 1 << (seq_.order_hint_bits - 1);
  std::array<int, NUM_REF_FRAMES> hints{};
  for (int i = 0; i < NUM_REF_FRAMES; ++i) {
    hints[i] = current + seq_.relative_dist(refs_[i].order_hint, h.order_hint);
  }
  if (hints[last_frame_idx] >= current || hints[gold_frame_idx] >= current) {
    throw BitstreamError("short reference signaling names a later frame as LAST or GOLDEN");
  }
  enum class Pick { kLatestBackward, kEarliestBackward, kLatestForward };
  const auto find = [&](Pick pick) {
    int ref = -1;
    for (int i = 0; i < NUM_REF_FRAMES; ++i) {
      const bool backward = hints[i] >= current;
      if (used[i] || backward == (pick == Pick::kLatestForward)) continue;
      const bool better = ref < 0 || (pick == Pick::kEarliestBackward ? hints[i] < hints[ref]
                                                                      : hints[i] >= hints[ref]);
      if (better) ref = i;
    }
    return ref;
  };
  const auto assign = [&](int ref_frame, Pick pick) {
    const int ref = find(pick);
    if (ref < 0) return;
    h.ref_frame_idx[ref_frame - LAST_FRAME] = ref;
    used[ref] = true;
  };
  assign(ALTREF_FRAME, Pick::kLatestBackward);
  assign(BWDREF_FRAME, Pick::kEarliestBackward);
  assign(ALTREF2_FRAME, Pick::kEarliestBackward);
  for (const int ref_frame : kRefFrameList) {
    if (h.ref_frame_idx[ref_frame - LAST_FRAME] < 0) assign(ref_frame, Pick::kLatestForward);
  }
  int earliest = 0;
  for (int i = 1; i < NUM_REF_FRAMES; ++i) {
    if (hints[i] < hints[earliest]) earliest = i;
  }
  for (int& idx : h.ref_frame_idx) {
    if (idx < 0) idx = earliest;
  }
}

// 5.9.5 Frame size syntax
void FrameHeaderReader::frame_size() {
  if (h.frame_size_override_flag) {
    h.frame_width = r.literal(seq_.frame_width_bits_minus_1 + 1) + 1;
    h.frame_height = r.literal(seq_.frame_height_bits_minus_1 + 1) + 1;
    if (h.frame_width > seq_.max_frame_width_minus_1 + 1 ||
        h.frame_height > seq_.max_frame_height_minus_1 + 1) {
      throw BitstreamError("frame is larger than the sequence header allows");
    }
  } else {
    h.frame_width = seq_.max_frame_width_minus_1 + 1;
    h.frame_height = seq_.max_frame_height_minus_1 + 1;
  }
  superres_params();
  compute_image_size();
}

// 5.9.6 Render size syntax
void FrameHeaderReader::render_size() {
  if (r.flag()) {
    h.render_width = r.literal(16) + 1;
    h.render_height = r.literal(16) + 1;
  } else {
    h.render_width = h.upscaled_width;
    h.render_height = h.frame_height;
  }
}

// 5.9.7 Frame size with refs syntax
void FrameHeaderReader::frame_size_with_refs() {
  for (int i = 0; i < REFS_PER_FRAME; ++i) {
    if (!r.flag()) continue;  // found_ref
    const FrameHeader& ref = reference(i);
    h.frame_width = ref.upscaled_width;
    h.frame_height = ref.frame_height;
    h.render_width = ref.render_width;
    h.render_height = ref.render_height;
    superres_params();
    compute_image_size();
    return;
  }
  frame_size();
  render_size();
}

// 5.9.8 Superres params syntax
void FrameHeaderReader::superres_params() {
  h.use_superres = seq_.enable_superres ? r.flag() : false;
  h.superres_denom =
      h.use_superres ? r.literal(SUPERRES_DENOM_BITS) + SUPERRES_DENOM_MIN : SUPERRES_NUM;
  h.upscaled_width = h.frame_width;
  h.frame_width = (h.upscaled_width * SUPERRES_NUM + h.superres_denom / 2) / h.superres_denom;
}

// 5.9.9 Compute image size function
void FrameHeaderReader::compute_image_size() {
  h.mi_cols = 2 * ((h.frame_width + 7) >> 3);
  h.mi_rows = 2 * ((h.frame_height + 7) >> 3);
  if (static_cast<std::int64_t>(h.upscaled_width) * h.frame_height > max_frame_size_) {
    throw LimitError("frame is larger than the limit");
  }
}

// Requirements on references: semantics of ref_frame_idx (6.8.2)
void FrameHeaderReader::check_references() {
  for (int i = 0; i < REFS_PER_FRAME; ++i) {
    const ReferenceInfo& info = refs_[h.ref_frame_idx[i]];
    if (info.header == nullptr) continue;  // an error once a block uses it
    if (info.bit_depth != seq_.bit_depth || info.subsampling_x != seq_.subsampling_x ||
        info.subsampling_y != seq_.subsampling_y) {
      throw BitstreamError("reference has another bit depth or chroma format");
    }
  }
}

// 5.9.15 Tile info syntax
void FrameHeaderReader::tile_info() {
  const auto tile_log2 = [](int block_size, int target) {
    int k = 0;
    while ((block_size << k) < target) ++k;
    return k;
  };
  const int sb_shift = seq_.use_128x128_superblock ? 5 : 4;
  const int sb_cols = (h.mi_cols + (1 << sb_shift) - 1) >> sb_shift;
  const int sb_rows = (h.mi_rows + (1 << sb_shift) - 1) >> sb_shift;
  const int sb_size = sb_shift + 2;
  const int max_tile_width_sb = MAX_TILE_WIDTH >> sb_size;
  int max_tile_area_sb = MAX_TILE_AREA >> (2 * sb_size);
  const int min_log2_tile_cols = tile_log2(max_tile_width_sb, sb_cols);
  const int max_log2_tile_cols = tile_log2(1, std::min(sb_cols, MAX_TILE_COLS));
  const int max_log2_tile_rows = tile_log2(1, std::min(sb_rows, MAX_TILE_ROWS));
  const int min_log2_tiles =
      std::max(min_log2_tile_cols, tile_log2(max_tile_area_sb, sb_rows * sb_cols));

  h.uniform_tile_spacing_flag = r.flag();
  if (h.uniform_tile_spacing_flag) {
    const auto spread = [&](int count_sb, int log2, int end, auto& starts) {
      const int tile_sb = (count_sb + (1 << log2) - 1) >> log2;
      int i = 0;
      for (int start = 0; start < count_sb; start += tile_sb) starts[i++] = start << sb_shift;
      starts[i] = end;
      return i;
    };
    h.tile_cols_log2 = min_log2_tile_cols;
    while (h.tile_cols_log2 < max_log2_tile_cols && r.flag()) ++h.tile_cols_log2;
    h.tile_cols = spread(sb_cols, h.tile_cols_log2, h.mi_cols, h.mi_col_starts);
    h.tile_rows_log2 = std::max(min_log2_tiles - h.tile_cols_log2, 0);
    while (h.tile_rows_log2 < max_log2_tile_rows && r.flag()) ++h.tile_rows_log2;
    h.tile_rows = spread(sb_rows, h.tile_rows_log2, h.mi_rows, h.mi_row_starts);
  } else {
    int widest_tile_sb = 0;
    const auto read_sizes = [&](int count_sb, int max_size, int max_tiles, int end, auto& starts) {
      int i = 0;
      for (int start = 0; start < count_sb; ++i) {
        if (i >= max_tiles) throw BitstreamError("frame has too many tiles");
        starts[i] = start << sb_shift;
        const int size_sb = r.ns(std::min(count_sb - start, max_size)) + 1;
        widest_tile_sb = std::max(widest_tile_sb, size_sb);
        start += size_sb;
      }
      starts[i] = end;
      return i;
    };
    h.tile_cols = read_sizes(sb_cols, max_tile_width_sb, MAX_TILE_COLS, h.mi_cols, h.mi_col_starts);
    h.tile_cols_log2 = tile_log2(1, h.tile_cols);
    max_tile_area_sb = sb_rows * sb_cols;
    if (min_log2_tiles > 0) max_tile_area_sb >>= min_log2_tiles + 1;
    const int max_tile_height_sb = std::max(max_tile_area_sb / widest_tile_sb, 1);
    h.tile_rows =
        read_sizes(sb_rows, max_tile_height_sb, MAX_TILE_ROWS, h.mi_rows, h.mi_row_starts);
    h.tile_rows_log2 = tile_log2(1, h.tile_rows);
  }
  if (h.tile_cols_log2 > 0 || h.tile_rows_log2 > 0) {
    h.context_update_tile_id = r.literal(h.tile_rows_log2 + h.tile_cols_log2);
    if (h.context_update_tile_id >= h.tile_cols * h.tile_rows) {
      throw BitstreamError("context_update_tile_id names no tile");
    }
    h.tile_size_bytes = r.literal(2) + 1;
  }
}

// 5.9.12 Quantization params syntax
void FrameHeaderReader::quantization_params() {
  h.base_q_idx = r.literal(8);
  h.delta_q_y_dc = read_delta_q();
  if (seq_.num_planes > 1) {
    const bool diff_uv_delta = seq_.separate_uv_delta_q ? r.flag() : false;
    h.delta_q_u_dc = read_delta_q();
    h.delta_q_u_ac = read_delta_q();
    h.delta_q_v_dc = diff_uv_delta ? read_delta_q() : h.delta_q_u_dc;
    h.delta_q_v_ac = diff_uv_delta ? read_delta_q() : h.delta_q_u_ac;
  }
  h.using_qmatrix = r.flag();
  if (h.using_qmatrix) {
    r.literal(4);                                // qm_y
    r.literal(4);                                // qm_u
    if (seq_.separate_uv_delta_q) r.literal(4);  // qm_v
  }
}

// 5.9.14 Segmentation params syntax
void FrameHeaderReader::segmentation_params() {
  h.segmentation_enabled = r.flag();
  if (h.segmentation_enabled) {
    if (h.primary_ref_frame == PRIMARY_REF_NONE) {
      h.segmentation_update_map = true;
      h.segmentation_update_data = true;
    } else {
      h.segmentation_update_map = r.flag();
      if (h.segmentation_update_map) h.segmentation_temporal_update = r.flag();
      h.segmentation_update_data = r.flag();
    }
    if (h.segmentation_update_data) {
      for (int i = 0; i < MAX_SEGMENTS; ++i) {
        for (int j = 0; j < SEG_LVL_MAX; ++j) {
          int value = 0;
          const bool enabled = r.flag();
          if (enabled) {
            const int bits = kSegmentationFeatureBits[j];
            const int limit = kSegmentationFeatureMax[j];
            value = kSegmentationFeatureSigned[j] ? std::clamp(r.su(1 + bits), -limit, limit)
                                                  : std::clamp(r.literal(bits), 0, limit);
          }
          h.segmentation.feature_enabled[i][j] = enabled;
          h.segmentation.feature_data[i][j] = static_cast<std::int16_t>(value);
        }
      }
    }
  } else {
    h.segmentation = {};
  }
  for (int i = 0; i < MAX_SEGMENTS; ++i) {
    for (int j = 0; j < SEG_LVL_MAX; ++j) {
      if (!h.segmentation.feature_enabled[i][j]) continue;
      h.last_active_seg_id = i;
      if (j >= SEG_LVL_REF_FRAME) h.seg_id_pre_skip = true;
    }
  }
}

// 5.9.17 Quantizer index delta parameters syntax
void FrameHeaderReader::delta_q_params() {
  if (h.base_q_idx > 0) h.delta_q_present = r.flag();
  if (h.delta_q_present) h.delta_q_res = r.literal(2);
}

// 5.9.18 Loop filter delta parameters syntax
void FrameHeaderReader::delta_lf_params() {
  if (!h.delta_q_present) return;
  if (!h.allow_intrabc) h.delta_lf_present = r.flag();
  if (h.delta_lf_present) {
    h.delta_lf_res = r.literal(2);
    h.delta_lf_multi = r.flag();
  }
}

// 5.9.11 Loop filter params syntax
void FrameHeaderReader::loop_filter_params() {
  if (h.coded_lossless || h.allow_intrabc) return;
  h.loop_filter_level[0] = r.literal(6);
  h.loop_filter_level[1] = r.literal(6);
  if (seq_.num_planes > 1 && (h.loop_filter_level[0] || h.loop_filter_level[1])) {
    h.loop_filter_level[2] = r.literal(6);
    h.loop_filter_level[3] = r.literal(6);
  }
  r.literal(3);                // loop_filter_sharpness
  if (r.flag() && r.flag()) {  // loop_filter_delta_enabled, loop_filter_delta_update
    for (int i = 0; i < TOTAL_REFS_PER_FRAME + 2; ++i) {
      if (r.flag()) r.su(7);  // loop_filter_ref_deltas, then loop_filter_mode_deltas
    }
  }
}

// 5.9.19 CDEF params syntax
void FrameHeaderReader::cdef_params() {
  if (h.coded_lossless || h.allow_intrabc || !seq_.enable_cdef) return;
  r.literal(2);  // cdef_damping_minus_3
  h.cdef_bits = r.literal(2);
  for (int i = 0; i < (1 << h.cdef_bits); ++i) {
    r.literal(6);                           // cdef_y_pri_strength, cdef_y_sec_strength
    if (seq_.num_planes > 1) r.literal(6);  // cdef_uv_pri_strength, cdef_uv_sec_strength
  }
}

// 5.9.20 Loop restoration params syntax
void FrameHeaderReader::lr_params() {
  h.frame_restoration_type.fill(RESTORE_NONE);
  if (h.all_lossless || h.allow_intrabc || !seq_.enable_restoration) return;
  bool uses_lr = false;
  bool uses_chroma_lr = false;
  for (int i = 0; i < seq_.num_planes; ++i) {
    h.frame_restoration_type[i] = kRemapLrType[r.literal(2)];
    if (h.frame_restoration_type[i] != RESTORE_NONE) {
      uses_lr = true;
      uses_chroma_lr |= i > 0;
    }
  }
  if (!uses_lr) return;
  int lr_unit_shift = r.bit();
  if (seq_.use_128x128_superblock) {
    ++lr_unit_shift;
  } else if (lr_unit_shift) {
    lr_unit_shift += r.bit();
  }
  h.loop_restoration_size[0] = RESTORATION_TILESIZE_MAX >> (2 - lr_unit_shift);
  const int lr_uv_shift = seq_.subsampling_x && seq_.subsampling_y && uses_chroma_lr ? r.bit() : 0;
  h.loop_restoration_size[1] = h.loop_restoration_size[0] >> lr_uv_shift;
  h.loop_restoration_size[2] = h.loop_restoration_size[1];
}

// 5.9.22 Skip mode params syntax
void FrameHeaderReader::skip_mode_params() {
  if (h.frame_is_intra || !h.reference_select || !seq_.enable_order_hint) return;
  int forward_idx = -1, forward_hint = 0;
  int backward_idx = -1, backward_hint = 0;
  for (int i = 0; i < REFS_PER_FRAME; ++i) {
    const int hint = refs_[h.ref_frame_idx[i]].order_hint;
    const int dist = seq_.relative_dist(hint, h.order_hint);
    if (dist < 0) {
      if (forward_idx < 0 || seq_.relative_dist(hint, forward_hint) > 0) {
        forward_idx = i;
        forward_hint = hint;
      }
    } else if (dist > 0) {
      if (backward_idx < 0 || seq_.relative_dist(hint, backward_hint) < 0) {
        backward_idx = i;
        backward_hint = hint;
      }
    }
  }
  int second_idx = backward_idx;
  if (forward_idx >= 0 && backward_idx < 0) {
    int second_hint = 0;
    for (int i = 0; i < REFS_PER_FRAME; ++i) {
      const int hint = refs_[h.ref_frame_idx[i]].order_hint;
      if (seq_.relative_dist(hint, forward_hint) < 0 &&
          (second_idx < 0 || seq_.relative_dist(hint, second_hint) > 0)) {
        second_idx = i;
        second_hint = hint;
      }
    }
  }
  if (forward_idx < 0 || second_idx < 0) return;
  h.skip_mode_frame = {LAST_FRAME + std::min(forward_idx, second_idx),
                       LAST_FRAME + std::max(forward_idx, second_idx)};
  h.skip_mode_present = r.flag();
}

// 5.9.24 Global motion params syntax
void FrameHeaderReader::global_motion_params() {
  if (h.frame_is_intra) return;
  const GmParams previous = h.primary_ref_frame == PRIMARY_REF_NONE
                                ? default_gm_params()
                                : reference(h.primary_ref_frame).gm_params;
  for (int ref = LAST_FRAME; ref <= ALTREF_FRAME; ++ref) {
    int type = IDENTITY;
    if (r.flag()) {                                                 // is_global
      type = r.flag() ? ROTZOOM : r.flag() ? TRANSLATION : AFFINE;  // is_rot_zoom, is_translation
    }
    h.gm_type[ref] = type;
    if (type >= ROTZOOM) {
      read_global_param(previous, type, ref, 2);
      read_global_param(previous, type, ref, 3);
      if (type == AFFINE) {
        read_global_param(previous, type, ref, 4);
        read_global_param(previous, type, ref, 5);
      } else {
        h.gm_params[ref][4] = -h.gm_params[ref][3];
        h.gm_params[ref][5] = h.gm_params[ref][2];
      }
    }
    if (type >= TRANSLATION) {
      read_global_param(previous, type, ref, 0);
      read_global_param(previous, type, ref, 1);
    }
  }
}

// 5.9.25 Global param syntax
void FrameHeaderReader::read_global_param(const GmParams& previous, int type, int ref, int idx) {
  int abs_bits = GM_ABS_ALPHA_BITS;
  int prec_bits = GM_ALPHA_PREC_BITS;
  if (idx < 2) {
    if (type == TRANSLATION) {
      abs_bits = GM_ABS_TRANS_ONLY_BITS - !h.allow_high_precision_mv;
      prec_bits = GM_TRANS_ONLY_PREC_BITS - !h.allow_high_precision_mv;
    } else {
      abs_bits = GM_ABS_TRANS_BITS;
      prec_bits = GM_TRANS_PREC_BITS;
    }
  }
  const int prec_diff = WARPEDMODEL_PREC_BITS - prec_bits;
  const int round = (idx % 3) == 2 ? 1 << WARPEDMODEL_PREC_BITS : 0;
  const int sub = (idx % 3) == 2 ? 1 << prec_bits : 0;
  const int mx = 1 << abs_bits;
  const int reference = (previous[ref][idx] >> prec_diff) - sub;
  h.gm_params[ref][idx] =
      decode_signed_subexp_with_ref(r, -mx, mx + 1, kGmParamsK, reference) * (1 << prec_diff) +
      round;
}

// 5.9.30 Film grain params syntax; the values do not affect parsing and are dropped
void FrameHeaderReader::film_grain_params() {
  if (!seq_.film_grain_params_present || (!h.show_frame && !h.showable_frame)) return;
  if (!r.flag()) return;                           // apply_grain
  r.f(16);                                         // grain_seed
  if (h.frame_type == INTER_FRAME && !r.flag()) {  // update_grain
    r.literal(3);                                  // film_grain_params_ref_idx
    return;
  }
  const auto skip_bytes = [&](int count) {
    for (int i = 0; i < count; ++i) r.literal(8);
  };
  const int num_y_points = r.literal(4);
  skip_bytes(2 * num_y_points);
  const bool chroma_scaling_from_luma = seq_.mono_chrome ? false : r.flag();
  int num_cb_points = 0;
  int num_cr_points = 0;
  if (!seq_.mono_chrome && !chroma_scaling_from_luma &&
      !(seq_.subsampling_x == 1 && seq_.subsampling_y == 1 && num_y_points == 0)) {
    num_cb_points = r.literal(4);
    skip_bytes(2 * num_cb_points);
    num_cr_points = r.literal(4);
    skip_bytes(2 * num_cr_points);
  }
  r.literal(2);  // grain_scaling_minus_8
  const int ar_coeff_lag = r.literal(2);
  const int num_pos_luma = 2 * ar_coeff_lag * (ar_coeff_lag + 1);
  const int num_pos_chroma = num_y_points ? num_pos_luma + 1 : num_pos_luma;
  if (num_y_points) skip_bytes(num_pos_luma);
  if (chroma_scaling_from_luma || num_cb_points) skip_bytes(num_pos_chroma);
  if (chroma_scaling_from_luma || num_cr_points) skip_bytes(num_pos_chroma);
  r.literal(2);  // ar_coeff_shift_minus_6
  r.literal(2);  // grain_scale_shift
  if (num_cb_points) r.f(25);
  if (num_cr_points) r.f(25);
  r.literal(2);  // overlap_flag, clip_to_restricted_range
}

}  // namespace

GmParams default_gm_params() {
  GmParams params{};
  for (auto& p : params) p[2] = p[5] = 1 << WARPEDMODEL_PREC_BITS;
  return params;
}

int FrameHeader::qindex(int segment_id) const {
  if (!seg_feature_active(segment_id, SEG_LVL_ALT_Q)) return base_q_idx;
  return std::clamp(base_q_idx + segmentation.feature_data[segment_id][SEG_LVL_ALT_Q], 0, 255);
}

SequenceHeader read_sequence_header(BitReader& r) {
  SequenceHeader seq;
  seq.seq_profile = r.literal(3);
  if (seq.seq_profile > 2) throw BitstreamError("reserved sequence profile");
  seq.still_picture = r.flag();
  seq.reduced_still_picture_header = r.flag();
  if (seq.reduced_still_picture_header && !seq.still_picture) {
    throw BitstreamError("reduced_still_picture_header without still_picture");
  }
  if (seq.reduced_still_picture_header) {
    r.literal(5);  // seq_level_idx
  } else {
    if (r.flag()) {  // timing_info_present_flag
      r.f(32);       // num_units_in_display_tick
      r.f(32);       // time_scale
      seq.equal_picture_interval = r.flag();
      if (seq.equal_picture_interval) r.uvlc();  // num_ticks_per_picture_minus_1
      seq.decoder_model_info_present_flag = r.flag();
      if (seq.decoder_model_info_present_flag) {
        seq.buffer_delay_length_minus_1 = r.literal(5);
        r.f(32);  // num_units_in_decoding_tick
        seq.buffer_removal_time_length_minus_1 = r.literal(5);
        seq.frame_presentation_time_length_minus_1 = r.literal(5);
      }
    }
    const bool initial_display_delay_present_flag = r.flag();
    seq.operating_points_cnt_minus_1 = r.literal(5);
    for (int i = 0; i <= seq.operating_points_cnt_minus_1; ++i) {
      seq.operating_point_idc[i] = r.literal(12);
      const int seq_level_idx = r.literal(5);
      if (seq_level_idx > 7) r.bit();  // seq_tier
      if (seq.decoder_model_info_present_flag) {
        seq.decoder_model_present_for_this_op[i] = r.flag();
        if (seq.decoder_model_present_for_this_op[i]) {
          r.f(seq.buffer_delay_length_minus_1 + 1);  // decoder_buffer_delay
          r.f(seq.buffer_delay_length_minus_1 + 1);  // encoder_buffer_delay
          r.bit();                                   // low_delay_mode_flag
        }
      }
      if (initial_display_delay_present_flag && r.flag()) r.literal(4);
    }
  }
  seq.frame_width_bits_minus_1 = r.literal(4);
  seq.frame_height_bits_minus_1 = r.literal(4);
  seq.max_frame_width_minus_1 = r.literal(seq.frame_width_bits_minus_1 + 1);
  seq.max_frame_height_minus_1 = r.literal(seq.frame_height_bits_minus_1 + 1);
  if (!seq.reduced_still_picture_header) seq.frame_id_numbers_present_flag = r.flag();
  if (seq.frame_id_numbers_present_flag) {
    seq.delta_frame_id_length_minus_2 = r.literal(4);
    seq.additional_frame_id_length_minus_1 = r.literal(3);
    if (seq.additional_frame_id_length_minus_1 + seq.delta_frame_id_length_minus_2 + 3 > 16) {
      throw BitstreamError("frame id is longer than 16 bits");
    }
  }
  seq.use_128x128_superblock = r.flag();
  seq.enable_filter_intra = r.flag();
  seq.enable_intra_edge_filter = r.flag();
  if (!seq.reduced_still_picture_header) {
    seq.enable_interintra_compound = r.flag();
    seq.enable_masked_compound = r.flag();
    seq.enable_warped_motion = r.flag();
    seq.enable_dual_filter = r.flag();
    seq.enable_order_hint = r.flag();
    if (seq.enable_order_hint) {
      seq.enable_jnt_comp = r.flag();
      seq.enable_ref_frame_mvs = r.flag();
    }
    seq.seq_force_screen_content_tools =
        r.flag() ? SELECT_SCREEN_CONTENT_TOOLS : r.bit();  // seq_choose_screen_content_tools
    if (seq.seq_force_screen_content_tools > 0) {
      seq.seq_force_integer_mv = r.flag() ? SELECT_INTEGER_MV : r.bit();  // seq_choose_integer_mv
    }
    if (seq.enable_order_hint) seq.order_hint_bits = r.literal(3) + 1;
  }
  seq.enable_superres = r.flag();
  seq.enable_cdef = r.flag();
  seq.enable_restoration = r.flag();
  read_color_config(r, seq);
  seq.film_grain_params_present = r.flag();
  return seq;
}

FrameHeader read_frame_header(BitReader& reader, const SequenceHeader& seq, References& references,
                              int temporal_id, int spatial_id, std::int64_t max_frame_size) {
  return FrameHeaderReader(reader, seq, references, max_frame_size).read(temporal_id, spatial_id);
}

}  // namespace colmap_av1::av1

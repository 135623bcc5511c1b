// Mode info of intra and inter blocks (specification sections 5.11.6 to 5.11.34; the CDFs are
// chosen as in 8.3.2).
#include <algorithm>
#include <cstdlib>

#include "av1/error.h"
#include "av1/spec_tables.h"
#include "av1/tile_parser.h"

namespace colmap_av1::av1 {
namespace {

bool is_directional_mode(int mode) { return mode >= V_PRED && mode <= D67_PRED; }

bool has_nearmv(int y_mode) {
  return y_mode == NEARMV || y_mode == NEAR_NEARMV || y_mode == NEAR_NEWMV || y_mode == NEW_NEARMV;
}

// 5.11.9: maps the coded value back around the predicted segment
int neg_deinterleave(int diff, int ref, int max) {
  if (!ref) return diff;
  if (ref >= max - 1) return max - diff - 1;
  const bool low = 2 * ref < max;
  if (diff <= 2 * (low ? ref : max - ref - 1)) {
    return diff & 1 ? ref + ((diff + 1) >> 1) : ref - (diff >> 1);
  }
  return low ? diff : max - (diff + 1);
}

}  // namespace

// 5.11.7 Intra frame mode info syntax
void TileParser::intra_frame_mode_info() {
  if (header_->seg_id_pre_skip) intra_segment_id();
  read_skip();
  if (!header_->seg_id_pre_skip) intra_segment_id();
  read_cdef();
  read_delta_qindex();
  read_delta_lf();
  read_deltas_ = false;
  if (header_->allow_intrabc && read_flag(cdf_.intrabc)) {
    b_->use_intrabc = true;
    b_->is_inter = true;
    b_->compound_type = COMPOUND_AVERAGE;
    b_->interp_filter = {BILINEAR, BILINEAR};
    assign_mv(find_mv_stack(*frame_, tile_, *b_), 0);
    return;
  }
  const int above_ctx = kIntraModeContext[above_ ? above_->y_mode : DC_PRED];
  const int left_ctx = kIntraModeContext[left_ ? left_->y_mode : DC_PRED];
  b_->y_mode = static_cast<std::uint8_t>(read(cdf_.intra_frame_y_mode[above_ctx][left_ctx]));
  intra_modes_after_y_mode();
}

// 5.11.8 Intra segment ID syntax
void TileParser::intra_segment_id() {
  if (header_->segmentation_enabled) read_segment_id();
  lossless_ = header_->lossless_array[b_->segment_id];
}

// 5.11.9 Read segment ID syntax
void TileParser::read_segment_id() {
  const int prev_u = above_ ? above_->segment_id : -1;
  const int prev_l = left_ ? left_->segment_id : -1;
  const int prev_ul = above_ && left_ ? frame_->at(b_->mi_row - 1, b_->mi_col - 1)->segment_id : -1;
  int pred;
  if (prev_u == -1) {
    pred = prev_l == -1 ? 0 : prev_l;
  } else if (prev_l == -1) {
    pred = prev_u;
  } else {
    pred = prev_ul == prev_u ? prev_u : prev_l;
  }
  if (b_->skip) {
    b_->segment_id = static_cast<std::uint8_t>(pred);
    return;
  }
  int ctx = 0;
  if (prev_ul >= 0) {
    if (prev_ul == prev_u && prev_ul == prev_l) {
      ctx = 2;
    } else if (prev_ul == prev_u || prev_ul == prev_l || prev_u == prev_l) {
      ctx = 1;
    }
  }
  const int last = header_->last_active_seg_id;
  const int segment_id = neg_deinterleave(read(cdf_.segment_id[ctx]), pred, last + 1);
  if (segment_id < 0 || segment_id > last) throw BitstreamError("segment_id is out of range");
  b_->segment_id = static_cast<std::uint8_t>(segment_id);
}

// 5.11.18 Inter frame mode info syntax
void TileParser::inter_frame_mode_info() {
  left_ref_frame_ = left_ ? std::array<int, 2>{left_->ref_frame[0], left_->ref_frame[1]}
                          : std::array<int, 2>{INTRA_FRAME, NONE};
  above_ref_frame_ = above_ ? std::array<int, 2>{above_->ref_frame[0], above_->ref_frame[1]}
                            : std::array<int, 2>{INTRA_FRAME, NONE};
  left_intra_ = left_ref_frame_[0] <= INTRA_FRAME;
  above_intra_ = above_ref_frame_[0] <= INTRA_FRAME;
  left_single_ = left_ref_frame_[1] <= INTRA_FRAME;
  above_single_ = above_ref_frame_[1] <= INTRA_FRAME;
  inter_segment_id(true);
  read_skip_mode();
  if (b_->skip_mode) {
    b_->skip = true;
  } else {
    read_skip();
  }
  if (!header_->seg_id_pre_skip) inter_segment_id(false);
  lossless_ = header_->lossless_array[b_->segment_id];
  read_cdef();
  read_delta_qindex();
  read_delta_lf();
  read_deltas_ = false;
  read_is_inter();
  if (b_->is_inter) {
    inter_block_mode_info();
  } else {
    intra_block_mode_info();
  }
}

void TileParser::set_seg_pred_context(bool predicted) {
  std::fill_n(above_seg_pred_.begin() + b_->mi_col, bw4_, predicted);
  std::fill_n(left_seg_pred_.begin() + (b_->mi_row & kSbMask), bh4_, predicted);
}

// 5.11.19 Inter segment ID syntax
void TileParser::inter_segment_id(bool pre_skip) {
  if (!header_->segmentation_enabled) return;
  if (!header_->segmentation_update_map) {
    b_->segment_id = static_cast<std::uint8_t>(predicted_segment_id());
    return;
  }
  if (pre_skip && !header_->seg_id_pre_skip) {
    b_->segment_id = 0;
    return;
  }
  if (!pre_skip && b_->skip) {
    set_seg_pred_context(false);
    read_segment_id();
    return;
  }
  if (!header_->segmentation_temporal_update) {
    read_segment_id();
    return;
  }
  const int ctx = left_seg_pred_[b_->mi_row & kSbMask] + above_seg_pred_[b_->mi_col];
  const bool seg_id_predicted = read_flag(cdf_.segment_id_predicted[ctx]);
  if (seg_id_predicted) {
    b_->segment_id = static_cast<std::uint8_t>(predicted_segment_id());
  } else {
    read_segment_id();
  }
  set_seg_pred_context(seg_id_predicted);
}

// 5.11.21 Get segment ID function
int TileParser::predicted_segment_id() const {
  if (frame_->prev_segment_ids == nullptr) return 0;
  const int rows = std::min(header_->mi_rows - b_->mi_row, bh4_);
  const int cols = std::min(header_->mi_cols - b_->mi_col, bw4_);
  int seg = 7;
  for (int y = 0; y < rows; ++y) {
    const std::uint8_t* ids = frame_->prev_segment_ids +
                              static_cast<std::ptrdiff_t>(b_->mi_row + y) * header_->mi_cols +
                              b_->mi_col;
    for (int x = 0; x < cols; ++x) seg = std::min<int>(seg, ids[x]);
  }
  return seg;
}

// 5.11.10 Skip mode syntax
void TileParser::read_skip_mode() {
  if (!header_->skip_mode_present || seg_feature_active(SEG_LVL_SKIP) ||
      seg_feature_active(SEG_LVL_REF_FRAME) || seg_feature_active(SEG_LVL_GLOBALMV) ||
      !b_->is_at_least_8x8()) {
    return;
  }
  const int ctx = (above_ && above_->skip_mode) + (left_ && left_->skip_mode);
  b_->skip_mode = read_flag(cdf_.skip_mode[ctx]);
}

// 5.11.11 Skip syntax
void TileParser::read_skip() {
  if (header_->seg_id_pre_skip && seg_feature_active(SEG_LVL_SKIP)) {
    b_->skip = true;
    return;
  }
  const int ctx = (above_ && above_->skip) + (left_ && left_->skip);
  b_->skip = read_flag(cdf_.skip[ctx]);
}

// 5.11.20 Is inter syntax
void TileParser::read_is_inter() {
  if (b_->skip_mode) {
    b_->is_inter = true;
  } else if (seg_feature_active(SEG_LVL_REF_FRAME)) {
    b_->is_inter =
        header_->segmentation.feature_data[b_->segment_id][SEG_LVL_REF_FRAME] != INTRA_FRAME;
  } else if (seg_feature_active(SEG_LVL_GLOBALMV)) {
    b_->is_inter = true;
  } else {
    int ctx = 0;
    if (above_ && left_) {
      ctx = left_intra_ && above_intra_ ? 3 : left_intra_ || above_intra_;
    } else if (above_ || left_) {
      ctx = 2 * (above_ ? above_intra_ : left_intra_);
    }
    b_->is_inter = read_flag(cdf_.is_inter[ctx]);
  }
}

// 5.11.22 Intra block mode info syntax
void TileParser::intra_block_mode_info() {
  b_->y_mode = static_cast<std::uint8_t>(read(cdf_.y_mode[kSizeGroup[b_->mi_size]]));
  intra_modes_after_y_mode();
}

// The common part of both intra tables: angles, chroma mode, palette, filter intra (5.11.42 to
// 5.11.46)
void TileParser::intra_modes_after_y_mode() {
  const bool has_angles = b_->mi_size >= BLOCK_8X8;
  if (has_angles && is_directional_mode(b_->y_mode)) {
    b_->angle_delta_y =
        static_cast<std::int8_t>(read(cdf_.angle_delta[b_->y_mode - V_PRED]) - MAX_ANGLE_DELTA);
  }
  if (b_->has_chroma) {
    const int width = kBlockWidth[b_->mi_size];
    const int height = kBlockHeight[b_->mi_size];
    const bool cfl_allowed =
        lossless_
            ? kSubsampledSize[b_->mi_size][seq_->subsampling_x][seq_->subsampling_y] == BLOCK_4X4
            : std::max(width, height) <= 32;
    b_->uv_mode =
        static_cast<std::uint8_t>(cfl_allowed ? read(cdf_.uv_mode_cfl_allowed[b_->y_mode])
                                              : read(cdf_.uv_mode_cfl_not_allowed[b_->y_mode]));
    if (b_->uv_mode == UV_CFL_PRED) read_cfl_alphas();
    if (has_angles && is_directional_mode(b_->uv_mode)) {
      b_->angle_delta_uv =
          static_cast<std::int8_t>(read(cdf_.angle_delta[b_->uv_mode - V_PRED]) - MAX_ANGLE_DELTA);
    }
  }
  if (b_->mi_size >= BLOCK_8X8 && kBlockWidth[b_->mi_size] <= 64 &&
      kBlockHeight[b_->mi_size] <= 64 && header_->allow_screen_content_tools) {
    palette_mode_info();
  }
  filter_intra_mode_info();
}

// 5.11.45 Read CFL alphas syntax
void TileParser::read_cfl_alphas() {
  const int signs = read(cdf_.cfl_sign);
  const int sign_u = (signs + 1) / 3;
  const int sign_v = (signs + 1) % 3;
  int alpha_u = 0;
  int alpha_v = 0;
  if (sign_u != CFL_SIGN_ZERO) alpha_u = read(cdf_.cfl_alpha[(sign_u - 1) * 3 + sign_v]);
  if (sign_v != CFL_SIGN_ZERO) alpha_v = read(cdf_.cfl_alpha[(sign_v - 1) * 3 + sign_u]);
  b_->cfl_alpha_signs = static_cast<std::uint8_t>(signs);
  b_->cfl_alpha_idx = static_cast<std::uint8_t>(alpha_u * CFL_ALPHABET_SIZE + alpha_v);
}

// 5.11.24 Filter intra mode info syntax
void TileParser::filter_intra_mode_info() {
  if (!seq_->enable_filter_intra || b_->y_mode != DC_PRED || b_->palette_size[0] != 0 ||
      std::max(kBlockWidth[b_->mi_size], kBlockHeight[b_->mi_size]) > 32) {
    return;
  }
  b_->use_filter_intra = read_flag(cdf_.filter_intra[b_->mi_size]);
  if (b_->use_filter_intra) {
    b_->filter_intra_mode = static_cast<std::uint8_t>(read(cdf_.filter_intra_mode));
  }
}

// 5.11.23 Inter block mode info syntax
void TileParser::inter_block_mode_info() {
  read_ref_frames();
  const MvStack stack = find_mv_stack(*frame_, tile_, *b_);
  if (b_->skip_mode) {
    b_->y_mode = NEAREST_NEARESTMV;
  } else if (seg_feature_active(SEG_LVL_SKIP) || seg_feature_active(SEG_LVL_GLOBALMV)) {
    b_->y_mode = GLOBALMV;
  } else if (b_->is_compound()) {
    const int ctx = kCompoundModeCtxMap[stack.ref_mv_context >> 1]
                                       [std::min(stack.new_mv_context, COMP_NEWMV_CTXS - 1)];
    b_->y_mode = static_cast<std::uint8_t>(NEAREST_NEARESTMV + read(cdf_.compound_mode[ctx]));
  } else if (!read_flag(cdf_.new_mv[stack.new_mv_context])) {
    b_->y_mode = NEWMV;
  } else if (!read_flag(cdf_.zero_mv[stack.zero_mv_context])) {
    b_->y_mode = GLOBALMV;
  } else {
    b_->y_mode = read_flag(cdf_.ref_mv[stack.ref_mv_context]) ? NEARMV : NEARESTMV;
  }
  int ref_mv_idx = 0;
  if (b_->y_mode == NEWMV || b_->y_mode == NEW_NEWMV) {
    ref_mv_idx = read_drl(stack, 0);
  } else if (has_nearmv(b_->y_mode)) {
    ref_mv_idx = read_drl(stack, 1);
  }
  assign_mv(stack, ref_mv_idx);
  read_interintra_mode();
  read_motion_mode();
  read_compound_type();
  read_interp_filters();
}

int TileParser::read_drl(const MvStack& stack, int first) {
  int ref_mv_idx = first;
  for (int idx = first; idx < first + 2; ++idx) {
    if (stack.num_mv_found > idx + 1) {
      if (!read_flag(cdf_.drl_mode[stack.drl_context[idx]])) return idx;
      ref_mv_idx = idx + 1;
    }
  }
  return ref_mv_idx;
}

bool TileParser::needs_interp_filter() const {
  const bool large = b_->is_at_least_8x8();
  if (b_->skip_mode || b_->motion_mode == LOCALWARP) return false;
  if (large && b_->y_mode == GLOBALMV) {
    return header_->gm_type[b_->ref_frame[0]] == TRANSLATION;
  }
  if (large && b_->y_mode == GLOBAL_GLOBALMV) {
    return header_->gm_type[b_->ref_frame[0]] == TRANSLATION ||
           header_->gm_type[b_->ref_frame[1]] == TRANSLATION;
  }
  return true;
}

void TileParser::read_interp_filters() {
  if (header_->interpolation_filter != SWITCHABLE) {
    b_->interp_filter.fill(static_cast<std::uint8_t>(header_->interpolation_filter));
    return;
  }
  const bool needed = needs_interp_filter();
  for (int dir = 0; dir < (seq_->enable_dual_filter ? 2 : 1); ++dir) {
    b_->interp_filter[dir] = EIGHTTAP;
    if (!needed) continue;
    const auto neighbour_type = [&](const BlockInfo* n) {
      if (n && (n->ref_frame[0] == b_->ref_frame[0] || n->ref_frame[1] == b_->ref_frame[0])) {
        return static_cast<int>(n->interp_filter[dir]);
      }
      return 3;
    };
    int ctx = ((dir & 1) * 2 + b_->is_compound()) * 4;
    const int left_type = neighbour_type(left_);
    const int above_type = neighbour_type(above_);
    if (left_type == above_type) {
      ctx += left_type;
    } else if (left_type == 3) {
      ctx += above_type;
    } else if (above_type == 3) {
      ctx += left_type;
    } else {
      ctx += 3;
    }
    b_->interp_filter[dir] = static_cast<std::uint8_t>(read(cdf_.interp_filter[ctx]));
  }
  if (!seq_->enable_dual_filter) b_->interp_filter[1] = b_->interp_filter[0];
}

// 5.11.27 Read motion mode syntax
void TileParser::read_motion_mode() {
  if (b_->skip_mode || !header_->is_motion_mode_switchable || !b_->is_at_least_8x8()) return;
  if (!header_->force_integer_mv && (b_->y_mode == GLOBALMV || b_->y_mode == GLOBAL_GLOBALMV) &&
      header_->gm_type[b_->ref_frame[0]] > TRANSLATION) {
    return;
  }
  if (b_->ref_frame[1] >= INTRA_FRAME ||
      !has_overlappable_candidates(*frame_, *b_, above_, left_)) {
    return;
  }
  const WarpSamples found = find_warp_samples(*frame_, tile_, *b_, above_, left_);
  if (header_->force_integer_mv || found.count == 0 || !header_->allow_warped_motion ||
      frame_->ref_scaled[b_->ref_frame[0]]) {
    b_->motion_mode = read_flag(cdf_.use_obmc[b_->mi_size]) ? OBMC : SIMPLE;
  } else {
    b_->motion_mode = static_cast<std::uint8_t>(read(cdf_.motion_mode[b_->mi_size]));
  }
  if (b_->motion_mode == LOCALWARP) {
    b_->num_samples = static_cast<std::uint8_t>(found.count);
    b_->local_warp = static_cast<std::int32_t>(local_warps_.size());
    local_warps_.push_back(estimate_local_warp(
        *b_, std::span(found.samples).first(static_cast<std::size_t>(found.count))));
  }
}

// 5.11.28 Read inter intra syntax
void TileParser::read_interintra_mode() {
  if (b_->skip_mode || !seq_->enable_interintra_compound || b_->is_compound() ||
      b_->mi_size < BLOCK_8X8 || b_->mi_size > BLOCK_32X32) {
    return;
  }
  const int ctx = kSizeGroup[b_->mi_size] - 1;
  b_->interintra = read_flag(cdf_.inter_intra[ctx]);
  if (!b_->interintra) return;
  b_->interintra_mode = static_cast<std::uint8_t>(read(cdf_.inter_intra_mode[ctx]));
  b_->ref_frame[1] = INTRA_FRAME;
  b_->wedge_interintra = read_flag(cdf_.wedge_inter_intra[b_->mi_size]);
  if (b_->wedge_interintra) {
    b_->wedge_index = static_cast<std::uint8_t>(read(cdf_.wedge_index[b_->mi_size]));
  }
}

// 5.11.29 Read compound type syntax
void TileParser::read_compound_type() {
  b_->compound_idx = 1;
  b_->compound_type = COMPOUND_AVERAGE;
  if (b_->skip_mode) return;
  if (!b_->is_compound()) {
    if (b_->interintra) {
      b_->compound_type = b_->wedge_interintra ? COMPOUND_WEDGE : COMPOUND_INTRA;
    }
    return;
  }
  // The contexts of comp_group_idx and compound_idx are sums over the neighbours.
  const auto neighbour = [&](const BlockInfo* n, bool single, int ref_frame, bool group) {
    if (!n) return 0;
    if (!single) return static_cast<int>(group ? n->comp_group_idx : n->compound_idx);
    return ref_frame == ALTREF_FRAME ? (group ? 3 : 1) : 0;
  };
  const auto context = [&](bool group) {
    return neighbour(above_, above_single_, above_ref_frame_[0], group) +
           neighbour(left_, left_single_, left_ref_frame_[0], group);
  };
  if (seq_->enable_masked_compound) {
    b_->comp_group_idx = read_flag(cdf_.comp_group_idx[std::min(5, context(true))]);
  }
  if (b_->comp_group_idx == 0) {
    if (seq_->enable_jnt_comp) {
      const auto distance = [&](int list) {
        return std::abs(
            seq_->relative_dist(header_->order_hints[b_->ref_frame[list]], header_->order_hint));
      };
      const int ctx = (distance(0) == distance(1) ? 3 : 0) + context(false);
      b_->compound_idx = read_flag(cdf_.compound_idx[ctx]);
      b_->compound_type = b_->compound_idx ? COMPOUND_AVERAGE : COMPOUND_DISTANCE;
    }
  } else if (kWedgeBits[b_->mi_size] == 0) {
    b_->compound_type = COMPOUND_DIFFWTD;
  } else {
    b_->compound_type = static_cast<std::uint8_t>(read(cdf_.compound_type[b_->mi_size]));
  }
  if (b_->compound_type == COMPOUND_WEDGE) {
    b_->wedge_index = static_cast<std::uint8_t>(read(cdf_.wedge_index[b_->mi_size]));
    b_->wedge_sign = static_cast<std::uint8_t>(symbols_.literal(1));
  } else if (b_->compound_type == COMPOUND_DIFFWTD) {
    b_->mask_type = static_cast<std::uint8_t>(symbols_.literal(1));
  }
}

}  // namespace colmap_av1::av1

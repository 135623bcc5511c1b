// Tile, partition and block syntax with the filter parameters that are interleaved with it
// (specification sections 5.11.2 to 5.11.5, 5.11.12, 5.11.13, 5.11.55 to 5.11.58).
#include <algorithm>

#include "av1/error.h"
#include "av1/spec_tables.h"
#include "av1/subexp.h"
#include "av1/tile_parser.h"

namespace colmap_av1::av1 {

void TileParser::parse(FrameContext& frame, int tile_row, int tile_col,
                       std::span<const std::uint8_t> data, BlockInfo* blocks) {
  frame_ = &frame;
  seq_ = frame.seq;
  header_ = frame.header;
  tile_ = {header_->mi_row_starts[tile_row], header_->mi_row_starts[tile_row + 1],
           header_->mi_col_starts[tile_col], header_->mi_col_starts[tile_col + 1]};
  first_block_ = next_block_ = blocks;
  local_warps_.clear();
  current_q_index_ = header_->base_q_idx;
  cdf_ = frame.cdfs;
  symbols_.init(data, header_->disable_cdf_update);
  decode_tile();
  const TrailingBits trailing_bits = symbols_.trailing_bits();
  if (trailing_bits == TrailingBits::kPastEnd) {
    throw BitstreamError("tile ends before its last symbol");
  }
  if (trailing_bits == TrailingBits::kData) {
    throw BitstreamError("tile goes on after its last symbol");
  }
  trailing_bits_valid_ = trailing_bits == TrailingBits::kValid;
}

// 5.11.2 Decode tile syntax
void TileParser::decode_tile() {
  // clear_above_context( ); blocks may extend beyond the frame by the width of a superblock
  const std::size_t columns = static_cast<std::size_t>(header_->mi_cols) + kMaxSb4;
  coefficients_.start_tile(*seq_, *header_);
  above_seg_pred_.assign(columns, 0);
  above_tx_width_.resize(columns);
  if (header_->allow_screen_content_tools) {
    for (auto& palette : above_palette_) palette.resize(columns);
  }
  delta_lf_.fill(0);
  for (int plane = 0; plane < seq_->num_planes; ++plane) {
    for (int pass = 0; pass < 2; ++pass) {
      ref_sgr_xqd_[plane][pass] = kSgrprojXqdMid[pass];
      for (int i = 0; i < WIENER_COEFFS; ++i) ref_lr_wiener_[plane][pass][i] = kWienerTapsMid[i];
    }
  }
  const int sb_size = seq_->use_128x128_superblock ? BLOCK_128X128 : BLOCK_64X64;
  const int sb_size4 = kNum4x4BlocksWide[sb_size];
  for (int r = tile_.mi_row_start; r < tile_.mi_row_end; r += sb_size4) {
    coefficients_.clear_left_context();
    left_seg_pred_.fill(0);
    for (int c = tile_.mi_col_start; c < tile_.mi_col_end; c += sb_size4) {
      read_deltas_ = header_->delta_q_present;
      clear_cdef();
      read_lr(r, c, sb_size);
      decode_partition(r, c, sb_size);
      if (symbols_.is_past_end()) throw BitstreamError("tile ends before its last superblock");
    }
  }
}

// 5.11.4 Decode partition syntax
void TileParser::decode_partition(int r, int c, int b_size) {
  if (r >= header_->mi_rows || c >= header_->mi_cols) return;
  const int half = kNum4x4BlocksWide[b_size] >> 1;
  const int quarter = half >> 1;
  const bool has_rows = r + half < header_->mi_rows;
  const bool has_cols = c + half < header_->mi_cols;
  int partition = PARTITION_NONE;
  if (b_size >= BLOCK_8X8) {
    const int bsl = kMiWidthLog2[b_size];
    const bool above =
        tile_.contains(r - 1, c) && kMiWidthLog2[frame_->at(r - 1, c)->mi_size] < bsl;
    const bool left =
        tile_.contains(r, c - 1) && kMiHeightLog2[frame_->at(r, c - 1)->mi_size] < bsl;
    const int ctx = left * 2 + above;
    if (has_rows && has_cols) {
      partition = bsl == 1   ? read(cdf_.partition_w8[ctx])
                  : bsl == 2 ? read(cdf_.partition_w16[ctx])
                  : bsl == 3 ? read(cdf_.partition_w32[ctx])
                  : bsl == 4 ? read(cdf_.partition_w64[ctx])
                             : read(cdf_.partition_w128[ctx]);
    } else if (has_cols || has_rows) {
      // split_or_horz, split_or_vert (8.3.2): sums of the partitions' probabilities
      const std::uint16_t* icdf = bsl == 1   ? cdf_.partition_w8[ctx]
                                  : bsl == 2 ? cdf_.partition_w16[ctx]
                                  : bsl == 3 ? cdf_.partition_w32[ctx]
                                  : bsl == 4 ? cdf_.partition_w64[ctx]
                                             : cdf_.partition_w128[ctx];
      const auto probability = [&](int p) {
        return static_cast<std::uint32_t>((p > 0 ? icdf[p - 1] : 32768) - icdf[p]);
      };
      std::uint32_t psum;
      if (has_cols) {
        psum = probability(PARTITION_VERT) + probability(PARTITION_SPLIT);
        if (bsl > 1) {
          psum += probability(PARTITION_HORZ_A) + probability(PARTITION_VERT_A) +
                  probability(PARTITION_VERT_B);
          if (b_size != BLOCK_128X128) psum += probability(PARTITION_VERT_4);
        }
      } else {
        psum = probability(PARTITION_HORZ) + probability(PARTITION_SPLIT);
        if (bsl > 1) {
          psum += probability(PARTITION_HORZ_A) + probability(PARTITION_HORZ_B) +
                  probability(PARTITION_VERT_A);
          if (b_size != BLOCK_128X128) psum += probability(PARTITION_HORZ_4);
        }
      }
      const bool split = symbols_.flag_without_update(psum);
      partition = split ? PARTITION_SPLIT : has_cols ? PARTITION_HORZ : PARTITION_VERT;
    } else {
      partition = PARTITION_SPLIT;
    }
  }
  const int sub_size = kPartitionSubsize[partition][b_size];
  const int split_size = kPartitionSubsize[PARTITION_SPLIT][b_size];
  if (sub_size >= BLOCK_INVALID ||
      kSubsampledSize[sub_size][seq_->subsampling_x][seq_->subsampling_y] >= BLOCK_INVALID) {
    throw BitstreamError("partition gives a block size that the chroma format does not allow");
  }
  const auto block = [&](int row, int col, int size) { decode_block(row, col, size, partition); };
  switch (partition) {
    case PARTITION_NONE: block(r, c, sub_size); break;
    case PARTITION_HORZ:
      block(r, c, sub_size);
      if (has_rows) block(r + half, c, sub_size);
      break;
    case PARTITION_VERT:
      block(r, c, sub_size);
      if (has_cols) block(r, c + half, sub_size);
      break;
    case PARTITION_SPLIT:
      decode_partition(r, c, sub_size);
      decode_partition(r, c + half, sub_size);
      decode_partition(r + half, c, sub_size);
      decode_partition(r + half, c + half, sub_size);
      break;
    case PARTITION_HORZ_A:
      block(r, c, split_size);
      block(r, c + half, split_size);
      block(r + half, c, sub_size);
      break;
    case PARTITION_HORZ_B:
      block(r, c, sub_size);
      block(r + half, c, split_size);
      block(r + half, c + half, split_size);
      break;
    case PARTITION_VERT_A:
      block(r, c, split_size);
      block(r + half, c, split_size);
      block(r, c + half, sub_size);
      break;
    case PARTITION_VERT_B:
      block(r, c, sub_size);
      block(r, c + half, split_size);
      block(r + half, c + half, split_size);
      break;
    case PARTITION_HORZ_4:
      for (int i = 0; i < 4; ++i) {
        if (i < 3 || r + quarter * 3 < header_->mi_rows) block(r + quarter * i, c, sub_size);
      }
      break;
    default:  // PARTITION_VERT_4
      for (int i = 0; i < 4; ++i) {
        if (i < 3 || c + quarter * 3 < header_->mi_cols) block(r, c + quarter * i, sub_size);
      }
      break;
  }
}

// 5.11.5 Decode block syntax
void TileParser::decode_block(int r, int c, int sub_size, int partition) {
  b_ = next_block_++;
  *b_ = BlockInfo{};
  b_->mi_row = static_cast<std::uint16_t>(r);
  b_->mi_col = static_cast<std::uint16_t>(c);
  b_->mi_size = static_cast<std::uint8_t>(sub_size);
  b_->partition = static_cast<std::uint8_t>(partition);
  bw4_ = kNum4x4BlocksWide[sub_size];
  bh4_ = kNum4x4BlocksHigh[sub_size];
  b_->has_chroma = seq_->num_planes > 1 && !(bh4_ == 1 && seq_->subsampling_y && (r & 1) == 0) &&
                   !(bw4_ == 1 && seq_->subsampling_x && (c & 1) == 0);
  above_ = tile_.contains(r - 1, c) ? frame_->at(r - 1, c) : nullptr;
  left_ = tile_.contains(r, c - 1) ? frame_->at(r, c - 1) : nullptr;
  if (header_->frame_is_intra) {
    intra_frame_mode_info();
  } else {
    inter_frame_mode_info();
  }
  b_->current_q_index = static_cast<std::int16_t>(current_q_index_);
  b_->delta_lf = delta_lf_;
  if (header_->allow_screen_content_tools) {
    palette_tokens();
    save_palette_colors();
  }
  read_block_tx_size();
  if (b_->skip) coefficients_.reset_block_context(*b_);
  const int rows = std::min(bh4_, header_->mi_rows - r);
  const int cols = std::min(bw4_, header_->mi_cols - c);
  for (int y = 0; y < rows; ++y) std::fill_n(&frame_->at(r + y, c), cols, b_);
  if (!b_->skip) residual();
}

// 5.11.56 Read CDEF syntax
void TileParser::read_cdef() {
  if (b_->skip || header_->coded_lossless || !seq_->enable_cdef || header_->allow_intrabc) return;
  const int mask = seq_->use_128x128_superblock ? 1 : 0;
  const int row64 = (b_->mi_row >> 4) & mask;
  const int col64 = (b_->mi_col >> 4) & mask;
  if (cdef_idx_[row64 * 2 + col64] != -1) return;
  const int idx = symbols_.literal(header_->cdef_bits);
  for (int y = row64; y <= std::min(mask, row64 + ((bh4_ - 1) >> 4)); ++y) {
    for (int x = col64; x <= std::min(mask, col64 + ((bw4_ - 1) >> 4)); ++x) {
      cdef_idx_[y * 2 + x] = idx;
    }
  }
}

// 5.11.12 Quantizer index delta syntax
void TileParser::read_delta_qindex() {
  const int sb_size = seq_->use_128x128_superblock ? BLOCK_128X128 : BLOCK_64X64;
  if ((b_->mi_size == sb_size && b_->skip) || !read_deltas_) return;
  int delta_q_abs = read(cdf_.delta_q);
  if (delta_q_abs == DELTA_Q_SMALL) {
    const int delta_q_rem_bits = symbols_.literal(3) + 1;
    delta_q_abs = symbols_.literal(delta_q_rem_bits) + (1 << delta_q_rem_bits) + 1;
  }
  if (delta_q_abs) {
    const int delta = symbols_.bit() ? -delta_q_abs : delta_q_abs;
    current_q_index_ = std::clamp(current_q_index_ + delta * (1 << header_->delta_q_res), 1, 255);
  }
}

// 5.11.13 Loop filter delta syntax
void TileParser::read_delta_lf() {
  const int sb_size = seq_->use_128x128_superblock ? BLOCK_128X128 : BLOCK_64X64;
  if ((b_->mi_size == sb_size && b_->skip) || !read_deltas_ || !header_->delta_lf_present) return;
  int frame_lf_count = 1;
  if (header_->delta_lf_multi) {
    frame_lf_count = seq_->num_planes > 1 ? FRAME_LF_COUNT : FRAME_LF_COUNT - 2;
  }
  for (int i = 0; i < frame_lf_count; ++i) {
    int delta_lf_abs = header_->delta_lf_multi ? read(cdf_.delta_lf_multi[i]) : read(cdf_.delta_lf);
    if (delta_lf_abs == DELTA_LF_SMALL) {
      const int n = symbols_.literal(3) + 1;
      delta_lf_abs = symbols_.literal(n) + (1 << n) + 1;
    }
    if (delta_lf_abs) {
      const int delta = symbols_.bit() ? -delta_lf_abs : delta_lf_abs;
      delta_lf_[i] = static_cast<std::int8_t>(std::clamp(
          delta_lf_[i] + delta * (1 << header_->delta_lf_res), -MAX_LOOP_FILTER, MAX_LOOP_FILTER));
    }
  }
}

// 5.11.57 Read loop restoration syntax
void TileParser::read_lr(int r, int c, int b_size) {
  if (header_->allow_intrabc) return;
  const int w = kNum4x4BlocksWide[b_size];
  const int h = kNum4x4BlocksHigh[b_size];
  const auto count_units = [](int unit_size, int frame_size) {
    return std::max((frame_size + (unit_size >> 1)) / unit_size, 1);
  };
  for (int plane = 0; plane < seq_->num_planes; ++plane) {
    if (header_->frame_restoration_type[plane] == RESTORE_NONE) continue;
    const int sub_x = plane == 0 ? 0 : seq_->subsampling_x;
    const int sub_y = plane == 0 ? 0 : seq_->subsampling_y;
    const int unit_size = header_->loop_restoration_size[plane];
    const int unit_rows = count_units(unit_size, (header_->frame_height + sub_y) >> sub_y);
    const int unit_cols = count_units(unit_size, (header_->upscaled_width + sub_x) >> sub_x);
    const int row_start = (r * (MI_SIZE >> sub_y) + unit_size - 1) / unit_size;
    const int row_end =
        std::min(unit_rows, ((r + h) * (MI_SIZE >> sub_y) + unit_size - 1) / unit_size);
    int numerator = MI_SIZE >> sub_x;
    int denominator = unit_size;
    if (header_->use_superres) {
      numerator *= header_->superres_denom;
      denominator *= SUPERRES_NUM;
    }
    const int col_start = (c * numerator + denominator - 1) / denominator;
    const int col_end = std::min(unit_cols, ((c + w) * numerator + denominator - 1) / denominator);
    for (int row = row_start; row < row_end; ++row) {
      for (int col = col_start; col < col_end; ++col) read_lr_unit(plane);
    }
  }
}

// 5.11.58 Read loop restoration unit syntax
void TileParser::read_lr_unit(int plane) {
  int restoration_type;
  if (header_->frame_restoration_type[plane] == RESTORE_WIENER) {
    restoration_type = read_flag(cdf_.use_wiener) ? RESTORE_WIENER : RESTORE_NONE;
  } else if (header_->frame_restoration_type[plane] == RESTORE_SGRPROJ) {
    restoration_type = read_flag(cdf_.use_sgrproj) ? RESTORE_SGRPROJ : RESTORE_NONE;
  } else {
    restoration_type = read(cdf_.restoration_type);
  }
  if (restoration_type == RESTORE_WIENER) {
    for (auto& taps : ref_lr_wiener_[plane]) {
      for (int j = plane ? 1 : 0; j < WIENER_COEFFS; ++j) {
        taps[j] = decode_signed_subexp_with_ref(symbols_, kWienerTapsMin[j], kWienerTapsMax[j] + 1,
                                                kWienerTapsK[j], taps[j]);
      }
    }
  } else if (restoration_type == RESTORE_SGRPROJ) {
    const int lr_sgr_set = symbols_.literal(SGRPROJ_PARAMS_BITS);
    for (int i = 0; i < 2; ++i) {
      const int min = kSgrprojXqdMin[i];
      const int max = kSgrprojXqdMax[i];
      int v = 0;
      if (kSgrParams[lr_sgr_set][i * 2]) {
        v = decode_signed_subexp_with_ref(symbols_, min, max + 1, SGRPROJ_PRJ_SUBEXP_K,
                                          ref_sgr_xqd_[plane][i]);
      } else if (i == 1) {
        v = std::clamp((1 << SGRPROJ_PRJ_BITS) - ref_sgr_xqd_[plane][0], min, max);
      }
      ref_sgr_xqd_[plane][i] = v;
    }
  }
}

}  // namespace colmap_av1::av1

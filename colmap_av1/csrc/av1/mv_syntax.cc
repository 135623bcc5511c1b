// Motion vector syntax (specification sections 5.11.26, 5.11.31 and 5.11.32).
#include <cstdlib>

#include "av1/error.h"
#include "av1/mv_prediction.h"
#include "av1/spec_tables.h"
#include "av1/tile_parser.h"

namespace colmap_av1::av1 {
namespace {

constexpr int kMaxMv = 1 << 14;  // is_mv_valid( )

// 5.11.30 Get mode function
int get_mode(int y_mode, int list) {
  if (list == 0) {
    if (y_mode < NEAREST_NEARESTMV) return y_mode;
    if (y_mode == NEW_NEWMV || y_mode == NEW_NEARESTMV || y_mode == NEW_NEARMV) return NEWMV;
    if (y_mode == NEAREST_NEARESTMV || y_mode == NEAREST_NEWMV) return NEARESTMV;
    if (y_mode == NEAR_NEARMV || y_mode == NEAR_NEWMV) return NEARMV;
    return GLOBALMV;
  }
  if (y_mode == NEW_NEWMV || y_mode == NEAREST_NEWMV || y_mode == NEAR_NEWMV) return NEWMV;
  if (y_mode == NEAREST_NEARESTMV || y_mode == NEW_NEARESTMV) return NEARESTMV;
  if (y_mode == NEAR_NEARMV || y_mode == NEW_NEARMV) return NEARMV;
  return GLOBALMV;
}

// 5.11.32 MV component syntax
int read_mv_component(SymbolDecoder& symbols, MvComponentCdfs& cdf, const FrameHeader& header) {
  const bool mv_sign = symbols.flag(cdf.sign);
  const int mv_class = symbols.read(cdf.mv_class);
  int mag = 0;
  int d = 0;
  int fr = 3;
  int hp = 1;
  if (mv_class == MV_CLASS_0) {
    d = symbols.read(cdf.class0_bit);
    if (!header.force_integer_mv) fr = symbols.read(cdf.class0_fr[d]);
    if (header.allow_high_precision_mv) hp = symbols.read(cdf.class0_hp);
  } else {
    for (int i = 0; i < mv_class; ++i) d |= symbols.read(cdf.bits[i]) << i;
    mag = CLASS0_SIZE << (mv_class + 2);
    if (!header.force_integer_mv) fr = symbols.read(cdf.fr);
    if (header.allow_high_precision_mv) hp = symbols.read(cdf.hp);
  }
  mag += ((d << 3) | (fr << 1) | hp) + 1;
  return mv_sign ? -mag : mag;
}

// is_mv_valid( ) in the semantics of assign_mv (6.10.25)
bool is_mv_valid(const SequenceHeader& seq, const TileBounds& tile, const BlockInfo& block) {
  for (int list = 0; list < 1 + block.is_compound(); ++list) {
    if (std::abs(block.mv[list].row) >= kMaxMv || std::abs(block.mv[list].col) >= kMaxMv)
      return false;
  }
  if (!block.use_intrabc) return true;
  const Mv mv = block.mv[0];
  const int bw = kBlockWidth[block.mi_size];
  const int bh = kBlockHeight[block.mi_size];
  if ((mv.row & 7) || (mv.col & 7)) return false;
  int src_top = block.mi_row * MI_SIZE + (mv.row >> 3);
  int src_left = block.mi_col * MI_SIZE + (mv.col >> 3);
  const int src_bottom = src_top + bh;
  const int src_right = src_left + bw;
  if (block.has_chroma) {
    if (bw < 8 && seq.subsampling_x) src_left -= 4;
    if (bh < 8 && seq.subsampling_y) src_top -= 4;
  }
  if (src_top < tile.mi_row_start * MI_SIZE || src_left < tile.mi_col_start * MI_SIZE ||
      src_bottom > tile.mi_row_end * MI_SIZE || src_right > tile.mi_col_end * MI_SIZE) {
    return false;
  }
  const int sb_h = seq.use_128x128_superblock ? 128 : 64;
  const int active_sb_row = (block.mi_row * MI_SIZE) / sb_h;
  const int active_sb64_col = (block.mi_col * MI_SIZE) >> 6;
  const int src_sb_row = (src_bottom - 1) / sb_h;
  const int src_sb64_col = (src_right - 1) >> 6;
  const int total_sb64_per_row = ((tile.mi_col_end - tile.mi_col_start - 1) >> 4) + 1;
  const int active_sb64 = active_sb_row * total_sb64_per_row + active_sb64_col;
  const int src_sb64 = src_sb_row * total_sb64_per_row + src_sb64_col;
  if (src_sb64 >= active_sb64 - INTRABC_DELAY_SB64) return false;
  const int gradient = 1 + INTRABC_DELAY_SB64 + seq.use_128x128_superblock;
  const int wf_offset = gradient * (active_sb_row - src_sb_row);
  return src_sb_row <= active_sb_row &&
         src_sb64_col < active_sb64_col - INTRABC_DELAY_SB64 + wf_offset;
}

}  // namespace

// 5.11.26 Assign MV syntax
void TileParser::assign_mv(const MvStack& stack, int ref_mv_idx) {
  for (int list = 0; list < 1 + b_->is_compound(); ++list) {
    if (b_->use_intrabc) {
      Mv predicted = stack.entries[0].mv[0];
      if (predicted == Mv{}) predicted = stack.entries[1].mv[0];
      if (predicted == Mv{}) {
        const int sb_size4 = seq_->use_128x128_superblock ? 32 : 16;
        if (b_->mi_row - sb_size4 < tile_.mi_row_start) {
          predicted.col =
              static_cast<std::int16_t>(-(sb_size4 * MI_SIZE + INTRABC_DELAY_PIXELS) * 8);
        } else {
          predicted.row = static_cast<std::int16_t>(-(sb_size4 * MI_SIZE * 8));
        }
      }
      b_->mv[list] = read_mv(predicted);
      continue;
    }
    const int mode = get_mode(b_->y_mode, list);
    if (mode == GLOBALMV) {
      b_->mv[list] = stack.global_mvs[list];
      continue;
    }
    const bool first = mode == NEARESTMV || (mode == NEWMV && stack.num_mv_found <= 1);
    const Mv predicted = stack.entries[first ? 0 : ref_mv_idx].mv[list];
    if (mode == NEWMV) {
      b_->mv[list] = read_mv(predicted);
    } else {
      b_->mv[list] = predicted;
    }
  }
  if (!is_mv_valid(*seq_, tile_, *b_)) throw BitstreamError("motion vector is out of range");
}

// 5.11.31 MV syntax
Mv TileParser::read_mv(Mv predicted) {
  MvCdfs& cdf = cdf_.mv[b_->use_intrabc ? MV_INTRABC_CONTEXT : 0];
  const int mv_joint = read(cdf.joint);
  int row = predicted.row;
  int col = predicted.col;
  if (mv_joint == MV_JOINT_HZVNZ || mv_joint == MV_JOINT_HNZVNZ) {
    row += read_mv_component(symbols_, cdf.component[0], *header_);
  }
  if (mv_joint == MV_JOINT_HNZVZ || mv_joint == MV_JOINT_HNZVNZ) {
    col += read_mv_component(symbols_, cdf.component[1], *header_);
  }
  if (std::abs(row) >= kMaxMv || std::abs(col) >= kMaxMv) {
    throw BitstreamError("motion vector is out of range");
  }
  return {static_cast<std::int16_t>(row), static_cast<std::int16_t>(col)};
}

}  // namespace colmap_av1::av1

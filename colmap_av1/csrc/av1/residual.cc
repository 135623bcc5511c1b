// Transform sizes and types, and coefficients, which are read to keep the decoder in step and
// then dropped (specification sections 5.11.15 to 5.11.17, 5.11.34, 5.11.37 to 5.11.41, 5.11.47,
// 5.11.48; contexts as in 8.3.2).
#include <algorithm>
#include <bit>
#include <cstring>
#include <iterator>
#include <utility>

#include "av1/error.h"
#include "av1/spec_tables.h"
#include "av1/tile_parser.h"

namespace colmap_av1::av1 {
namespace {

// TileParser::levels_ has room for 32x32 levels with a margin of 4 behind each row and below, so
// that neighbours need no checks. All sizes share the stride: then it is a constant.
constexpr int kLevelStride = 36;

// By the logarithms of width and height less 2, TX_SIZES_ALL where there is none
constexpr auto kTxSizes = [] {
  std::array<std::array<std::uint8_t, 5>, 5> sizes{};
  for (auto& row : sizes) row.fill(TX_SIZES_ALL);
  for (std::size_t i = 0; i < TX_SIZES_ALL; ++i) {
    sizes[kTxWidthLog2[i] - 2][kTxHeightLog2[i] - 2] = static_cast<std::uint8_t>(i);
  }
  return sizes;
}();

// find_tx_size( ) of powers of two from 4 to 64
int find_tx_size(int w, int h) {
  const int log2_w = std::bit_width(static_cast<unsigned>(w)) - 3;
  const int log2_h = std::bit_width(static_cast<unsigned>(h)) - 3;
  const int tx_size = kTxSizes[log2_w][log2_h];
  if (tx_size == TX_SIZES_ALL) throw BitstreamError("transform tree gives no transform size");
  return tx_size;
}

constexpr auto kTxClasses = [] {
  std::array<std::uint8_t, TX_TYPES> classes{};
  classes.fill(TX_CLASS_2D);
  for (const int type : {V_DCT, V_ADST, V_FLIPADST}) classes[type] = TX_CLASS_VERT;
  for (const int type : {H_DCT, H_ADST, H_FLIPADST}) classes[type] = TX_CLASS_HORIZ;
  return classes;
}();

// Contexts of neighbours are handled eight at a time, in words.
constexpr std::uint64_t kOnes = 0x0101010101010101;

constexpr std::uint64_t first_bytes(int count) {
  if (count >= 8) return ~std::uint64_t{0};
  if constexpr (std::endian::native == std::endian::little) {
    return (std::uint64_t{1} << (8 * count)) - 1;
  }
  return ~(~std::uint64_t{0} >> (8 * count));
}

std::uint64_t load_word(const std::uint8_t* p) {
  std::uint64_t word;
  std::memcpy(&word, p, sizeof word);
  return word;
}

// The first `count` entries, 1 to 16, become `value` up to `visible` and 0 behind.
void set_contexts(std::uint8_t* p, int count, int visible, std::uint8_t value) {
  for (; count > 0; p += 8, count -= 8, visible -= 8) {
    const std::uint64_t word = (load_word(p) & ~first_bytes(count)) |
                               (kOnes * value & first_bytes(std::clamp(visible, 0, count)));
    std::memcpy(p, &word, sizeof word);
  }
}

// What the levels loop needs of one scan position.
struct ScanEntry {
  std::uint16_t index;       // into TileParser::levels_
  std::uint8_t base_offset;  // added to the context of coeff_base
  std::uint8_t br_offset;    // added to the context of coeff_br
};

// 5.11.41 Get scan function
template <int kTxSize, int kTxClass>
constexpr const auto& scan_of() {
  const auto choose = [](const auto& def, const auto& mrow, const auto& mcol) -> const auto& {
    if constexpr (kTxClass == TX_CLASS_2D) {
      return def;
    } else if constexpr (kTxClass == TX_CLASS_VERT) {
      return mrow;
    } else {
      return mcol;
    }
  };
  if constexpr (kTxSize == TX_4X4) {
    return choose(kDefaultScan4x4, kMrowScan4x4, kMcolScan4x4);
  } else if constexpr (kTxSize == TX_4X8) {
    return choose(kDefaultScan4x8, kMrowScan4x8, kMcolScan4x8);
  } else if constexpr (kTxSize == TX_8X4) {
    return choose(kDefaultScan8x4, kMrowScan8x4, kMcolScan8x4);
  } else if constexpr (kTxSize == TX_8X8) {
    return choose(kDefaultScan8x8, kMrowScan8x8, kMcolScan8x8);
  } else if constexpr (kTxSize == TX_8X16) {
    return choose(kDefaultScan8x16, kMrowScan8x16, kMcolScan8x16);
  } else if constexpr (kTxSize == TX_16X8) {
    return choose(kDefaultScan16x8, kMrowScan16x8, kMcolScan16x8);
  } else if constexpr (kTxSize == TX_16X16) {
    return choose(kDefaultScan16x16, kMrowScan16x16, kMcolScan16x16);
  } else if constexpr (kTxSize == TX_4X16) {
    return choose(kDefaultScan4x16, kMrowScan4x16, kMcolScan4x16);
  } else if constexpr (kTxSize == TX_16X4) {
    return choose(kDefaultScan16x4, kMrowScan16x4, kMcolScan16x4);
  } else if constexpr (kTxSize == TX_8X32) {
    return kDefaultScan8x32;
  } else if constexpr (kTxSize == TX_32X8) {
    return kDefaultScan32x8;
  } else if constexpr (kTxSize == TX_16X32 || kTxSize == TX_16X64) {
    return kDefaultScan16x32;
  } else if constexpr (kTxSize == TX_32X16 || kTxSize == TX_64X16) {
    return kDefaultScan32x16;
  } else {
    return kDefaultScan32x32;
  }
}

// A scan with the parts of the contexts that depend on the position alone.
template <int kTxSize, int kTxClass>
constexpr auto kScan = [] {
  constexpr const auto& kPositions = scan_of<kTxSize, kTxClass>();
  constexpr int kWidthLog2 = kTxWidthLog2[kAdjustedTxSize[kTxSize]];
  std::array<ScanEntry, std::size(kPositions)> entries{};
  for (std::size_t i = 0; i < entries.size(); ++i) {
    const int pos = kPositions[i];
    const int row = pos >> kWidthLog2;
    const int col = pos - (row << kWidthLog2);
    ScanEntry& entry = entries[i];
    entry.index = static_cast<std::uint16_t>(row * kLevelStride + col);
    bool near;
    if constexpr (kTxClass == TX_CLASS_2D) {
      entry.base_offset = kCoeffBaseCtxOffset[kTxSize][std::min(row, 4)][std::min(col, 4)];
      near = row < 2 && col < 2;
    } else {
      const int along = kTxClass == TX_CLASS_VERT ? row : col;
      entry.base_offset = kCoeffBasePosCtxOffset[std::min(along, 2)];
      near = along == 0;
    }
    entry.br_offset = pos == 0 ? 0 : near ? 7 : 14;
  }
  return entries;
}();

template <int kTxClass>
constexpr auto kScans = []<std::size_t... kTxSize>(std::index_sequence<kTxSize...>) {
  return std::array<const ScanEntry*, TX_SIZES_ALL>{kScan<kTxSize, kTxClass>.data()...};
}(std::make_index_sequence<TX_SIZES_ALL>());

// Levels are stored with their value up to 15 in the low six bits, for coeff_br, and their value
// up to 3 in the high two, for coeff_base: one sum over the neighbours serves both contexts.
constexpr int kLevelMask = 63;
constexpr int kClippedShift = 6;
constexpr int kMaxLevel = NUM_BASE_LEVELS + 1 + COEFF_BASE_RANGE;  // from it on a Golomb code

}  // namespace

// 5.11.16 Block TX size syntax
void TileParser::read_block_tx_size() {
  const int row0 = b_->mi_row;
  const int col0 = b_->mi_col;
  if (header_->tx_mode == TX_MODE_SELECT && b_->mi_size > BLOCK_4X4 && b_->is_inter && !b_->skip &&
      !lossless_) {
    const int max_tx_size = kMaxTxSizeRect[b_->mi_size];
    const int tx_w4 = kTxWidth[max_tx_size] / MI_SIZE;
    const int tx_h4 = kTxHeight[max_tx_size] / MI_SIZE;
    for (int row = row0; row < row0 + bh4_; row += tx_h4) {
      for (int col = col0; col < col0 + bw4_; col += tx_w4) {
        read_var_tx_size(row, col, max_tx_size, 0);
      }
    }
    return;
  }
  read_tx_size(!b_->skip || !b_->is_inter);
  if (b_->is_inter && !b_->skip) {
    for (int y = 0; y < bh4_; ++y) {
      std::fill_n(inter_tx_sizes_.begin() + ((row0 + y) & kSbMask) * kMaxSb4 + (col0 & kSbMask),
                  bw4_, b_->tx_size);
    }
  }
  // The contexts see the block's size where nothing is coded (get_above_tx_width( )).
  const bool whole = b_->skip && b_->is_inter;
  set_tx_context(row0, col0, bw4_, bh4_, whole ? kBlockWidth[b_->mi_size] : kTxWidth[b_->tx_size],
                 whole ? kBlockHeight[b_->mi_size] : kTxHeight[b_->tx_size]);
}

void TileParser::set_tx_context(int row, int col, int w4, int h4, int width, int height) {
  std::fill_n(above_tx_width_.begin() + col, w4, static_cast<std::uint8_t>(width));
  std::fill_n(left_tx_height_.begin() + (row & kSbMask), h4, static_cast<std::uint8_t>(height));
}

int TileParser::above_tx_width(int row, int col) const {
  return row == b_->mi_row && !above_ ? 64 : above_tx_width_[col];
}

int TileParser::left_tx_height(int row, int col) const {
  return col == b_->mi_col && !left_ ? 64 : left_tx_height_[row & kSbMask];
}

// 5.11.15 TX size syntax
void TileParser::read_tx_size(bool allow_select) {
  if (lossless_) {
    b_->tx_size = TX_4X4;
    return;
  }
  const int max_rect_tx_size = kMaxTxSizeRect[b_->mi_size];
  int tx_size = max_rect_tx_size;
  if (b_->mi_size > BLOCK_4X4 && allow_select && header_->tx_mode == TX_MODE_SELECT) {
    int above_w = 0;
    int left_h = 0;
    if (above_) {
      above_w =
          above_->is_inter ? kBlockWidth[above_->mi_size] : above_tx_width(b_->mi_row, b_->mi_col);
    }
    if (left_) {
      left_h =
          left_->is_inter ? kBlockHeight[left_->mi_size] : left_tx_height(b_->mi_row, b_->mi_col);
    }
    const int ctx =
        (above_w >= kTxWidth[max_rect_tx_size]) + (left_h >= kTxHeight[max_rect_tx_size]);
    int tx_depth;
    switch (kMaxTxDepth[b_->mi_size]) {
      case 4: tx_depth = read(cdf_.tx_64x64[ctx]); break;
      case 3: tx_depth = read(cdf_.tx_32x32[ctx]); break;
      case 2: tx_depth = read(cdf_.tx_16x16[ctx]); break;
      default: tx_depth = read(cdf_.tx_8x8[ctx]); break;
    }
    for (int i = 0; i < tx_depth; ++i) tx_size = kSplitTxSize[tx_size];
  }
  b_->tx_size = static_cast<std::uint8_t>(tx_size);
}

// 5.11.17 Var TX size syntax
void TileParser::read_var_tx_size(int row, int col, int tx_size, int depth) {
  if (row >= header_->mi_rows || col >= header_->mi_cols) return;
  bool txfm_split = false;
  if (tx_size != TX_4X4 && depth != MAX_VARTX_DEPTH) {
    const bool above = above_tx_width(row, col) < kTxWidth[tx_size];
    const bool left = left_tx_height(row, col) < kTxHeight[tx_size];
    const int size =
        std::min<int>(64, std::max(kBlockWidth[b_->mi_size], kBlockHeight[b_->mi_size]));
    const int max_tx_size = find_tx_size(size, size);
    const int ctx = (kTxSizeSqrUp[tx_size] != max_tx_size) * 3 + (TX_SIZES - 1 - max_tx_size) * 6 +
                    above + left;
    txfm_split = read_flag(cdf_.txfm_split[ctx]);
  }
  const int w4 = kTxWidth[tx_size] / MI_SIZE;
  const int h4 = kTxHeight[tx_size] / MI_SIZE;
  if (txfm_split) {
    const int sub_tx_size = kSplitTxSize[tx_size];
    const int step_w = kTxWidth[sub_tx_size] / MI_SIZE;
    const int step_h = kTxHeight[sub_tx_size] / MI_SIZE;
    for (int i = 0; i < h4; i += step_h) {
      for (int j = 0; j < w4; j += step_w) {
        read_var_tx_size(row + i, col + j, sub_tx_size, depth + 1);
      }
    }
    return;
  }
  for (int i = 0; i < h4; ++i) {
    std::fill_n(inter_tx_sizes_.begin() + ((row + i) & kSbMask) * kMaxSb4 + (col & kSbMask), w4,
                static_cast<std::uint8_t>(tx_size));
  }
  set_tx_context(row, col, w4, h4, kTxWidth[tx_size], kTxHeight[tx_size]);
  b_->tx_size = static_cast<std::uint8_t>(tx_size);
}

// reset_block_context( ) of 5.11.5
void TileParser::reset_block_context() {
  for (int plane = 0; plane < (b_->has_chroma ? 3 : 1); ++plane) {
    const int sub_x = plane > 0 ? seq_->subsampling_x : 0;
    const int sub_y = plane > 0 ? seq_->subsampling_y : 0;
    const int x = b_->mi_col >> sub_x;
    const int y = b_->mi_row >> sub_y;
    const int w = ((b_->mi_col + bw4_ - 1) >> sub_x) - x + 1;
    const int h = ((b_->mi_row + bh4_ - 1) >> sub_y) - y + 1;
    std::fill_n(above_coef_context_[plane].begin() + x, w, std::uint8_t{0});
    std::fill_n(left_coef_context_[plane].begin() + (y & kSbMask), h, std::uint8_t{0});
  }
}

// 5.11.34 Residual syntax
void TileParser::residual() {
  const int width_chunks = std::max(1, kBlockWidth[b_->mi_size] >> 6);
  const int height_chunks = std::max(1, kBlockHeight[b_->mi_size] >> 6);
  const int mi_size_chunk = width_chunks > 1 || height_chunks > 1 ? BLOCK_64X64 : b_->mi_size;
  const int num_planes = b_->has_chroma ? 3 : 1;
  for (int chunk_y = 0; chunk_y < height_chunks; ++chunk_y) {
    for (int chunk_x = 0; chunk_x < width_chunks; ++chunk_x) {
      const int row = b_->mi_row + (chunk_y << 4);
      const int col = b_->mi_col + (chunk_x << 4);
      for (int plane = 0; plane < num_planes; ++plane) {
        const int sub_x = plane > 0 ? seq_->subsampling_x : 0;
        const int sub_y = plane > 0 ? seq_->subsampling_y : 0;
        const int plane_size = kSubsampledSize[mi_size_chunk][sub_x][sub_y];
        const int width = kBlockWidth[plane_size];
        const int height = kBlockHeight[plane_size];
        const int base_x = (col >> sub_x) * MI_SIZE;
        const int base_y = (row >> sub_y) * MI_SIZE;
        if (b_->is_inter && !lossless_ && plane == 0) {
          transform_tree(base_x, base_y, width, height);
          continue;
        }
        const int tx_size = lossless_ ? TX_4X4 : plane == 0 ? b_->tx_size : uv_tx_size();
        for (int y = 0; y < height; y += kTxHeight[tx_size]) {
          for (int x = 0; x < width; x += kTxWidth[tx_size]) {
            transform_block(plane, base_x + x, base_y + y, tx_size);
          }
        }
      }
    }
  }
}

// 5.11.37 Get TX size function, for chroma
int TileParser::uv_tx_size() const {
  const int plane_size = kSubsampledSize[b_->mi_size][seq_->subsampling_x][seq_->subsampling_y];
  const int uv_tx = kMaxTxSizeRect[plane_size];
  if (kTxWidth[uv_tx] == 64 || kTxHeight[uv_tx] == 64) {
    if (kTxWidth[uv_tx] == 16) return TX_16X32;
    if (kTxHeight[uv_tx] == 16) return TX_32X16;
    return TX_32X32;
  }
  return uv_tx;
}

// 5.11.36 Transform tree syntax
void TileParser::transform_tree(int start_x, int start_y, int w, int h) {
  if (start_x >= header_->mi_cols * MI_SIZE || start_y >= header_->mi_rows * MI_SIZE) return;
  const int row = (start_y >> MI_SIZE_LOG2) & kSbMask;
  const int col = (start_x >> MI_SIZE_LOG2) & kSbMask;
  const int luma_tx_size = inter_tx_sizes_[row * kMaxSb4 + col];
  if (w <= kTxWidth[luma_tx_size] && h <= kTxHeight[luma_tx_size]) {
    transform_block(0, start_x, start_y, find_tx_size(w, h));
    return;
  }
  const int step_w = w >= h ? w / 2 : w;
  const int step_h = h >= w ? h / 2 : h;
  for (int y = 0; y < h; y += step_h) {
    for (int x = 0; x < w; x += step_w) transform_tree(start_x + x, start_y + y, step_w, step_h);
  }
}

// 5.11.35 Transform block syntax
void TileParser::transform_block(int plane, int start_x, int start_y, int tx_size) {
  const int max_x = (header_->mi_cols * MI_SIZE) >> (plane > 0 ? seq_->subsampling_x : 0);
  const int max_y = (header_->mi_rows * MI_SIZE) >> (plane > 0 ? seq_->subsampling_y : 0);
  if (start_x >= max_x || start_y >= max_y) return;
  coeffs(plane, start_x >> 2, start_y >> 2, tx_size);
}

// 5.11.48 Get transform set function
int TileParser::tx_set(int tx_size) const {
  const int sqr = kTxSizeSqr[tx_size];
  const int sqr_up = kTxSizeSqrUp[tx_size];
  if (sqr_up > TX_32X32) return TX_SET_DCTONLY;
  if (b_->is_inter) {
    if (header_->reduced_tx_set || sqr_up == TX_32X32) return TX_SET_INTER_3;
    return sqr == TX_16X16 ? TX_SET_INTER_2 : TX_SET_INTER_1;
  }
  if (sqr_up == TX_32X32) return TX_SET_DCTONLY;
  return header_->reduced_tx_set || sqr == TX_16X16 ? TX_SET_INTRA_2 : TX_SET_INTRA_1;
}

// 5.11.47 Transform type syntax
int TileParser::read_transform_type(int tx_size) {
  const int set = tx_set(tx_size);
  if (set == TX_SET_DCTONLY || header_->qindex(b_->segment_id) == 0) return DCT_DCT;
  const int sqr = kTxSizeSqr[tx_size];
  if (b_->is_inter) {
    if (set == TX_SET_INTER_1) return kTxTypeInterInvSet1[read(cdf_.inter_tx_type_set1[sqr])];
    if (set == TX_SET_INTER_2) return kTxTypeInterInvSet2[read(cdf_.inter_tx_type_set2)];
    return kTxTypeInterInvSet3[read(cdf_.inter_tx_type_set3[sqr])];
  }
  const int intra_dir =
      b_->use_filter_intra ? kFilterIntraModeToIntraDir[b_->filter_intra_mode] : b_->y_mode;
  if (set == TX_SET_INTRA_1) {
    return kTxTypeIntraInvSet1[read(cdf_.intra_tx_type_set1[sqr][intra_dir])];
  }
  return kTxTypeIntraInvSet2[read(cdf_.intra_tx_type_set2[sqr][intra_dir])];
}

// 5.11.40 Compute transform type function, for chroma
int TileParser::plane_tx_type(int plane, int tx_size, int x4, int y4) const {
  if (lossless_ || kTxSizeSqrUp[tx_size] > TX_32X32 || plane == 0) return DCT_DCT;
  const int set = tx_set(tx_size);
  if (b_->is_inter) {
    const int col = std::max<int>(b_->mi_col, x4 << seq_->subsampling_x) & kSbMask;
    const int row = std::max<int>(b_->mi_row, y4 << seq_->subsampling_y) & kSbMask;
    const int tx_type = tx_types_[row * kMaxSb4 + col];
    return kTxTypeInSetInter[set][tx_type] ? tx_type : DCT_DCT;
  }
  const int tx_type = kModeToTxfm[b_->uv_mode];
  return kTxTypeInSetIntra[set][tx_type] ? tx_type : DCT_DCT;
}

// 5.11.39 Coefficients syntax
void TileParser::coeffs(int plane, int x4, int y4, int tx_size) {
  const int w4 = kTxWidth[tx_size] >> 2;
  const int h4 = kTxHeight[tx_size] >> 2;
  const int tx_size_ctx = (kTxSizeSqr[tx_size] + kTxSizeSqrUp[tx_size] + 1) >> 1;
  const int ptype = plane > 0;
  const int sub_x = plane > 0 ? seq_->subsampling_x : 0;
  const int sub_y = plane > 0 ? seq_->subsampling_y : 0;
  std::uint8_t* above = above_coef_context_[plane].data() + x4;
  std::uint8_t* left = left_coef_context_[plane].data() + (y4 & kSbMask);

  // Context of all_zero. Entries behind the frame's edge are kept at 0.
  std::uint64_t any_above = load_word(above) & first_bytes(w4);
  if (w4 > 8) any_above |= load_word(above + 8);
  std::uint64_t any_left = load_word(left) & first_bytes(h4);
  if (h4 > 8) any_left |= load_word(left + 8);
  const int plane_size = kSubsampledSize[b_->mi_size][sub_x][sub_y];
  const int bw = kBlockWidth[plane_size];
  const int bh = kBlockHeight[plane_size];
  int ctx;
  if (plane == 0) {
    // Whether the greatest level is 0, at most 3, or above
    const auto grade = [](std::uint64_t any) {
      return ((any & kOnes * 63) != 0) + ((any & kOnes * 60) != 0);
    };
    constexpr std::uint8_t kContexts[3][3] = {{1, 2, 3}, {2, 4, 5}, {3, 5, 6}};
    const bool whole = bw == kTxWidth[tx_size] && bh == kTxHeight[tx_size];
    ctx = whole ? 0 : kContexts[grade(any_above)][grade(any_left)];
  } else {
    ctx = 7 + (any_above != 0) + (any_left != 0);
    if (bw * bh > kTxWidth[tx_size] * kTxHeight[tx_size]) ctx += 3;
  }
  const bool all_zero = read_flag(cdf_.txb_skip[tx_size_ctx][ctx]);

  int tx_type = DCT_DCT;
  std::uint8_t context = 0;
  if (!all_zero) {
    tx_type = plane == 0 ? read_transform_type(tx_size) : plane_tx_type(plane, tx_size, x4, y4);
    // TxTypes keeps what was read; a lossless or 64 wide block is DCT_DCT either way.
    const int c = kTxClasses[tx_type];
    const int eob = read_eob(tx_size, tx_size_ctx, ptype, c);
    b_->num_coefficients += eob;
    // Context of dc_sign: positive less negative neighbours
    int dc_sum = 0;
    const auto add_signs = [&](const std::uint8_t* p, int count) {
      for (; count > 0; p += 8, count -= 8) {
        const std::uint64_t word = load_word(p) & first_bytes(count);
        dc_sum += static_cast<int>(((word >> 7 & kOnes) * kOnes) >> 56) -
                  static_cast<int>(((word >> 6 & kOnes) * kOnes) >> 56);
      }
    };
    add_signs(above, w4);
    add_signs(left, h4);
    const int dc_sign_ctx = dc_sum < 0 ? 1 : dc_sum > 0 ? 2 : 0;
    const auto read_levels = c == TX_CLASS_2D      ? &TileParser::read_levels<TX_CLASS_2D>
                             : c == TX_CLASS_HORIZ ? &TileParser::read_levels<TX_CLASS_HORIZ>
                                                   : &TileParser::read_levels<TX_CLASS_VERT>;
    context = (this->*read_levels)(tx_size, tx_size_ctx, ptype, eob, dc_sign_ctx);
  }
  if (plane == 0 && b_->is_inter) {
    for (int i = 0; i < h4; ++i) {
      std::fill_n(tx_types_.begin() + ((y4 + i) & kSbMask) * kMaxSb4 + (x4 & kSbMask), w4,
                  static_cast<std::uint8_t>(tx_type));
    }
  }
  set_contexts(above, w4, (header_->mi_cols >> sub_x) - x4, context);
  set_contexts(left, h4, (header_->mi_rows >> sub_y) - y4, context);
}

int TileParser::read_eob(int tx_size, int tx_size_ctx, int ptype, int tx_class) {
  const int ctx = tx_class == TX_CLASS_2D ? 0 : 1;
  const int eob_multisize =
      std::min<int>(kTxWidthLog2[tx_size], 5) + std::min<int>(kTxHeightLog2[tx_size], 5) - 4;
  int eob_pt;
  switch (eob_multisize) {
    case 0: eob_pt = read(cdf_.eob_pt_16[ptype][ctx]) + 1; break;
    case 1: eob_pt = read(cdf_.eob_pt_32[ptype][ctx]) + 1; break;
    case 2: eob_pt = read(cdf_.eob_pt_64[ptype][ctx]) + 1; break;
    case 3: eob_pt = read(cdf_.eob_pt_128[ptype][ctx]) + 1; break;
    case 4: eob_pt = read(cdf_.eob_pt_256[ptype][ctx]) + 1; break;
    case 5: eob_pt = read(cdf_.eob_pt_512[ptype]) + 1; break;
    default: eob_pt = read(cdf_.eob_pt_1024[ptype]) + 1; break;
  }
  int eob = eob_pt < 2 ? eob_pt : (1 << (eob_pt - 2)) + 1;
  if (eob_pt >= 3) {
    if (read_flag(cdf_.eob_extra[tx_size_ctx][ptype][eob_pt - 3])) eob += 1 << (eob_pt - 3);
    for (int shift = eob_pt - 4; shift >= 0; --shift) {
      if (symbols_.bit()) eob += 1 << shift;
    }
  }
  return eob;
}

// The levels and signs of coeffs( ). Returns the context that the block leaves behind.
template <int kTxClass>
std::uint8_t TileParser::read_levels(int tx_size, int tx_size_ctx, int ptype, int eob,
                                     int dc_sign_ctx) {
  constexpr int kStride = kLevelStride;
  const ScanEntry* scan = kScans<kTxClass>[tx_size];
  auto& base_cdfs = cdf_.coeff_base[tx_size_ctx][ptype];
  auto& br_cdfs = cdf_.coeff_br[std::min(tx_size_ctx, TX_32X32)][ptype];
  int num_nonzero = 0;
  int num_large = 0;
  int sum = 0;
  // A copy, so that its state stays in registers: writes to levels_ and to the CDFs could change a
  // member for all the compiler knows.
  SymbolDecoder symbols = symbols_;

  // Reads coeff_br where `level` asks for it, and stores the level. `near` sums up the neighbours
  // that its context looks at.
  const auto complete = [&](std::uint8_t* at, int level, int near, int br_offset) {
    int stored = level * ((1 << kClippedShift) + 1);
    if (level > NUM_BASE_LEVELS) {
      auto& cdf = br_cdfs[std::min(((near & kLevelMask) + 1) >> 1, 6) + br_offset];
      for (int idx = 0; idx < COEFF_BASE_RANGE / (BR_CDF_SIZE - 1); ++idx) {
        const int coeff_br = symbols.symbol<BR_CDF_SIZE>(cdf);
        level += coeff_br;
        if (coeff_br < BR_CDF_SIZE - 1) break;
      }
      if (level == kMaxLevel) large_[num_large++] = static_cast<std::uint16_t>(num_nonzero);
      stored = level + (3 << kClippedShift);
    }
    *at = static_cast<std::uint8_t>(stored);
    num_nonzero += level != 0;
    sum += level;
  };

  // The last coefficient: it is not 0, and none of its neighbours is read yet.
  const int last = eob - 1;
  {
    const int adjusted = kAdjustedTxSize[tx_size];
    const int size = kTxWidth[adjusted] * kTxHeight[adjusted];
    const int ctx = last == 0 ? 0 : last <= size / 8 ? 1 : last <= size / 4 ? 2 : 3;
    const int level = symbols.symbol<3>(cdf_.coeff_base_eob[tx_size_ctx][ptype][ctx]) + 1;
    complete(&levels_[scan[last].index], level, 0, scan[last].br_offset);
  }
  const auto read_level = [&](ScanEntry entry, bool is_dc) {
    std::uint8_t* at = &levels_[entry.index];
    // Neighbours that both contexts look at
    int near = at[1] + at[kStride];
    int far;
    if constexpr (kTxClass == TX_CLASS_2D) {
      near += at[kStride + 1];
      far = at[2] + at[2 * kStride];
    } else if constexpr (kTxClass == TX_CLASS_HORIZ) {
      near += at[2];
      far = at[3] + at[4];
    } else {
      near += at[2 * kStride];
      far = at[3 * kStride] + at[4 * kStride];
    }
    // Min( ( sum of clipped levels + 1 ) >> 1, 4 ). The low bits of five levels carry into the
    // clipped sum only where that is 15.
    int ctx = std::min((near + far + (1 << kClippedShift)) >> (kClippedShift + 1), 4);
    ctx = kTxClass == TX_CLASS_2D && is_dc ? 0 : ctx + entry.base_offset;
    complete(at, symbols.symbol<4>(base_cdfs[ctx]), near, entry.br_offset);
  };
  for (int c = last - 1; c > 0; --c) read_level(scan[c], false);
  if (last > 0) read_level(scan[0], true);

  // Signs and Golomb codes, from the first coefficient to the last: nothing is kept of them but
  // what contexts need.
  const int dc = levels_[0] & kLevelMask;
  // levels_ is all 0 between transform blocks.
  const int end = scan[last].index;
  const int num_rows = kTxClass == TX_CLASS_2D ? std::min<int>(kTxHeight[kAdjustedTxSize[tx_size]],
                                                               end / kStride + end % kStride + 1)
                                               : kTxHeight[tx_size];
  std::memset(levels_.data(), 0, static_cast<std::size_t>(num_rows * kStride));
  const auto golomb = [&] {
    int length = 1;
    while (!symbols.bit()) {
      if (++length > 20) throw BitstreamError("coefficient is too large");
    }
    int x = 1;
    for (int k = length - 2; k >= 0; --k) x = (x << 1) | symbols.bit();
    return (x + COEFF_BASE_RANGE + NUM_BASE_LEVELS) & 0xFFFFF;
  };
  int num_signs = num_nonzero;
  int dc_category = 0;
  if (dc != 0) {
    const bool sign = symbols.flag(cdf_.dc_sign[ptype][dc_sign_ctx]);
    --num_signs;
    int level = dc;
    if (level == kMaxLevel) {
      level = golomb();
      sum += level - kMaxLevel;
      --num_large;
    }
    if (level > 0) dc_category = sign ? 1 : 2;
  }
  while (num_large > 0) {
    const int before = large_[--num_large];  // nonzero coefficients that come later
    symbols.skip_bits(num_signs - before);
    num_signs = before;
    sum += golomb() - kMaxLevel;
  }
  symbols.skip_bits(num_signs);
  symbols_ = symbols;
  return static_cast<std::uint8_t>(std::min(63, sum) | (dc_category << 6));
}

}  // namespace colmap_av1::av1

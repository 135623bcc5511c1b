// Transform sizes and the loops over transform blocks (specification sections 5.11.15 to 5.11.17
// and 5.11.34 to 5.11.37; contexts as in 8.3.2).
#include <algorithm>
#include <bit>

#include "av1/error.h"
#include "av1/spec_tables.h"
#include "av1/tile_parser.h"

namespace colmap_av1::av1 {
namespace {

// By the logarithms of width and height minus 2; TX_SIZES_ALL if there is no such size
constexpr auto kTxSizes = [] {
  std::array<std::array<std::uint8_t, 5>, 5> sizes{};
  for (auto& row : sizes) row.fill(TX_SIZES_ALL);
  for (std::size_t i = 0; i < TX_SIZES_ALL; ++i) {
    sizes[kTxWidthLog2[i] - 2][kTxHeightLog2[i] - 2] = static_cast<std::uint8_t>(i);
  }
  return sizes;
}();

// find_tx_size( ) for powers of two from 4 to 64
int find_tx_size(int w, int h) {
  const int log2_w = std::bit_width(static_cast<unsigned>(w)) - 3;
  const int log2_h = std::bit_width(static_cast<unsigned>(h)) - 3;
  const int tx_size = kTxSizes[log2_w][log2_h];
  if (tx_size == TX_SIZES_ALL) throw BitstreamError("transform tree gives no transform size");
  return tx_size;
}

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
  // Contexts use the size of the block if nothing is coded (get_above_tx_width( )).
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
  coefficients_.read(symbols_, cdf_, *b_, lossless_, {plane, start_x >> 2, start_y >> 2, tx_size});
}

}  // namespace colmap_av1::av1

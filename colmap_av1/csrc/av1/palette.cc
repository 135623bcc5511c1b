// Palettes (specification sections 5.11.46, 5.11.49 and 5.11.50).
#include <algorithm>
#include <bit>

#include "av1/spec_tables.h"
#include "av1/tile_parser.h"

namespace colmap_av1::av1 {

// 5.11.46 Palette mode info syntax
void TileParser::palette_mode_info() {
  const int bsize_ctx = kMiWidthLog2[b_->mi_size] + kMiHeightLog2[b_->mi_size] - 2;
  const int bit_depth = seq_->bit_depth;
  const int max_value = (1 << bit_depth) - 1;
  std::array<std::uint16_t, 16> cache;

  // Colours of Y (plane 0) and U (plane 1): first from the cache, then coded as differences of at
  // least min_delta.
  const auto read_colors = [&](int plane, int min_delta) {
    auto& colors = palette_colors_[plane];
    const int size = b_->palette_size[plane];
    const int cache_size = palette_cache(plane, cache);
    int idx = 0;
    for (int i = 0; i < cache_size && idx < size; ++i) {
      if (symbols_.bit()) colors[idx++] = cache[i];
    }
    if (idx < size) {
      colors[idx++] = static_cast<std::uint16_t>(symbols_.literal(bit_depth));
      int bits = idx < size ? bit_depth - 3 + symbols_.literal(2) : 0;
      for (; idx < size; ++idx) {
        const int delta = symbols_.literal(bits) + min_delta;
        const int color = std::min(colors[idx - 1] + delta, max_value);
        colors[idx] = static_cast<std::uint16_t>(color);
        const int range = (1 << bit_depth) - color - min_delta;
        const int ceil_log2 = range < 2 ? 0 : std::bit_width(static_cast<unsigned>(range - 1));
        bits = std::min(bits, ceil_log2);
      }
    }
    std::sort(colors.begin(), colors.begin() + size);
  };

  if (b_->y_mode == DC_PRED) {
    const int ctx = (above_ && above_->palette_size[0] > 0) + (left_ && left_->palette_size[0] > 0);
    if (read_flag(cdf_.palette_y_mode[bsize_ctx][ctx])) {
      b_->palette_size[0] = static_cast<std::uint8_t>(read(cdf_.palette_y_size[bsize_ctx]) + 2);
      read_colors(0, 1);
    }
  }
  if (b_->has_chroma && b_->uv_mode == DC_PRED) {
    if (read_flag(cdf_.palette_uv_mode[b_->palette_size[0] > 0])) {
      b_->palette_size[1] = static_cast<std::uint8_t>(read(cdf_.palette_uv_size[bsize_ctx]) + 2);
      read_colors(1, 0);
      // Other blocks never refer to the colours of V, so they are read and dropped.
      if (symbols_.bit()) {  // delta_encode_palette_colors_v
        const int bits = bit_depth - 4 + symbols_.literal(2);
        symbols_.literal(bit_depth);
        for (int idx = 1; idx < b_->palette_size[1]; ++idx) {
          if (symbols_.literal(bits)) symbols_.bit();
        }
      } else {
        for (int idx = 0; idx < b_->palette_size[1]; ++idx) symbols_.literal(bit_depth);
      }
    }
  }
}

// get_palette_cache( ): the sorted union of the colours of the blocks above and left
int TileParser::palette_cache(int plane, std::array<std::uint16_t, 16>& cache) const {
  const bool use_above = above_ && (b_->mi_row * MI_SIZE) % 64 != 0;
  const int above_n = use_above ? above_->palette_size[plane] : 0;
  const int left_n = left_ ? left_->palette_size[plane] : 0;
  const auto& above = above_palette_[plane][b_->mi_col];
  const auto& left = left_palette_[plane][b_->mi_row & kSbMask];
  const auto end = std::merge(above.begin(), above.begin() + above_n, left.begin(),
                              left.begin() + left_n, cache.begin());
  return static_cast<int>(std::unique(cache.begin(), end) - cache.begin());
}

void TileParser::save_palette_colors() {
  for (int plane = 0; plane < 2; ++plane) {
    if (b_->palette_size[plane] == 0) continue;
    std::fill_n(above_palette_[plane].begin() + b_->mi_col, bw4_, palette_colors_[plane]);
    std::fill_n(left_palette_[plane].begin() + (b_->mi_row & kSbMask), bh4_,
                palette_colors_[plane]);
  }
}

// 5.11.49 Palette tokens syntax
void TileParser::palette_tokens() {
  const int width = kBlockWidth[b_->mi_size];
  const int height = kBlockHeight[b_->mi_size];
  int onscreen_width = std::min(width, (header_->mi_cols - b_->mi_col) * MI_SIZE);
  int onscreen_height = std::min(height, (header_->mi_rows - b_->mi_row) * MI_SIZE);
  if (const int n = b_->palette_size[0]) {
    read_color_map(n, onscreen_width, onscreen_height, [&](int ctx) {
      switch (n) {
        case 2: return read(cdf_.palette_size_2_y_color[ctx]);
        case 3: return read(cdf_.palette_size_3_y_color[ctx]);
        case 4: return read(cdf_.palette_size_4_y_color[ctx]);
        case 5: return read(cdf_.palette_size_5_y_color[ctx]);
        case 6: return read(cdf_.palette_size_6_y_color[ctx]);
        case 7: return read(cdf_.palette_size_7_y_color[ctx]);
        default: return read(cdf_.palette_size_8_y_color[ctx]);
      }
    });
  }
  if (const int n = b_->palette_size[1]) {
    onscreen_width >>= seq_->subsampling_x;
    onscreen_height >>= seq_->subsampling_y;
    if ((width >> seq_->subsampling_x) < 4) onscreen_width += 2;
    if ((height >> seq_->subsampling_y) < 4) onscreen_height += 2;
    read_color_map(n, onscreen_width, onscreen_height, [&](int ctx) {
      switch (n) {
        case 2: return read(cdf_.palette_size_2_uv_color[ctx]);
        case 3: return read(cdf_.palette_size_3_uv_color[ctx]);
        case 4: return read(cdf_.palette_size_4_uv_color[ctx]);
        case 5: return read(cdf_.palette_size_5_uv_color[ctx]);
        case 6: return read(cdf_.palette_size_6_uv_color[ctx]);
        case 7: return read(cdf_.palette_size_7_uv_color[ctx]);
        default: return read(cdf_.palette_size_8_uv_color[ctx]);
      }
    });
  }
}

// The colour map of a plane along its anti-diagonals, with 5.11.50 get_palette_color_context( )
template <typename ReadIndex>
void TileParser::read_color_map(int size, int width, int height, ReadIndex&& read_index) {
  constexpr int kStride = 64;
  color_map_[0] = static_cast<std::uint8_t>(symbols_.ns(size));
  for (int i = 1; i < height + width - 1; ++i) {
    for (int j = std::min(i, width - 1); j >= std::max(0, i - height + 1); --j) {
      std::uint8_t* at = &color_map_[(i - j) * kStride + j];
      std::array<std::uint8_t, PALETTE_COLORS> scores{};
      std::array<std::uint8_t, PALETTE_COLORS> order{0, 1, 2, 3, 4, 5, 6, 7};
      if (j > 0) scores[at[-1]] += 2;
      if (j > 0 && i > j) scores[at[-kStride - 1]] += 1;
      if (i > j) scores[at[-kStride]] += 2;
      int hash = 0;
      for (int k = 0; k < PALETTE_NUM_NEIGHBORS; ++k) {
        int best = k;
        for (int m = k + 1; m < size; ++m) {
          if (scores[m] > scores[best]) best = m;
        }
        std::rotate(scores.begin() + k, scores.begin() + best, scores.begin() + best + 1);
        std::rotate(order.begin() + k, order.begin() + best, order.begin() + best + 1);
        hash += scores[k] * kPaletteColorHashMultipliers[k];
      }
      *at = order[read_index(kPaletteColorContext[hash])];
    }
  }
}

}  // namespace colmap_av1::av1

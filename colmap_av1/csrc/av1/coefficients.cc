#include "av1/coefficients.h"

#include <algorithm>
#include <bit>
#include <cstring>
#include <iterator>
#include <utility>

#include "av1/error.h"
#include "av1/spec_tables.h"

namespace colmap_av1::av1 {
namespace {

// CoefficientReader::levels_ holds 32x32 levels with a margin of 4 after each row and below, so
// that neighbours need no bounds checks. All sizes use the same stride, so that it is a constant.
constexpr int kLevelStride = 36;

constexpr auto kTxClasses = [] {
  std::array<std::uint8_t, TX_TYPES> classes{};
  classes.fill(TX_CLASS_2D);
  for (const int type : {V_DCT, V_ADST, V_FLIPADST}) classes[type] = TX_CLASS_VERT;
  for (const int type : {H_DCT, H_ADST, H_FLIPADST}) classes[type] = TX_CLASS_HORIZ;
  return classes;
}();

// Contexts of neighbours are processed eight at a time, in 64-bit words.
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

// Sets the first `count` entries, 1 to 16, to `value` up to `visible` and to 0 after it.
void set_contexts(std::uint8_t* p, int count, int visible, std::uint8_t value) {
  for (; count > 0; p += 8, count -= 8, visible -= 8) {
    const std::uint64_t word = (load_word(p) & ~first_bytes(count)) |
                               (kOnes * value & first_bytes(std::clamp(visible, 0, count)));
    std::memcpy(p, &word, sizeof word);
  }
}

// The values of one scan position that the loop over levels needs.
struct ScanEntry {
  std::uint16_t index;       // into CoefficientReader::levels_
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

// A scan with the parts of the contexts that depend only on the position.
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

// Levels are stored clipped to 15 in the low six bits, for coeff_br, and clipped to 3 in the high
// two bits, for coeff_base. One sum over the neighbours then serves both contexts.
constexpr int kLevelMask = 63;
constexpr int kClippedShift = 6;
constexpr int kMaxLevel = NUM_BASE_LEVELS + 1 + COEFF_BASE_RANGE;  // a Golomb code follows it

// 5.11.48 Get transform set function
int tx_set(const FrameHeader& header, const BlockInfo& block, int tx_size) {
  const int sqr = kTxSizeSqr[tx_size];
  const int sqr_up = kTxSizeSqrUp[tx_size];
  if (sqr_up > TX_32X32) return TX_SET_DCTONLY;
  if (block.is_inter) {
    if (header.reduced_tx_set || sqr_up == TX_32X32) return TX_SET_INTER_3;
    return sqr == TX_16X16 ? TX_SET_INTER_2 : TX_SET_INTER_1;
  }
  if (sqr_up == TX_32X32) return TX_SET_DCTONLY;
  return header.reduced_tx_set || sqr == TX_16X16 ? TX_SET_INTRA_2 : TX_SET_INTRA_1;
}

// 5.11.47 Transform type syntax
int read_transform_type(SymbolDecoder& symbols, CdfContext& cdf, const FrameHeader& header,
                        const BlockInfo& block, int tx_size) {
  const int set = tx_set(header, block, tx_size);
  if (set == TX_SET_DCTONLY || header.qindex(block.segment_id) == 0) return DCT_DCT;
  const int sqr = kTxSizeSqr[tx_size];
  if (block.is_inter) {
    if (set == TX_SET_INTER_1)
      return kTxTypeInterInvSet1[symbols.read(cdf.inter_tx_type_set1[sqr])];
    if (set == TX_SET_INTER_2) return kTxTypeInterInvSet2[symbols.read(cdf.inter_tx_type_set2)];
    return kTxTypeInterInvSet3[symbols.read(cdf.inter_tx_type_set3[sqr])];
  }
  const int intra_dir =
      block.use_filter_intra ? kFilterIntraModeToIntraDir[block.filter_intra_mode] : block.y_mode;
  if (set == TX_SET_INTRA_1) {
    return kTxTypeIntraInvSet1[symbols.read(cdf.intra_tx_type_set1[sqr][intra_dir])];
  }
  return kTxTypeIntraInvSet2[symbols.read(cdf.intra_tx_type_set2[sqr][intra_dir])];
}

// eob_pt, eob_extra and eob_extra_bit of coeffs( )
int read_eob(SymbolDecoder& symbols, CdfContext& cdf, int tx_size, int tx_size_ctx, int ptype,
             int tx_class) {
  const int ctx = tx_class == TX_CLASS_2D ? 0 : 1;
  const int eob_multisize =
      std::min<int>(kTxWidthLog2[tx_size], 5) + std::min<int>(kTxHeightLog2[tx_size], 5) - 4;
  int eob_pt;
  switch (eob_multisize) {
    case 0: eob_pt = symbols.read(cdf.eob_pt_16[ptype][ctx]) + 1; break;
    case 1: eob_pt = symbols.read(cdf.eob_pt_32[ptype][ctx]) + 1; break;
    case 2: eob_pt = symbols.read(cdf.eob_pt_64[ptype][ctx]) + 1; break;
    case 3: eob_pt = symbols.read(cdf.eob_pt_128[ptype][ctx]) + 1; break;
    case 4: eob_pt = symbols.read(cdf.eob_pt_256[ptype][ctx]) + 1; break;
    case 5: eob_pt = symbols.read(cdf.eob_pt_512[ptype]) + 1; break;
    default: eob_pt = symbols.read(cdf.eob_pt_1024[ptype]) + 1; break;
  }
  int eob = eob_pt < 2 ? eob_pt : (1 << (eob_pt - 2)) + 1;
  if (eob_pt >= 3) {
    if (symbols.flag(cdf.eob_extra[tx_size_ctx][ptype][eob_pt - 3])) eob += 1 << (eob_pt - 3);
    for (int shift = eob_pt - 4; shift >= 0; --shift) {
      if (symbols.bit()) eob += 1 << shift;
    }
  }
  return eob;
}

}  // namespace

void CoefficientReader::start_tile(const SequenceHeader& seq, const FrameHeader& header) {
  seq_ = &seq;
  header_ = &header;
  // Blocks may extend beyond the frame by the width of a superblock.
  const std::size_t columns = static_cast<std::size_t>(header.mi_cols) + kMaxSb4;
  for (int plane = 0; plane < seq.num_planes; ++plane) above_[plane].assign(columns, 0);
}

void CoefficientReader::clear_left_context() {
  for (auto& context : left_) context.fill(0);
}

void CoefficientReader::reset_block_context(const BlockInfo& block) {
  for (int plane = 0; plane < (block.has_chroma ? 3 : 1); ++plane) {
    const int sub_x = plane > 0 ? seq_->subsampling_x : 0;
    const int sub_y = plane > 0 ? seq_->subsampling_y : 0;
    const int x = block.mi_col >> sub_x;
    const int y = block.mi_row >> sub_y;
    const int w = ((block.mi_col + block.bw4() - 1) >> sub_x) - x + 1;
    const int h = ((block.mi_row + block.bh4() - 1) >> sub_y) - y + 1;
    std::fill_n(above_[plane].begin() + x, w, std::uint8_t{0});
    std::fill_n(left_[plane].begin() + (y & kSbMask), h, std::uint8_t{0});
  }
}

// 5.11.40 Compute transform type function, for chroma
int CoefficientReader::chroma_tx_type(const BlockInfo& block, bool lossless, int tx_size, int x4,
                                      int y4) const {
  if (lossless || kTxSizeSqrUp[tx_size] > TX_32X32) return DCT_DCT;
  const int set = tx_set(*header_, block, tx_size);
  if (block.is_inter) {
    const int col = std::max<int>(block.mi_col, x4 << seq_->subsampling_x) & kSbMask;
    const int row = std::max<int>(block.mi_row, y4 << seq_->subsampling_y) & kSbMask;
    const int tx_type = tx_types_[row * kMaxSb4 + col];
    return kTxTypeInSetInter[set][tx_type] ? tx_type : DCT_DCT;
  }
  const int tx_type = kModeToTxfm[block.uv_mode];
  return kTxTypeInSetIntra[set][tx_type] ? tx_type : DCT_DCT;
}

// 5.11.39 Coefficients syntax
void CoefficientReader::read(SymbolDecoder& symbols, CdfContext& cdf, const BlockInfo& block,
                             bool lossless, const TransformBlock& transform_block) {
  const auto [plane, x4, y4, tx_size] = transform_block;
  const int w4 = kTxWidth[tx_size] >> 2;
  const int h4 = kTxHeight[tx_size] >> 2;
  const int tx_size_ctx = (kTxSizeSqr[tx_size] + kTxSizeSqrUp[tx_size] + 1) >> 1;
  const int ptype = plane > 0;
  const int sub_x = plane > 0 ? seq_->subsampling_x : 0;
  const int sub_y = plane > 0 ? seq_->subsampling_y : 0;
  std::uint8_t* above = above_[plane].data() + x4;
  std::uint8_t* left = left_[plane].data() + (y4 & kSbMask);

  // Context of all_zero. Entries beyond the edge of the frame are always 0.
  std::uint64_t any_above = load_word(above) & first_bytes(w4);
  if (w4 > 8) any_above |= load_word(above + 8);
  std::uint64_t any_left = load_word(left) & first_bytes(h4);
  if (h4 > 8) any_left |= load_word(left + 8);
  const int plane_size = kSubsampledSize[block.mi_size][sub_x][sub_y];
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
  const bool all_zero = symbols.flag(cdf.txb_skip[tx_size_ctx][ctx]);

  int tx_type = DCT_DCT;
  std::uint8_t context = 0;
  if (!all_zero) {
    tx_type = plane == 0 ? read_transform_type(symbols, cdf, *header_, block, tx_size)
                         : chroma_tx_type(block, lossless, tx_size, x4, y4);
    // TxTypes keeps the value that was read; it is DCT_DCT for lossless and for 64 wide blocks.
    const int c = kTxClasses[tx_type];
    const int eob = read_eob(symbols, cdf, tx_size, tx_size_ctx, ptype, c);
    // Context of dc_sign: number of positive minus number of negative neighbours
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
    const auto read_levels = c == TX_CLASS_2D      ? &CoefficientReader::read_levels<TX_CLASS_2D>
                             : c == TX_CLASS_HORIZ ? &CoefficientReader::read_levels<TX_CLASS_HORIZ>
                                                   : &CoefficientReader::read_levels<TX_CLASS_VERT>;
    context = (this->*read_levels)(symbols, cdf, tx_size, tx_size_ctx, ptype, eob, dc_sign_ctx);
  }
  if (plane == 0 && block.is_inter) {
    for (int i = 0; i < h4; ++i) {
      std::fill_n(tx_types_.begin() + ((y4 + i) & kSbMask) * kMaxSb4 + (x4 & kSbMask), w4,
                  static_cast<std::uint8_t>(tx_type));
    }
  }
  set_contexts(above, w4, (header_->mi_cols >> sub_x) - x4, context);
  set_contexts(left, h4, (header_->mi_rows >> sub_y) - y4, context);
}

// The levels and signs of coeffs( ). Returns the context of the block for later blocks.
template <int kTxClass>
std::uint8_t CoefficientReader::read_levels(SymbolDecoder& decoder, CdfContext& cdf, int tx_size,
                                            int tx_size_ctx, int ptype, int eob, int dc_sign_ctx) {
  constexpr int kStride = kLevelStride;
  const ScanEntry* scan = kScans<kTxClass>[tx_size];
  auto& base_cdfs = cdf.coeff_base[tx_size_ctx][ptype];
  auto& br_cdfs = cdf.coeff_br[std::min(tx_size_ctx, TX_32X32)][ptype];
  int num_nonzero = 0;
  int num_large = 0;
  int sum = 0;
  // A copy, so that its state stays in registers: otherwise the compiler must assume that writes to
  // levels_ and to the CDFs change the decoder.
  SymbolDecoder symbols = decoder;

  // Reads coeff_br if `level` requires it, and stores the level. `near` is the sum over the
  // neighbours of its context.
  const auto complete = [&](std::uint8_t* at, int level, int near, int br_offset) {
    int stored = level * ((1 << kClippedShift) + 1);
    if (level > NUM_BASE_LEVELS) {
      auto& br_cdf = br_cdfs[std::min(((near & kLevelMask) + 1) >> 1, 6) + br_offset];
      for (int idx = 0; idx < COEFF_BASE_RANGE / (BR_CDF_SIZE - 1); ++idx) {
        const int coeff_br = symbols.symbol<BR_CDF_SIZE>(br_cdf);
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

  // The last coefficient: it is not 0, and none of its neighbours has been read yet.
  const int last = eob - 1;
  {
    const int adjusted = kAdjustedTxSize[tx_size];
    const int size = kTxWidth[adjusted] * kTxHeight[adjusted];
    const int ctx = last == 0 ? 0 : last <= size / 8 ? 1 : last <= size / 4 ? 2 : 3;
    const int level = symbols.symbol<3>(cdf.coeff_base_eob[tx_size_ctx][ptype][ctx]) + 1;
    complete(&levels_[scan[last].index], level, 0, scan[last].br_offset);
  }
  const auto read_level = [&](ScanEntry entry, bool is_dc) {
    std::uint8_t* at = &levels_[entry.index];
    // Neighbours that both contexts use
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
    // clipped sum only if that is 15.
    int ctx = std::min((near + far + (1 << kClippedShift)) >> (kClippedShift + 1), 4);
    ctx = kTxClass == TX_CLASS_2D && is_dc ? 0 : ctx + entry.base_offset;
    complete(at, symbols.symbol<4>(base_cdfs[ctx]), near, entry.br_offset);
  };
  for (int c = last - 1; c > 0; --c) read_level(scan[c], false);
  if (last > 0) read_level(scan[0], true);

  // Signs and Golomb codes, from the first coefficient to the last. Only what contexts need is
  // kept.
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
    const bool sign = symbols.flag(cdf.dc_sign[ptype][dc_sign_ctx]);
    --num_signs;
    dc_category = sign ? 1 : 2;  // even if the low 20 bits of the level are 0
    if (dc == kMaxLevel) {
      sum += golomb() - kMaxLevel;
      --num_large;
    }
  }
  while (num_large > 0) {
    const int before = large_[--num_large];  // nonzero coefficients that come later
    symbols.skip_bits(num_signs - before);
    num_signs = before;
    sum += golomb() - kMaxLevel;
  }
  symbols.skip_bits(num_signs);
  decoder = symbols;
  return static_cast<std::uint8_t>(std::min(63, sum) | (dc_category << 6));
}

}  // namespace colmap_av1::av1

// Coefficients (specification sections 5.11.39 to 5.11.41, 5.11.47 and 5.11.48; contexts as
// in 8.3.2).
#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include "av1/frame_state.h"
#include "av1/symbol_decoder.h"

namespace colmap_av1::av1 {

// A transform block; its position is in units of 4x4 samples of its plane.
struct TransformBlock {
  int plane = 0;
  int x4 = 0;
  int y4 = 0;
  int tx_size = 0;
};

// Reads the coefficients of a tile, because the symbol decoder must pass them, and drops them. Only
// what contexts need is kept. The buffers are reused for the next tile.
class CoefficientReader {
 public:
  // clear_above_context( ) of 5.11.2
  void start_tile(const SequenceHeader& seq, const FrameHeader& header);
  // clear_left_context( ) of 5.11.2
  void clear_left_context();
  // reset_block_context( ) of 5.11.5
  void reset_block_context(const BlockInfo& block);

  // 5.11.39 Coefficients syntax. Throws BitstreamError.
  void read(SymbolDecoder& symbols, CdfContext& cdf, const BlockInfo& block, bool lossless,
            const TransformBlock& transform_block);

 private:
  int chroma_tx_type(const BlockInfo& block, bool lossless, int tx_size, int x4, int y4) const;
  template <int kTxClass>
  std::uint8_t read_levels(SymbolDecoder& decoder, CdfContext& cdf, int tx_size, int tx_size_ctx,
                           int ptype, int eob, int dc_sign_ctx);

  const SequenceHeader* seq_ = nullptr;
  const FrameHeader* header_ = nullptr;
  // Contexts above (by column of the frame) and left (by row of the superblock), by plane. An entry
  // holds the level in the low six bits and the sign category of DC above.
  std::array<std::vector<std::uint8_t>, 3> above_;
  std::array<std::array<std::uint8_t, kMaxSb4 + 16>, 3> left_{};
  std::array<std::uint8_t, kMaxSb4 * kMaxSb4> tx_types_{};  // TxTypes, of the superblock
  // Coefficient levels of a transform block, with a margin of 4 after each row and below; and for
  // each level that a Golomb code follows, the number of nonzero levels read before it
  std::array<std::uint8_t, 36 * 36> levels_{};
  std::array<std::uint16_t, 32 * 32> large_{};
};

}  // namespace colmap_av1::av1

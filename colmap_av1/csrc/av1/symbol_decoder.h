// The symbol decoder (specification section 8.2).
#pragma once

#include <bit>
#include <cstddef>
#include <cstdint>

namespace colmap_av1::av1 {

// Reads symbols coded with adaptive cumulative distributions.
//
// Two representations differ from the text of the specification, with the same results:
// - CDF arrays hold 32768 - cdf ("implementations may prefer to store the inverse cdf"),
//   the last entry stays the adaptation counter;
// - SymbolValue is the top 16 bits of a 64-bit window that is refilled bytewise. Data enter
//   inverted, as the specification's exclusive-or with ones does bit by bit.
class SymbolDecoder {
 public:
  // 8.2.2 Initialization process for symbol decoder
  void init(const std::uint8_t* data, std::size_t size, bool disable_cdf_update) {
    begin_ = data_ = data;
    end_ = data + size;
    window_ = 0;
    available_ = -15;
    padding_bits_ = 0;
    range_ = 1U << 15;
    update_ = !disable_cdf_update;
    refill();
  }

  // 8.2.6 Symbol decoding process, N the number of symbols of the array
  template <int N>
  int symbol(std::uint16_t* icdf) {
    const std::uint32_t value = static_cast<std::uint32_t>(window_ >> 48);
    const std::uint32_t r = range_ >> 8;
    std::uint32_t previous;
    std::uint32_t current = range_;
    int symbol = -1;
    do {
      ++symbol;
      previous = current;
      current = ((r * (static_cast<std::uint32_t>(icdf[symbol]) >> 6)) >> 1) +
                4 * static_cast<std::uint32_t>(N - 1 - symbol);
    } while (value < current);
    renormalize(previous - current, current);
    if (update_) adapt<N>(icdf, symbol);
    return symbol;
  }

  bool flag(std::uint16_t* icdf) { return symbol<2>(icdf) != 0; }

  // A two-valued symbol whose distribution is built for the call and not adapted.
  bool flag_without_update(std::uint32_t icdf0) {
    const std::uint32_t value = static_cast<std::uint32_t>(window_ >> 48);
    const std::uint32_t current = (((range_ >> 8) * (icdf0 >> 6)) >> 1) + 4;
    if (value < current) {
      renormalize(current, 0);
      return true;
    }
    renormalize(range_ - current, current);
    return false;
  }

  // 8.2.3 Boolean decoding process
  int bit() { return flag_without_update(1U << 14); }

  // 8.2.5 Parsing process for read_literal
  int literal(int n) {
    int x = 0;
    for (int i = 0; i < n; ++i) x = 2 * x + bit();
    return x;
  }

  // NS(n)
  int non_symmetric(int n) {
    const int w = std::bit_width(static_cast<unsigned>(n));
    const int m = (1 << w) - n;
    const int v = literal(w - 1);
    if (v < m) return v;
    return (v << 1) - m + bit();
  }

  // 8.2.4 Exit process for symbol decoder: whether the bits after the last symbol are the
  // trailing bits that the specification demands.
  bool trailing_bits_valid() const {
    const std::int64_t size_bits = 8 * (end_ - begin_);
    const std::int64_t consumed = 8 * (data_ - begin_) + padding_bits_ - available_;
    if (size_bits - consumed < -14) return false;
    const std::int64_t position = consumed - 15;
    const std::uint8_t* p = begin_ + (position >> 3);
    const unsigned mask = 0xFFU >> (position & 7);
    if ((*p & mask) != ((mask + 1) >> 1)) return false;
    for (++p; p < end_; ++p) {
      if (*p != 0) return false;
    }
    return true;
  }

 private:
  template <int N>
  static void adapt(std::uint16_t* icdf, int symbol) {
    constexpr int kLog2 = N >= 4 ? 2 : 1;  // Min( FloorLog2( N ), 2 )
    const int count = icdf[N];
    const int rate = 3 + (count > 15) + (count > 31) + kLog2;
    for (int i = 0; i < N - 1; ++i) {
      const int v = icdf[i];
      icdf[i] = static_cast<std::uint16_t>(i < symbol ? v + ((32768 - v) >> rate) : v - (v >> rate));
    }
    icdf[N] = static_cast<std::uint16_t>(count + (count < 32));
  }

  void renormalize(std::uint32_t range, std::uint32_t subtrahend) {
    const int bits = std::countl_zero(static_cast<std::uint16_t>(range));
    range_ = range << bits;
    window_ = (window_ - (static_cast<std::uint64_t>(subtrahend) << 48)) << bits;
    available_ -= bits;
    if (available_ < 0) refill();
  }

  void refill() {
    int shift = 40 - available_;
    for (; shift >= 0; shift -= 8) {
      std::uint64_t byte = 0;
      if (data_ < end_) {
        byte = *data_++;
      } else {
        padding_bits_ += 8;  // zero bits behind the end of the data (section 8.2.2)
      }
      window_ |= (byte ^ 0xFF) << shift;
      available_ += 8;
    }
  }

  const std::uint8_t* begin_ = nullptr;
  const std::uint8_t* data_ = nullptr;
  const std::uint8_t* end_ = nullptr;
  std::uint64_t window_ = 0;
  int available_ = 0;  // bits in the window below SymbolValue
  std::uint32_t range_ = 0;
  std::int64_t padding_bits_ = 0;
  bool update_ = true;
};

}  // namespace colmap_av1::av1

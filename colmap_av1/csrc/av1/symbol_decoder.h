// The symbol decoder (specification section 8.2).
#pragma once

#include <bit>
#include <cstddef>
#include <cstdint>
#include <span>

#if defined(__SSE2__) || defined(_M_X64)
#include <emmintrin.h>
#endif

namespace colmap_av1::av1 {

// The bits after the last symbol of a tile. The specification requires a bit 1 and zeros to the
// end. Some encoders write other bits, which decoders ignore. More than a byte or two cannot be
// padding, though. In that case the symbols before it were decoded wrongly.
enum class TrailingBits { kValid, kOther, kData, kPastEnd };

// Reads symbols coded with adaptive cumulative distributions.
//
// Two representations differ from the text of the specification, with the same results:
// - CDF arrays hold 32768 - cdf ("implementations may prefer to store the inverse cdf");
//   the last entry is still the adaptation counter.
// - SymbolValue is the top 16 bits of a 64-bit window that is refilled by bytes. The data are
//   inverted, like the specification's bitwise exclusive-or with ones.
class SymbolDecoder {
 public:
  // 8.2.2 Initialization process for symbol decoder
  void init(std::span<const std::uint8_t> data, bool disable_cdf_update) {
    begin_ = data_ = data.data();
    end_ = begin_ + data.size();
    window_ = 0;
    available_ = -15;
    padding_bits_ = 0;
    range_ = 1U << 15;
    update_ = !disable_cdf_update;
    refill();
  }

  // 8.2.6 Symbol decoding process; N is the number of symbols of the array
  template <int N>
  int symbol(std::uint16_t* icdf) {
    static_assert(N >= 2 && N <= 16);
    if constexpr (N == 2) {
      return flag(icdf);
    } else {
      // Decoded symbols are nearly random, so the search has no branches: every bound is computed,
      // and the symbol is the number of bounds above the value.
      if constexpr (kVectors && N <= 4) {
        return symbol_by_words<N>(icdf);
      } else {
        std::uint16_t bounds[kLanes<N> + 1];
        const int symbol = find_symbol<N>(icdf, bounds + 1);
        bounds[0] = static_cast<std::uint16_t>(range_);
        renormalize(static_cast<std::uint32_t>(bounds[symbol] - bounds[symbol + 1]),
                    bounds[symbol + 1]);
        return symbol;
      }
    }
  }

  // Decodes a symbol with a whole array, which ends with its adaptation counter.
  template <std::size_t M>
  int read(std::uint16_t (&icdf)[M]) {
    return symbol<static_cast<int>(M) - 1>(icdf);
  }

  // Decodes a symbol with an array of two symbols.
  bool flag(std::uint16_t* icdf) {
    const std::uint32_t v = icdf[0];
    const bool result = flag_without_update(v);
    if (update_) {
      const std::uint32_t count = icdf[2];
      const std::uint32_t rate = 4 + (count >> 4);
      const std::uint32_t target = result ? 32768 : 0;
      const std::uint32_t up = (target - v) >> rate;  // for symbol 1: the bound rises
      const std::uint32_t down = v >> rate;
      icdf[0] = static_cast<std::uint16_t>(result ? v + up : v - down);
      icdf[2] = static_cast<std::uint16_t>(count + 1 - (count >> 5));
    }
    return result;
  }

  // Decodes a binary symbol with a distribution that is built for this call and not adapted.
  bool flag_without_update(std::uint32_t icdf0) {
    const std::uint32_t value = static_cast<std::uint32_t>(window_ >> 48);
    const std::uint32_t current = (((range_ >> 8) * (icdf0 >> 6)) >> 1) + 4;
    const bool result = value < current;
    const std::uint32_t mask = result ? 0U : ~0U;  // a select instead of an unpredictable branch
    renormalize(current + ((range_ - 2 * current) & mask), current & mask);
    return result;
  }

  // 8.2.3 Boolean decoding process
  int bit() { return flag_without_update(1U << 14); }

  // 8.2.5 Parsing process for read_literal
  int literal(int n) {
    int x = 0;
    for (int i = 0; i < n; ++i) x = 2 * x + bit();
    return x;
  }

  // Reads n bits and drops them.
  void skip_bits(int n) {
    for (; n > 0; --n) {
      const std::uint32_t half = ((range_ >> 8) << 7) + 4;
      const std::uint64_t subtrahend = static_cast<std::uint64_t>(half) << 48;
      // All ones for a bit 0, all zeros for a 1
      const std::uint64_t mask = static_cast<std::uint64_t>(window_ < subtrahend) - 1;
      const std::uint32_t range = half + ((range_ - 2 * half) & static_cast<std::uint32_t>(mask));
      // Half of a range lies between 16380 and 32895, so two bits determine the shift.
      const int bits = 2 - static_cast<int>(range >> 14);
      range_ = range << bits;
      window_ = (window_ - (subtrahend & mask)) << bits;
      available_ -= bits;
      if (available_ < 0) refill();
    }
  }

  // NS(n)
  int ns(int n) {
    const int w = std::bit_width(static_cast<unsigned>(n));
    const int m = (1 << w) - n;
    const int v = literal(w - 1);
    if (v < m) return v;
    return (v << 1) - m + bit();
  }

  // Whether more bits were read past the end than in a valid tile (8.2.4).
  bool is_past_end() const { return 8 * (end_ - data_) + available_ - padding_bits_ < -14; }

  // 8.2.4 Exit process for symbol decoder: classifies the bits after the last symbol.
  TrailingBits trailing_bits() const {
    const std::int64_t size_bits = 8 * (end_ - begin_);
    const std::int64_t consumed = 8 * (data_ - begin_) + padding_bits_ - available_;
    if (size_bits - consumed < -14) return TrailingBits::kPastEnd;
    const std::int64_t position = consumed - 15;  // trailingBitPosition
    const std::uint8_t* first = begin_ + (position >> 3);
    const unsigned mask = 0xFFU >> (position & 7);
    const std::uint8_t* last = end_;  // one past the last nonzero byte
    while (last > first + 1 && last[-1] == 0) --last;
    const bool is_first = last == first + 1;
    if (is_first && (*first & mask) == ((mask + 1) >> 1)) return TrailingBits::kValid;
    // Zeros alone are not valid padding: a hole in a file looks like this.
    if (is_first && (*first & mask) == 0) last = end_;
    constexpr std::int64_t kOtherBytes = 2;
    return last - first <= kOtherBytes ? TrailingBits::kOther : TrailingBits::kData;
  }

 private:
  // Each symbol depends on the previous one, and moving values into and out of vectors is slow. The
  // few bounds of a small array are therefore computed in scalars, in the top of 64 bits like
  // SymbolValue. Vectors compute them again, but only to adapt the array.
  template <int N>
  int symbol_by_words(std::uint16_t* icdf) {
    const std::uint64_t r = range_ >> 8;
    std::uint64_t bounds[N + 1];
    bounds[0] = std::uint64_t{range_} << 48;
    std::size_t symbol = 0;
    for (std::size_t i = 0; i < N - 1; ++i) {
      const std::uint64_t f = icdf[i];
      bounds[i + 1] = (((r * (f >> 6)) >> 1) + 4 * (N - 1 - i)) << 48;
      symbol += window_ < bounds[i + 1];
    }
    bounds[N] = 0;
    std::uint16_t unused[kLanes<N>];
    find_symbol<N>(icdf, unused);
    const std::uint64_t range = bounds[symbol] - bounds[symbol + 1];
    renormalize(static_cast<std::uint32_t>(range >> 48),
                static_cast<std::uint32_t>(bounds[symbol + 1] >> 48));
    return static_cast<int>(symbol);
  }

  // Number of entries that find_symbol writes: whole vectors of at least 4 lanes.
  template <int N>
  static constexpr int kLanes = N <= 4   ? 4
                                : N <= 8 ? 8
                                         : 16;

  // The counter stops at 32.
  static int adaptation_rate(int count, int n) {
    return 3 + (count >> 4) + (n >= 4 ? 2 : 1);  // Min( FloorLog2( N ), 2 )
  }
  static std::uint16_t next_count(int count) {
    return static_cast<std::uint16_t>(count + 1 - (count >> 5));
  }

#if defined(__SSE2__) || defined(_M_X64)
  static constexpr bool kVectors = true;

  // Writes the bounds of all symbols to `bounds`, returns the symbol, and adapts the array. Lanes
  // after the last symbol are read and written back unchanged (CdfContext has padding after its
  // last array).
  template <int N>
  int find_symbol(std::uint16_t* icdf, std::uint16_t* bounds) {
    constexpr int kParts = N <= 8 ? 1 : 2;
    // (((r >> 8) * (f >> 6)) >> 1) as the upper half of ((r >> 8) << 8) * ((f >> 6) << 7)
    const __m128i r = broadcast<N>(_mm_cvtsi32_si128(static_cast<int>(range_ & 0xFF00)));
    const __m128i value = broadcast<N>(_mm_cvtsi32_si128(static_cast<int>(window_ >> 48)));
    const __m128i lane = _mm_set_epi16(7, 6, 5, 4, 3, 2, 1, 0);
    __m128i f[kParts];
    __m128i from_symbol[kParts];  // all ones in the lanes from the symbol on
    unsigned mask = 0;
    for (int k = 0; k < kParts; ++k) {
      f[k] = load<N>(icdf + 8 * k);
      const __m128i scaled = _mm_slli_epi16(_mm_srli_epi16(f[k], 6), 7);
      const __m128i least =
          _mm_slli_epi16(_mm_sub_epi16(_mm_set1_epi16(static_cast<short>(N - 1 - 8 * k)), lane), 2);
      const __m128i bound = _mm_add_epi16(_mm_mulhi_epu16(scaled, r), least);
      store<N>(bounds + 8 * k, bound);
      // bound <= value, unsigned. This is true in the last lane, where the bound is 0.
      from_symbol[k] = _mm_cmpeq_epi16(_mm_subs_epu16(bound, value), _mm_setzero_si128());
      mask |= static_cast<unsigned>(_mm_movemask_epi8(from_symbol[k])) << (16 * k);
    }
    const int symbol = std::countr_zero(mask | 1U << (2 * N - 1)) >> 1;
    if (update_) {
      const int count = icdf[N];
      const __m128i rate = _mm_cvtsi32_si128(adaptation_rate(count, N));
      for (int k = 0; k < kParts; ++k) {
        // v + ((32768 - v) >> rate) before the symbol; from it on v - (v >> rate), which is
        // v + 1 + ((-1 - v) >> rate). Entries stay between 1 and 32767.
        const __m128i target =
            _mm_or_si128(from_symbol[k], _mm_set1_epi16(static_cast<short>(0x8000)));
        __m128i step =
            _mm_sub_epi16(_mm_sra_epi16(_mm_sub_epi16(target, f[k]), rate), from_symbol[k]);
        if constexpr (N != 4 && N != 8 && N != 16) {
          const __m128i used =
              _mm_cmplt_epi16(lane, _mm_set1_epi16(static_cast<short>(N - 1 - 8 * k)));
          step = _mm_and_si128(step, used);
        }
        store<N>(icdf + 8 * k, _mm_add_epi16(f[k], step));
      }
      icdf[N] = next_count(count);
    }
    return symbol;
  }

  // The low 16 bits in the lanes that arrays of N symbols use.
  template <int N>
  static __m128i broadcast(__m128i v) {
    const __m128i low = _mm_shufflelo_epi16(v, 0);
    return N <= 4 ? low : _mm_unpacklo_epi64(low, low);
  }

  // Arrays of up to 4 symbols take half a register.
  template <int N>
  static __m128i load(const std::uint16_t* p) {
    const auto* v = reinterpret_cast<const __m128i*>(p);
    return N <= 4 ? _mm_loadl_epi64(v) : _mm_loadu_si128(v);
  }

  template <int N>
  static void store(std::uint16_t* p, __m128i value) {
    auto* v = reinterpret_cast<__m128i*>(p);
    if constexpr (N <= 4) {
      _mm_storel_epi64(v, value);
    } else {
      _mm_storeu_si128(v, value);
    }
  }
#else
  static constexpr bool kVectors = false;

  template <int N>
  int find_symbol(std::uint16_t* icdf, std::uint16_t* bounds) {
    const std::uint32_t value = static_cast<std::uint32_t>(window_ >> 48);
    const std::uint32_t r = range_ >> 8;
    int symbol = 0;
    for (int i = 0; i < N; ++i) {
      const std::uint32_t bound = ((r * (static_cast<std::uint32_t>(icdf[i]) >> 6)) >> 1) +
                                  4 * static_cast<std::uint32_t>(N - 1 - i);
      bounds[i] = static_cast<std::uint16_t>(bound);
      symbol += value < bound;
    }
    if (update_) {
      const int count = icdf[N];
      const int rate = adaptation_rate(count, N);
      for (int i = 0; i < N - 1; ++i) {
        const int v = icdf[i];
        icdf[i] =
            static_cast<std::uint16_t>(i < symbol ? v + ((32768 - v) >> rate) : v - (v >> rate));
      }
      icdf[N] = next_count(count);
    }
    return symbol;
  }
#endif

  void renormalize(std::uint32_t range, std::uint32_t subtrahend) {
    // 15 - FloorLog2( range ), written so that the compiler sees a nonzero operand
    const int bits = std::countl_zero(2 * range | 1) - 15;
    range_ = range << bits;
    window_ = (window_ - (static_cast<std::uint64_t>(subtrahend) << 48)) << bits;
    available_ -= bits;
    if (available_ < 0) refill();
  }

  void refill() {
    int shift = 40 - available_;
    if (end_ - data_ >= 8) {
      // Load as many whole bytes as fit at once.
      std::uint64_t bytes = 0;
      for (int i = 0; i < 8; ++i) bytes = (bytes << 8) | data_[i];
      const int count = (shift >> 3) + 1;
      window_ |= (~bytes >> (64 - 8 * count)) << (shift & 7);
      data_ += count;
      available_ += 8 * count;
      return;
    }
    for (; shift >= 0; shift -= 8) {
      std::uint64_t byte = 0;
      if (data_ < end_) {
        byte = *data_++;
      } else {
        padding_bits_ += 8;  // zero bits after the end of the data (section 8.2.2)
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

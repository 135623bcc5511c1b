// Fixed and variable length codes of the headers (specification sections 4.10 and 8.1).
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>

#include "av1/error.h"

namespace colmap_av1::av1 {

class BitReader {
 public:
  explicit BitReader(std::span<const std::uint8_t> data) : data_(data) {}

  // Position in bits from the start of the data.
  std::size_t position() const { return position_; }

  int bit() {
    if (position_ >= 8 * data_.size()) throw BitstreamError("header ends inside a field");
    const int value = (data_[position_ >> 3] >> (7 - (position_ & 7))) & 1;
    ++position_;
    return value;
  }

  bool flag() { return bit() != 0; }

  // f(n), n <= 32
  std::uint32_t f(int n) {
    std::uint32_t value = 0;
    for (int i = 0; i < n; ++i) value = (value << 1) | static_cast<std::uint32_t>(bit());
    return value;
  }

  int literal(int n) { return static_cast<int>(f(n)); }

  // su(n)
  int su(int n) {
    const int value = literal(n);
    const int sign_mask = 1 << (n - 1);
    return (value & sign_mask) ? value - 2 * sign_mask : value;
  }

  // ns(n): values 0 .. n - 1
  int ns(int n) {
    int w = 0;
    for (int x = n; x != 0; x >>= 1) ++w;
    const int m = (1 << w) - n;
    const int v = literal(w - 1);
    if (v < m) return v;
    return (v << 1) - m + bit();
  }

  std::uint32_t uvlc() {
    int leading_zeros = 0;
    while (!flag()) {
      if (++leading_zeros >= 32) return 0xFFFFFFFFU;
    }
    return f(leading_zeros) + ((1U << leading_zeros) - 1);
  }

  void byte_alignment() {
    while (position_ & 7) bit();
  }

 private:
  std::span<const std::uint8_t> data_;
  std::size_t position_ = 0;
};

}  // namespace colmap_av1::av1

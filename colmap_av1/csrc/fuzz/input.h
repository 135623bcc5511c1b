// Common parts of the fuzzers: their input, which has option bytes and then temporal units, and the
// check of conditions.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <span>

namespace colmap_av1::fuzz {

inline void check(bool condition, const char* what) {
  if (condition) return;
  std::fprintf(stderr, "violated condition: %s\n", what);
  std::abort();
}

class Input {
 public:
  Input(const std::uint8_t* data, std::size_t size) : rest_(data, size) {}

  bool empty() const { return rest_.empty(); }

  // Zeros follow after the end, so that every input is valid.
  std::uint8_t byte() {
    if (rest_.empty()) return 0;
    const std::uint8_t value = rest_.front();
    rest_ = rest_.subspan(1);
    return value;
  }

  template <typename T>
  T number() {
    std::uint64_t value = 0;
    for (std::size_t i = 0; i < sizeof(T); ++i) value |= std::uint64_t{byte()} << (8 * i);
    return static_cast<T>(value);
  }

  // A temporal unit: its size in four bytes, little-endian, and its data. A size beyond the end
  // means the rest, so that a truncated or extended input is still useful.
  std::span<const std::uint8_t> unit() {
    const std::size_t size = std::min<std::size_t>(number<std::uint32_t>(), rest_.size());
    const auto unit = rest_.first(size);
    rest_ = rest_.subspan(size);
    return unit;
  }

 private:
  std::span<const std::uint8_t> rest_;
};

}  // namespace colmap_av1::fuzz

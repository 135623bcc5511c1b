// Grey pictures, and bilinear interpolation between their pixels.
#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <span>
#include <stdexcept>
#include <vector>

namespace colmap_av1::geometry {

// A view of a grey picture, row by row.
struct GreyPicture {
  std::span<const std::uint8_t> pixels;  // [height][width]
  std::int64_t width = 0;
  std::int64_t height = 0;
};

// Rows are padded to a multiple of 4 values, so that the compiler can use whole vector registers.
// The padding is ignored.
constexpr int lanes_of(int side) { return (side + 3) / 4 * 4; }

template <int kSide>
using Block = std::array<std::array<float, lanes_of(kSide)>, kSide>;

// A picture of floats whose border is replicated by a margin of some pixels. Throws
// std::invalid_argument if the pixels do not match the size.
class FloatPicture {
 public:
  explicit FloatPicture(const GreyPicture& picture, std::int64_t margin = 0) : margin_(margin) {
    if (picture.width < 0 || picture.height < 0 ||
        picture.pixels.size() != static_cast<std::size_t>(picture.width * picture.height)) {
      throw std::invalid_argument("pixels do not fit the picture's size");
    }
    // A picture without pixels has no border to replicate.
    if (picture.pixels.empty()) return;
    width_ = picture.width + 2 * margin;
    height_ = picture.height + 2 * margin;
    pixels_.resize(static_cast<std::size_t>(width_ * height_));
    for (std::int64_t y = 0; y < height_; ++y) {
      const std::int64_t row = std::clamp<std::int64_t>(y - margin, 0, picture.height - 1);
      const std::uint8_t* from = picture.pixels.data() + row * picture.width;
      float* to = pixels_.data() + y * width_;
      std::fill_n(to, margin, static_cast<float>(from[0]));
      std::copy_n(from, picture.width, to + margin);
      std::fill_n(to + margin + picture.width, margin, static_cast<float>(from[picture.width - 1]));
    }
  }

  // Interpolates the block of pixels around (x, y); the centre of the first pixel is (0.5, 0.5).
  // Returns whether the block lies within the picture and its margin.
  template <int kSide>
  bool sample(float x, float y, Block<kSide>& block) const {
    constexpr int kLanes = lanes_of(kSide);
    const float left = x - 0.5F * kSide + static_cast<float>(margin_);
    const float top = y - 0.5F * kSide + static_cast<float>(margin_);
    // One pixel beyond the block is read. The condition is false for NaN.
    if (!(left >= 0 && top >= 0 && left < static_cast<float>(width_ - kLanes) &&
          top < static_cast<float>(height_ - kSide))) {
      return false;
    }
    const auto column = static_cast<std::int64_t>(left);
    const auto row = static_cast<std::int64_t>(top);
    const float right_share = left - static_cast<float>(column);
    const float lower_share = top - static_cast<float>(row);
    const float* pixels = pixels_.data() + row * width_ + column;
    Block<kSide + 1> rows;
    for (int r = 0; r <= kSide; ++r) {
      for (int i = 0; i < kLanes; ++i) {
        rows[r][i] = pixels[i] + right_share * (pixels[i + 1] - pixels[i]);
      }
      pixels += width_;
    }
    for (int r = 0; r < kSide; ++r) {
      for (int i = 0; i < kLanes; ++i) {
        block[r][i] = rows[r][i] + lower_share * (rows[r + 1][i] - rows[r][i]);
      }
    }
    return true;
  }

 private:
  std::vector<float> pixels_;
  std::int64_t margin_ = 0;
  std::int64_t width_ = 0;
  std::int64_t height_ = 0;
};

}  // namespace colmap_av1::geometry

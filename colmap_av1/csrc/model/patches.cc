#include "model/patches.h"

#include <array>
#include <cmath>
#include <cstddef>
#include <stdexcept>

namespace colmap_av1::model {
namespace {

constexpr int kSamples = kPatch * kPatch;
// By rows, so that a compiler works on a whole one at a time.
using Row = std::array<float, kPatch>;
using Patch = std::array<Row, kPatch>;

// By halves: a processor adds what does not wait for each other at once.
float sum_of(Row row) {
  for (int half = kPatch / 2; half > 0; half /= 2) {
    for (int i = 0; i < half; ++i) {
      row[i] += row[i + half];
    }
  }
  return row[0];
}

// A picture whose pixels are numbers to compute with, each of which many patches have in common.
struct FloatPicture {
  explicit FloatPicture(const GreyPicture& picture)
      : pixels(picture.pixels.begin(), picture.pixels.end()),
        width(picture.width),
        height(picture.height) {}

  std::vector<float> pixels;  // [height][width]
  std::int64_t width;
  std::int64_t height;
};

// What lies a share of the way from each of the pixels to the next one.
Row between(const float* pixels, float share) {
  Row found;
  for (int i = 0; i < kPatch; ++i) {
    found[i] = pixels[i] + share * (pixels[i + 1] - pixels[i]);
  }
  return found;
}

// The patch around (x, y), and whether it lies within the picture.
bool sample(const FloatPicture& picture, float x, float y, Patch& patch) {
  const float left = x - 0.5F * kPatch;
  const float top = y - 0.5F * kPatch;
  // Of pixels that are read the last ones are one beyond the patch. False for what is no number.
  if (!(left >= 0 && top >= 0 && left < static_cast<float>(picture.width - kPatch) &&
        top < static_cast<float>(picture.height - kPatch))) {
    return false;
  }
  const auto column = static_cast<std::int64_t>(left);
  const auto row = static_cast<std::int64_t>(top);
  const float right_share = left - static_cast<float>(column);
  const float lower_share = top - static_cast<float>(row);
  const float* pixels = picture.pixels.data() + row * picture.width + column;
  Row upper = between(pixels, right_share);
  for (Row& own : patch) {
    pixels += picture.width;
    const Row lower = between(pixels, right_share);
    for (int i = 0; i < kPatch; ++i) {
      own[i] = upper[i] + lower_share * (lower[i] - upper[i]);
    }
    upper = lower;
  }
  return true;
}

float mean_of(const Patch& patch) {
  Row sums{};
  for (const Row& row : patch) {
    for (int i = 0; i < kPatch; ++i) {
      sums[i] += row[i];
    }
  }
  return sum_of(sums) / kSamples;
}

// Makes the mean of a patch 0 and its norm 1; false where it is too flat for that.
bool normalise(Patch& patch, float min_norm) {
  const float mean = mean_of(patch);
  Row squares{};
  for (Row& row : patch) {
    for (int i = 0; i < kPatch; ++i) {
      row[i] -= mean;
      squares[i] += row[i] * row[i];
    }
  }
  const float norm = std::sqrt(sum_of(squares));
  if (!(norm >= min_norm && norm > 0)) {
    return false;
  }
  for (Row& row : patch) {
    for (float& value : row) {
      value /= norm;
    }
  }
  return true;
}

// Correlation of a normalised patch with one that is not; -1 where that is too flat.
float correlation(const Patch& normalised, const Patch& other, float min_norm) {
  const float mean = mean_of(other);
  Row squares{};
  Row products{};
  for (int row = 0; row < kPatch; ++row) {
    for (int i = 0; i < kPatch; ++i) {
      const float value = other[row][i] - mean;
      squares[i] += value * value;
      products[i] += normalised[row][i] * value;
    }
  }
  const float norm = std::sqrt(sum_of(squares));
  return norm >= min_norm && norm > 0 ? sum_of(products) / norm : -1;
}

void check(const GreyPicture& picture) {
  if (picture.width < 0 || picture.height < 0 ||
      picture.pixels.size() != static_cast<std::size_t>(picture.width * picture.height)) {
    throw std::invalid_argument("pixels do not fit the picture's size");
  }
}

}  // namespace

std::vector<float> correlate_patches(const GreyPicture& one, std::span<const float> at_one,
                                     const GreyPicture& two, std::span<const float> at_two,
                                     float min_deviation) {
  check(one);
  check(two);
  const std::size_t count = at_one.size() / 2;
  if (at_one.size() % 2 != 0 || at_two.size() % 2 != 0 ||
      (count == 0 ? !at_two.empty() : at_two.size() % at_one.size() != 0)) {
    throw std::invalid_argument("positions do not fit each other");
  }
  const std::size_t tried = count == 0 ? 0 : at_two.size() / at_one.size();
  const float min_norm = min_deviation * kPatch;  // the root of the number of samples
  const FloatPicture first(one);
  const FloatPicture second(two);
  std::vector<float> found(count * tried, -1.0F);
  for (std::size_t i = 0; i < count; ++i) {
    Patch own;
    if (!sample(first, at_one[2 * i], at_one[2 * i + 1], own) || !normalise(own, min_norm)) {
      continue;
    }
    for (std::size_t k = i * tried; k < (i + 1) * tried; ++k) {
      Patch other;
      if (sample(second, at_two[2 * k], at_two[2 * k + 1], other)) {
        found[k] = correlation(own, other, min_norm);
      }
    }
  }
  return found;
}

}  // namespace colmap_av1::model

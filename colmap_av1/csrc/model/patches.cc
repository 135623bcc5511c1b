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

float sum_of(const Row& row) {
  float sum = 0;
  for (const float value : row) {
    sum += value;
  }
  return sum;
}

// The patch around (x, y), and whether it lies within the picture.
bool sample(const GreyPicture& picture, float x, float y, Patch& patch) {
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
  const float weights[] = {(1 - right_share) * (1 - lower_share), right_share * (1 - lower_share),
                           (1 - right_share) * lower_share, right_share * lower_share};
  const std::uint8_t* upper = picture.pixels.data() + row * picture.width + column;
  for (Row& own : patch) {
    const std::uint8_t* lower = upper + picture.width;
    for (int i = 0; i < kPatch; ++i) {
      own[i] = weights[0] * upper[i] + weights[1] * upper[i + 1] + weights[2] * lower[i] +
               weights[3] * lower[i + 1];
    }
    upper = lower;
  }
  return true;
}

// Sums of a patch's values and of their squares.
struct Sums {
  float values = 0;
  float squares = 0;
};

Sums sums_of(const Patch& patch) {
  Row values{};
  Row squares{};
  for (const Row& row : patch) {
    for (int i = 0; i < kPatch; ++i) {
      values[i] += row[i];
      squares[i] += row[i] * row[i];
    }
  }
  return {sum_of(values), sum_of(squares)};
}

// Makes the mean of a patch 0 and its norm 1; false where it is too flat for that.
bool normalise(Patch& patch, float min_norm) {
  const float mean = sums_of(patch).values / kSamples;
  for (Row& row : patch) {
    for (float& value : row) {
      value -= mean;
    }
  }
  const float norm = std::sqrt(sums_of(patch).squares);
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

// Correlation of a normalised patch with one that is not.
float correlation(const Patch& normalised, Patch& other, float min_norm) {
  if (!normalise(other, min_norm)) {
    return -1;
  }
  Row products{};
  for (int row = 0; row < kPatch; ++row) {
    for (int i = 0; i < kPatch; ++i) {
      products[i] += normalised[row][i] * other[row][i];
    }
  }
  return sum_of(products);
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
  std::vector<float> found(count * tried, -1.0F);
  for (std::size_t i = 0; i < count; ++i) {
    Patch own;
    if (!sample(one, at_one[2 * i], at_one[2 * i + 1], own) || !normalise(own, min_norm)) {
      continue;
    }
    for (std::size_t k = i * tried; k < (i + 1) * tried; ++k) {
      Patch other;
      if (sample(two, at_two[2 * k], at_two[2 * k + 1], other)) {
        found[k] = correlation(own, other, min_norm);
      }
    }
  }
  return found;
}

}  // namespace colmap_av1::model

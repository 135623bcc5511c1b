#include "geometry/patches.h"

#include <array>
#include <cmath>
#include <cstddef>
#include <stdexcept>

namespace colmap_av1::geometry {
namespace {

constexpr int kSamples = kPatch * kPatch;
static_assert(lanes_of(kPatch) == kPatch, "each lane counts");
using Patch = Block<kPatch>;
using Row = Patch::value_type;

// Sums the halves separately, because a processor does independent additions in parallel.
float sum_of(Row row) {
  for (int half = kPatch / 2; half > 0; half /= 2) {
    for (int i = 0; i < half; ++i) {
      row[i] += row[i + half];
    }
  }
  return row[0];
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

// Normalises a patch to mean 0 and norm 1; false if it has too little contrast.
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

// Correlation of a normalised patch with another patch; -1 if that has too little contrast.
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

}  // namespace

std::vector<float> correlate_patches(const GreyPicture& one, std::span<const float> at_one,
                                     const GreyPicture& two, std::span<const float> at_two,
                                     float min_deviation) {
  const std::size_t count = at_one.size() / 2;
  if (at_one.size() % 2 != 0 || at_two.size() % 2 != 0 ||
      (count == 0 ? !at_two.empty() : at_two.size() % at_one.size() != 0)) {
    throw std::invalid_argument("positions do not fit each other");
  }
  const std::size_t tried = count == 0 ? 0 : at_two.size() / at_one.size();
  const float min_norm = min_deviation * kPatch;  // kPatch is the root of the number of samples
  const FloatPicture first(one);
  const FloatPicture second(two);
  std::vector<float> found(count * tried, -1.0F);
  for (std::size_t i = 0; i < count; ++i) {
    Patch own;
    if (!first.sample<kPatch>(at_one[2 * i], at_one[2 * i + 1], own) || !normalise(own, min_norm)) {
      continue;
    }
    for (std::size_t k = i * tried; k < (i + 1) * tried; ++k) {
      Patch other;
      if (second.sample<kPatch>(at_two[2 * k], at_two[2 * k + 1], other)) {
        found[k] = correlation(own, other, min_norm);
      }
    }
  }
  return found;
}

}  // namespace colmap_av1::geometry

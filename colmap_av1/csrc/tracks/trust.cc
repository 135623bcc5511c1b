#include "tracks/trust.h"

#include <algorithm>
#include <cmath>

#include "av1/constants.h"

namespace colmap_av1::tracks {
namespace {

constexpr float kFloor = 0.12F;

}  // namespace

float step_sigma(const StepTraits& traits) {
  const float size = std::log2(static_cast<float>(traits.block_area)) - 6.F;
  float log_sigma = -1.6F + 0.12F * std::max(0.F, size);
  if (!traits.coded) log_sigma += 0.5F;
  if (traits.disagreement > 0) log_sigma += 0.3F * std::log1p(traits.disagreement);
  return std::max(kFloor, std::exp(log_sigma));
}

}  // namespace colmap_av1::tracks

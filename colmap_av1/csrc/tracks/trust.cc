#include "tracks/trust.h"

#include <algorithm>
#include <cmath>

#include "av1/constants.h"

namespace colmap_av1::tracks {
namespace {

// The logarithm of the variance in px^2 is linear in these traits. Fitted by
// examples/benchmarks/fit_trust.py.
constexpr float kConstant = -2.77F;
constexpr float kDisagreement = 0.87F;  // times log(0.1 px + disagreement)
constexpr float kLength = 0.71F;        // times log(1 px + length)
constexpr float kSize = 0.28F;          // times log2 of the area over that of 8x8
constexpr float kNoResidual = 0.49F;
constexpr float kOverlapped = 0.19F;
constexpr float kWarped = -0.31F;
constexpr float kNewVector = -1.37F;

// Disagreement in px that is assumed for a block without neighbours to compare with.
constexpr float kUnknownDisagreement = 0.5F;
constexpr float kMaxSigma = 4.F;  // px

// Whether the encoder coded a new vector instead of using a neighbour's.
bool has_new_vector(int y_mode) { return y_mode == av1::NEWMV || y_mode == av1::NEW_NEWMV; }

}  // namespace

float step_sigma(const StepTraits& traits) {
  const float disagreement =
      traits.disagreement >= 0.F ? traits.disagreement : kUnknownDisagreement;
  float log_variance = kConstant + kDisagreement * std::log(0.1F + disagreement) +
                       kLength * std::log1p(traits.length) +
                       kSize * (std::log2(static_cast<float>(traits.block_area)) - 6.F);
  if (!traits.has_residual) log_variance += kNoResidual;
  if (traits.overlapped) log_variance += kOverlapped;
  if (traits.warped) log_variance += kWarped;
  if (has_new_vector(traits.y_mode)) log_variance += kNewVector;
  return std::min(kMaxSigma, std::exp(0.5F * log_variance));
}

}  // namespace colmap_av1::tracks

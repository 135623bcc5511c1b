#include "tracks/affine_motion.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <vector>

namespace colmap_av1::tracks {
namespace {

constexpr double kShare = 0.9;
constexpr double kWithin = 0.25;  // px, the resolution of most vectors

}  // namespace

AffineMotion::AffineMotion(std::span<const TimedMotion> spread, double width, double height) {
  std::vector<MotionSample> samples;
  samples.reserve(spread.size());
  for (const TimedMotion& motion : spread) {
    if (motion.interval == 0) continue;
    MotionSample sample = motion.sample;
    sample.dx /= static_cast<float>(motion.interval);
    sample.dy /= static_cast<float>(motion.interval);
    samples.push_back(sample);
  }
  std::vector<float> scratch;
  velocity_ = fit_dominant_motion(samples, width, height, scratch);
  const auto agreeing = std::count_if(spread.begin(), spread.end(),
                                      [&](const TimedMotion& motion) { return fits(motion); });
  is_common_ = static_cast<double>(agreeing) >= kShare * static_cast<double>(spread.size());
}

bool AffineMotion::agrees(const TimedMotion& motion) const { return is_common_ && fits(motion); }

bool AffineMotion::fits(const TimedMotion& motion) const {
  if (!velocity_.valid || motion.interval == 0) return false;
  const MotionSample& at = motion.sample;
  return std::abs(at.dx - motion.interval * velocity_.dx(at.x, at.y)) <= kWithin &&
         std::abs(at.dy - motion.interval * velocity_.dy(at.x, at.y)) <= kWithin;
}

}  // namespace colmap_av1::tracks

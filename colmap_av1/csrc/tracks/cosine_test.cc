#include "tracks/cosine_test.h"

#include <cmath>
#include <cstddef>
#include <limits>

namespace colmap_av1::tracks {
namespace {

constexpr std::size_t kMaxDominantSamples = 1024;
constexpr float kNan = std::numeric_limits<float>::quiet_NaN();

}  // namespace

CosineTest::CosineTest(const TrackBuilderOptions& options)
    : least_(options.cosine),
      relative_to_dominant_(options.cosine_relative_to_dominant),
      scale2_(options.cosine_scale * options.cosine_scale) {}

void CosineTest::start_frame(ChainedFrame& frame) const {
  if (is_on()) frame.velocity.assign(frame.cells.size(), Point{kNan, kNan});
}

void CosineTest::prepare(const ChainedFrame& current, Link& link) {
  if (!is_on() || !relative_to_dominant_) return;
  const TrustedMotion& frame = link.forward ? link.other->motion : current.motion;
  std::size_t count = 0;
  for (int ref = 1; ref < kNumRefs; ++ref) count += link.refs[ref] ? frame.num_linked[ref] : 0;
  const std::size_t stride = count / kMaxDominantSamples + 1;
  samples_.clear();
  std::size_t index = 0;
  for (const auto& list : frame.used_lists()) {
    for (std::size_t unit = 0; unit < list.size(); ++unit) {
      if (!link.refs[list[unit].ref] || index++ % stride != 0) continue;
      const Point centre = frame.unit_centre(static_cast<int>(unit));
      samples_.push_back({centre.x, centre.y, list[unit].dx, list[unit].dy});
    }
  }
  link.dominant = fit_dominant_motion(samples_, frame.coded_width, frame.height, scratch_);
}

std::optional<Point> CosineTest::passed(const Link& link, int other_cell, Point from,
                                        Point moved) const {
  if (!is_on()) return Point{};
  // Velocities are kept in pixels of the picture they belong to.
  const Point stored = link.other->velocity[other_cell];
  const Point previous{stored.x * link.picture_x, stored.y * link.picture_y};
  const bool relative = relative_to_dominant_;
  if (link.interval == 0 || (relative && !link.dominant.valid)) return previous;

  const double vx = (moved.x - from.x) * link.to_velocity_x;
  const double vy = (moved.y - from.y) * link.to_velocity_y;
  const double dominant_x = relative ? link.dominant.dx(from.x, from.y) * link.to_velocity_x : 0;
  const double dominant_y = relative ? link.dominant.dy(from.x, from.y) * link.to_velocity_y : 0;
  const Point velocity{static_cast<float>(vx - dominant_x), static_cast<float>(vy - dominant_y)};
  if (std::isnan(previous.x)) return velocity;
  const double px = previous.x + dominant_x;
  const double py = previous.y + dominant_y;
  const double norm = std::sqrt((vx * vx + vy * vy + scale2_) * (px * px + py * py + scale2_));
  if (vx * px + vy * py + scale2_ >= *least_ * norm) return velocity;
  return std::nullopt;
}

}  // namespace colmap_av1::tracks

#include "tracks/fill_motion.h"

#include <algorithm>
#include <cmath>

#include "av1/spec_tables.h"

namespace colmap_av1::tracks {
namespace {

constexpr int kMaxBridge = 8;  // largest distance in units to the motion on either side

enum class Axis { kAcross, kDown };

int block_units(int mi_size, Axis axis) {
  return (axis == Axis::kAcross ? av1::kBlockWidth[mi_size] : av1::kBlockHeight[mi_size]) / 4;
}

// The difference between a unit's interpolated motion and its block's vector, along one axis,
// towards the block before or after it.
Point towards_neighbour(const TrustedMotion& motion, const std::vector<UnitMotion>& blocks,
                        float limit, int row, int col, Axis axis) {
  const int unit = row * motion.cols + col;
  const int place = axis == Axis::kAcross ? col : row;
  const int end = axis == Axis::kAcross ? motion.visible_cols : motion.visible_rows;
  const int stride = axis == Axis::kAcross ? 1 : motion.cols;
  const int units = block_units(motion.mi_size[unit], axis);
  const int first = place & ~(units - 1);
  const int twice_offset = 2 * (place - first) + 1 - units;  // from the centre, in units
  const int neighbour = twice_offset < 0 ? first - 1 : first + units;
  if (twice_offset == 0 || neighbour < 0 || neighbour >= end) return {};
  const int other_unit = unit + (neighbour - place) * stride;
  const UnitMotion& own = blocks[unit];
  const UnitMotion& other = blocks[other_unit];
  if (other.ref != own.ref || !moves_alike(other, own, limit)) return {};
  const int other_units = block_units(motion.mi_size[other_unit], axis);
  const int twice_distance = units + (other.warp >= 0 ? 1 : other_units);
  const float share =
      static_cast<float>(std::abs(twice_offset)) / static_cast<float>(twice_distance);
  return {share * (other.dx - own.dx), share * (other.dy - own.dy)};
}

// The nearest unit with motion in one direction from a unit, and its distance in units. Null beyond
// kMaxBridge.
struct NearestMotion {
  const UnitMotion* motion = nullptr;
  int distance = 0;
};

NearestMotion nearest_motion(const TrustedMotion& motion, const std::vector<UnitMotion>& units,
                             int row, int col, Axis axis, int direction) {
  for (int distance = 1; distance <= kMaxBridge; ++distance) {
    (axis == Axis::kAcross ? col : row) += direction;
    if (!motion.is_visible(row, col)) break;
    const UnitMotion& found = units[row * motion.cols + col];
    if (found.ref != 0) return {&found, distance};
  }
  return {};
}

// The motion interpolated between those on both sides of a unit; ref 0 if they do not agree.
UnitMotion motion_between(const TrustedMotion& motion, const std::vector<UnitMotion>& units,
                          float limit, int row, int col) {
  UnitMotion between;
  float total = 0.F;
  for (const Axis axis : {Axis::kAcross, Axis::kDown}) {
    const NearestMotion before = nearest_motion(motion, units, row, col, axis, -1);
    const NearestMotion after = nearest_motion(motion, units, row, col, axis, 1);
    if (before.motion == nullptr || after.motion == nullptr) continue;
    const UnitMotion& a = *before.motion;
    const UnitMotion& b = *after.motion;
    if (a.ref != b.ref || (between.ref != 0 && a.ref != between.ref)) continue;
    if (!moves_alike(a, b, limit)) return {};
    const auto gap_units = static_cast<float>(before.distance + after.distance);
    const float share = static_cast<float>(before.distance) / gap_units;
    const float weight = 1.F / gap_units;
    const float gap = distance({a.dx, a.dy}, {b.dx, b.dy});
    between.dx += weight * (a.dx + share * (b.dx - a.dx));
    between.dy += weight * (a.dy + share * (b.dy - a.dy));
    between.variance += weight * (std::max(a.variance, b.variance) + gap * gap);
    between.ref = a.ref;
    total += weight;
  }
  if (between.ref == 0) return {};
  between.dx /= total;
  between.dy /= total;
  between.variance /= total;
  return between;
}

}  // namespace

void interpolate_blocks(float limit, std::vector<UnitMotion>& unfilled, TrustedMotion& motion) {
  for (auto& list : motion.used_lists()) {
    unfilled.assign(list.begin(), list.end());
    for (int row = 0; row < motion.visible_rows; ++row) {
      for (int col = 0; col < motion.visible_cols; ++col) {
        const int unit = row * motion.cols + col;
        if (unfilled[unit].ref == 0 || unfilled[unit].warp >= 0) continue;
        for (const Axis axis : {Axis::kAcross, Axis::kDown}) {
          const Point more = towards_neighbour(motion, unfilled, limit, row, col, axis);
          list[unit].dx += more.x;
          list[unit].dy += more.y;
        }
      }
    }
  }
}

void bridge_blocks(float limit, std::vector<UnitMotion>& unfilled, TrustedMotion& motion) {
  auto& list = motion.lists[0];
  unfilled.assign(list.begin(), list.end());
  for (int row = 0; row < motion.visible_rows; ++row) {
    for (int col = 0; col < motion.visible_cols; ++col) {
      const int unit = row * motion.cols + col;
      if (motion.moves(unit)) continue;
      const UnitMotion between = motion_between(motion, unfilled, limit, row, col);
      if (between.ref != 0) list[unit] = between;
    }
  }
}

}  // namespace colmap_av1::tracks

// Positions in a frame and its 4x4 luma units.
#pragma once

#include <algorithm>
#include <cmath>

namespace colmap_av1::tracks {

inline constexpr float kUnit = 4.F;  // width of a unit in coded pixels

struct Point {
  float x = 0.F;
  float y = 0.F;
};

// The distance of two points along the axis on which they are farther apart.
inline float distance(Point a, Point b) {
  return std::max(std::abs(a.x - b.x), std::abs(a.y - b.y));
}

}  // namespace colmap_av1::tracks

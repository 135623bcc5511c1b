// The motion that most of a frame shares, which is that of the camera, including shake.
#pragma once

#include <array>
#include <span>
#include <vector>

namespace colmap_av1::tracks {

struct MotionSample {
  float x = 0.F;
  float y = 0.F;
  float dx = 0.F;
  float dy = 0.F;
};

// Displacement (dx, dy) = u, v . (1, (x - center_x) * scale, (y - center_y) * scale).
struct DominantMotion {
  bool valid = false;
  double center_x = 0;
  double center_y = 0;
  double scale = 1;
  std::array<double, 3> u{};
  std::array<double, 3> v{};

  double dx(double x, double y) const {
    return u[0] + u[1] * (x - center_x) * scale + u[2] * (y - center_y) * scale;
  }
  double dy(double x, double y) const {
    return v[0] + v[1] * (x - center_x) * scale + v[2] * (y - center_y) * scale;
  }
};

// Affine motion field by iteratively reweighted least squares (Tukey's biweight,
// started at the median). Not valid if the samples are too few to determine a majority.
// `scratch` is working memory that the caller reuses.
DominantMotion fit_dominant_motion(std::span<const MotionSample> samples, double width,
                                   double height, std::vector<float>& scratch);

}  // namespace colmap_av1::tracks

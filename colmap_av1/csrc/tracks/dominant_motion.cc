#include "tracks/dominant_motion.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <optional>

namespace colmap_av1::tracks {
namespace {

constexpr std::size_t kMinSamples = 64;
constexpr int kIterations = 6;
constexpr double kTukey = 4.685;  // 95 % efficiency on Gaussian residuals
constexpr double kMadToSigma = 1.4826;
constexpr double kMinSigma = 0.25;  // px, the resolution of the vectors
constexpr double kRidge = 1e-4;     // keeps the slopes small if samples lie on one side only

double median(std::vector<float>& values) {
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

// Solves the symmetric positive definite system a x = b by Cholesky decomposition; nothing if it is
// not positive definite.
std::optional<std::array<double, 3>> solve3(const double (&a)[3][3], const double (&b)[3]) {
  double l[3][3] = {};
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j <= i; ++j) {
      double sum = a[i][j];
      for (int k = 0; k < j; ++k) sum -= l[i][k] * l[j][k];
      if (i == j) {
        if (sum <= 0) return std::nullopt;
        l[i][i] = std::sqrt(sum);
      } else {
        l[i][j] = sum / l[j][j];
      }
    }
  }
  double y[3];
  for (int i = 0; i < 3; ++i) {
    double sum = b[i];
    for (int k = 0; k < i; ++k) sum -= l[i][k] * y[k];
    y[i] = sum / l[i][i];
  }
  std::array<double, 3> x{};
  for (int i = 2; i >= 0; --i) {
    double sum = y[i];
    for (int k = i + 1; k < 3; ++k) sum -= l[k][i] * x[k];
    x[i] = sum / l[i][i];
  }
  return x;
}

}  // namespace

DominantMotion fit_dominant_motion(std::span<const MotionSample> samples, double width,
                                   double height, std::vector<float>& scratch) {
  DominantMotion motion;
  if (samples.size() < kMinSamples) return motion;
  motion.center_x = width / 2;
  motion.center_y = height / 2;
  motion.scale = 2 / std::max(width, height);

  scratch.resize(samples.size());
  for (std::size_t i = 0; i < samples.size(); ++i) scratch[i] = samples[i].dx;
  motion.u[0] = median(scratch);
  for (std::size_t i = 0; i < samples.size(); ++i) scratch[i] = samples[i].dy;
  motion.v[0] = median(scratch);

  const auto residual = [&motion](const MotionSample& s) {
    const double x = s.dx - motion.dx(s.x, s.y);
    const double y = s.dy - motion.dy(s.x, s.y);
    return std::sqrt(x * x + y * y);
  };
  for (int iteration = 0; iteration < kIterations; ++iteration) {
    for (std::size_t i = 0; i < samples.size(); ++i) {
      scratch[i] = static_cast<float>(residual(samples[i]));
    }
    const double cut = kTukey * std::max(kMinSigma, kMadToSigma * median(scratch));
    double normal[3][3] = {};
    double right_u[3] = {};
    double right_v[3] = {};
    for (const MotionSample& s : samples) {
      const double ratio = residual(s) / cut;
      if (ratio >= 1) continue;
      const double weight = (1 - ratio * ratio) * (1 - ratio * ratio);
      const double basis[3] = {1, (s.x - motion.center_x) * motion.scale,
                               (s.y - motion.center_y) * motion.scale};
      for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) normal[i][j] += weight * basis[i] * basis[j];
        right_u[i] += weight * basis[i] * s.dx;
        right_v[i] += weight * basis[i] * s.dy;
      }
    }
    normal[1][1] += kRidge * normal[0][0];
    normal[2][2] += kRidge * normal[0][0];
    const auto u = solve3(normal, right_u);
    const auto v = solve3(normal, right_v);
    if (!u || !v) return motion;
    motion.u = *u;
    motion.v = *v;
  }
  motion.valid = true;
  return motion;
}

}  // namespace colmap_av1::tracks

#include "geometry/triangulate.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <stdexcept>

#include "geometry/geometry.h"

namespace colmap_av1::geometry {
namespace {

// Pairs of rays that give initial points, by their positions in the track from 0 to 1.
constexpr std::array<std::array<double, 2>, 4> kGuesses{
    {{0.0, 1.0}, {0.0, 0.5}, {0.5, 1.0}, {0.25, 0.75}}};
constexpr int kIterations = 4;
// Iteration stops after a step that leaves more than this share of the cost.
constexpr double kConverged = 0.999;
// Squared error in px^2 at which the weight of an observation is halved.
constexpr double kSoftError2 = 1.0;
// Equations are singular if their determinant, divided by the cube of their trace, is below this.
// Two rays are parallel if their squared sine is below this.
constexpr double kSingular = 1e-12;
constexpr double kInfinite = std::numeric_limits<double>::infinity();

struct Observation {
  std::int64_t index = 0;
  const double* pose = nullptr;
  const double* focal = nullptr;
  double x = 0;  // ray
  double y = 0;
  double weight = 0;  // inverse expected variance
};

Projection projection_of(const Observation& seen, const Vector& point) {
  return project(seen.pose, seen.focal, seen.x, seen.y, point.data());
}

// Sum of the squared errors, each truncated at the limit.
double cost_of(std::span<const Observation> track, const Vector& point, double limit) {
  double cost = 0;
  for (const Observation& seen : track) cost += std::min(projection_of(seen, point).error2, limit);
  return cost;
}

// Unit vector of a ray in world coordinates.
Vector direction(const Observation& seen) {
  Vector found{};
  for (std::size_t i = 0; i < 3; ++i) {
    found[i] = seen.pose[i] * seen.x + seen.pose[4 + i] * seen.y + seen.pose[8 + i];
  }
  const double norm = std::sqrt(dot(found, found));
  for (double& value : found) value /= norm;
  return found;
}

// The point midway between two rays where they are closest to each other.
Vector midpoint(const Observation& a, const Observation& b) {
  const Vector da = direction(a);
  const Vector db = direction(b);
  const Vector ca = camera_centre(a.pose);
  const Vector cb = camera_centre(b.pose);
  const Vector apart = between(ca.data(), cb.data());
  const double cosine = dot(da, db);
  const double along_a = dot(da, apart);
  const double along_b = dot(db, apart);
  const double sine2 = std::max(1.0 - cosine * cosine, kSingular);
  const double on_a = (along_a - cosine * along_b) / sine2;
  const double on_b = (cosine * along_a - along_b) / sine2;
  Vector found{};
  for (std::size_t i = 0; i < 3; ++i) {
    found[i] = (ca[i] + da[i] * on_a + cb[i] + db[i] * on_b) / 2;
  }
  return found;
}

struct Guess {
  Vector point{};
  double cost = kInfinite;
};

Guess first_guess(std::span<const Observation> track, double limit) {
  const auto last = static_cast<double>(track.size() - 1);
  Guess best;
  for (const auto& [one, two] : kGuesses) {
    const auto a = static_cast<std::size_t>(std::floor(one * last));
    const auto b = static_cast<std::size_t>(std::ceil(two * last));
    const Vector point = midpoint(track[a], track[b]);
    const double cost = cost_of(track, point, limit);
    if (cost < best.cost) best = {point, cost};
  }
  return best;
}

// Solves the symmetric equations of a Gauss-Newton step, given their upper triangle; 0 if singular.
Vector solve(const std::array<double, 6>& n, const Vector& gradient) {
  const auto [a, b, c, d, e, f] = n;  // a b c / . d e / . . f
  const double trace = a + d + f;
  const double det = a * (d * f - e * e) - b * (b * f - e * c) + c * (b * e - d * c);
  if (!std::isfinite(trace) || !(det > kSingular * trace * trace * trace)) return {};
  // LDL^T.
  const double l10 = b / a;
  const double l20 = c / a;
  const double d1 = d - l10 * b;
  const double l21 = (e - l20 * b) / d1;
  const double d2 = f - l20 * c - l21 * l21 * d1;
  const double y0 = gradient[0];
  const double y1 = gradient[1] - l10 * y0;
  const double y2 = gradient[2] - l20 * y0 - l21 * y1;
  Vector step{};
  step[2] = y2 / d2;
  step[1] = y1 / d1 - l21 * step[2];
  step[0] = y0 / a - l10 * step[1] - l20 * step[2];
  return step;
}

Vector gauss_newton_step(std::span<const Observation> track, const Vector& point, double limit) {
  std::array<double, 6> normal{};
  Vector gradient{};
  for (const Observation& seen : track) {
    const Projection at = projection_of(seen, point);
    if (at.error2 > limit) continue;
    const double weight = seen.weight / (1.0 + at.error2 / kSoftError2);
    const std::array<double, 2> where{at.x, at.y};
    const std::array<double, 2> ray{seen.x, seen.y};
    for (std::size_t k = 0; k < 2; ++k) {
      const double scale = seen.focal[k] / at.depth;
      const double residual = (where[k] - ray[k]) * seen.focal[k];
      const double* row = seen.pose + 4 * k;
      Vector jacobian{};
      for (std::size_t i = 0; i < 3; ++i) {
        jacobian[i] = scale * (row[i] - where[k] * seen.pose[8 + i]);
        gradient[i] += weight * jacobian[i] * residual;
      }
      normal[0] += weight * jacobian[0] * jacobian[0];
      normal[1] += weight * jacobian[0] * jacobian[1];
      normal[2] += weight * jacobian[0] * jacobian[2];
      normal[3] += weight * jacobian[1] * jacobian[1];
      normal[4] += weight * jacobian[1] * jacobian[2];
      normal[5] += weight * jacobian[2] * jacobian[2];
    }
  }
  return solve(normal, gradient);
}

Vector locate(std::span<const Observation> track, double limit) {
  auto [point, cost] = first_guess(track, limit);
  for (int i = 0; i < kIterations; ++i) {
    const Vector step = gauss_newton_step(track, point, limit);
    const Vector moved{point[0] - step[0], point[1] - step[1], point[2] - step[2]};
    const double then = cost_of(track, moved, limit);
    const bool goes_on = then < kConverged * cost;
    // A step that increases the cost is rejected.
    if (then < cost) {
      point = moved;
      cost = then;
    }
    if (!goes_on) break;
  }
  return point;
}

double angle_of(std::span<const Observation> kept, const Vector& point) {
  return widest_angle(kept.size(), [&](std::size_t i) {
    return unit_vector(camera_centre(kept[i].pose).data(), point.data());
  });
}

// Whether the depth of a point with this triangulation angle and mean error is accurate.
bool is_sure(double angle, double error, const double* focal, const TriangulateOptions& options) {
  if (angle < options.min_angle) return false;
  if (!options.max_depth_error) return true;
  // The errors of a track's observations are correlated, and only a part of them appears in the
  // reprojection error.
  const double pixels = std::hypot(options.sigma_floor, options.error_to_sigma * error);
  return pixels <= *options.max_depth_error * ((focal[0] + focal[1]) / 2) * angle;
}

void check(const PosedTracks& tracks, std::int64_t first, std::int64_t last) {
  const std::size_t total = tracks.view.size();
  const std::size_t num_views = tracks.focal.size() / 2;
  if (tracks.cam_from_world.size() != 12 * num_views || tracks.focal.size() != 2 * num_views) {
    throw std::invalid_argument("poses and focal lengths do not fit each other");
  }
  if (tracks.rays.size() != 2 * total || tracks.sigma.size() != total || tracks.offsets.empty()) {
    throw std::invalid_argument("view, rays and sigma do not fit each other");
  }
  if (first < 0 || first > last || last >= static_cast<std::int64_t>(tracks.offsets.size())) {
    throw std::invalid_argument("there are no such tracks");
  }
  const auto own = tracks.offsets.subspan(static_cast<std::size_t>(first),
                                          static_cast<std::size_t>(last - first) + 1);
  if (own.front() < 0 || own.back() > static_cast<std::int64_t>(total) ||
      !std::is_sorted(own.begin(), own.end())) {
    throw std::invalid_argument("offsets and view do not fit each other");
  }
  for (std::int64_t i = own.front(); i < own.back(); ++i) {
    const std::int64_t view = tracks.view[static_cast<std::size_t>(i)];
    if (view < 0 || view >= static_cast<std::int64_t>(num_views)) {
      throw std::invalid_argument("an observation is of no view");
    }
  }
}

// The observations of a track that have a finite ray.
void gather(const PosedTracks& tracks, std::int64_t track, double sigma_floor,
            std::vector<Observation>& found) {
  found.clear();
  const std::int64_t end = tracks.offsets[static_cast<std::size_t>(track) + 1];
  for (std::int64_t i = tracks.offsets[static_cast<std::size_t>(track)]; i < end; ++i) {
    const auto row = static_cast<std::size_t>(i);
    const double x = tracks.rays[2 * row];
    const double y = tracks.rays[2 * row + 1];
    if (!std::isfinite(x) || !std::isfinite(y)) continue;
    const auto view = static_cast<std::size_t>(tracks.view[row]);
    const double sigma = tracks.sigma[row];
    found.push_back({i, &tracks.cam_from_world[12 * view], &tracks.focal[2 * view], x, y,
                     1.0 / (sigma_floor * sigma_floor + sigma * sigma)});
  }
}

}  // namespace

PointArrays triangulate(const PosedTracks& tracks, std::int64_t first, std::int64_t last,
                        const TriangulateOptions& options) {
  check(tracks, first, last);
  const double limit = options.max_reprojection_error * options.max_reprojection_error;
  const auto least = static_cast<std::size_t>(std::max(options.min_observations, 2));
  PointArrays points;
  std::vector<Observation> left;
  std::vector<Observation> kept;
  std::vector<Observation> dropped;
  for (std::int64_t track = first; track < last; ++track) {
    gather(tracks, track, options.sigma_floor, left);
    for (int attempt = 0; attempt < 2 && left.size() >= least; ++attempt) {
      points.num_tracks += attempt == 0;
      const Vector point = locate(left, limit);
      const double* focal = left.front().focal;
      kept.clear();
      dropped.clear();
      double error = 0;
      for (const Observation& seen : left) {
        const double error2 = projection_of(seen, point).error2;
        (error2 <= limit ? kept : dropped).push_back(seen);
        if (error2 <= limit) error += std::sqrt(error2);
      }
      if (kept.size() < least) break;
      points.num_agreeing += attempt == 0;
      error /= static_cast<double>(kept.size());
      if (is_sure(angle_of(kept, point), error, focal, options)) {
        points.xyz.insert(points.xyz.end(), point.begin(), point.end());
        points.error.push_back(error);
        points.count.push_back(static_cast<std::int64_t>(kept.size()));
        for (const Observation& seen : kept) points.observation.push_back(seen.index);
      }
      left.swap(dropped);
    }
  }
  return points;
}

}  // namespace colmap_av1::geometry

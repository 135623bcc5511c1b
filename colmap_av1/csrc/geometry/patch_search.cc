#include "geometry/patch_search.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <optional>
#include <stdexcept>

namespace colmap_av1::geometry {
namespace {

// Side in pixels of the compared windows.
constexpr int kWindow = 11;
// Largest number of steps, the length in pixels below which a step is the last one, and the largest
// length in pixels of the last step. A search that ends with a longer step has not converged.
constexpr int kMostSteps = 10;
constexpr float kLastStep = 0.005F;
constexpr float kAtRest = 0.03F;
// Smallest mean squared gradient along any direction, in squared grey levels per squared pixel.
constexpr float kLeastChange = 0.1F;
// Number of pixels by which the border of a picture is replicated.
constexpr std::int64_t kMargin = 16;

template <std::size_t kCount>
float sum_of(const std::array<float, kCount>& values) {
  float sum = 0;
  for (const float value : values) {
    sum += value;
  }
  return sum;
}

struct Step {
  float x = 0;
  float y = 0;
};

// The pixels of a window and their gradients. Lanes beyond the side are 0 and ignored.
template <int kSide>
class Window {
 public:
  // Sets the window from its pixels and a border of one pixel; false if it contains no corner.
  bool set(const Block<kSide + 2>& around) {
    for (int r = 0; r < kSide; ++r) {
      const auto& above = around[r];
      const auto& own = around[r + 1];
      const auto& below = around[r + 2];
      for (int i = 0; i < kLanes; ++i) {
        grey_[r][i] = own[i + 1];
        // Scharr's derivatives.
        along_x_[r][i] =
            (3 * (above[i + 2] - above[i] + below[i + 2] - below[i]) + 10 * (own[i + 2] - own[i])) *
            (1.0F / 32);
        along_y_[r][i] = (3 * (below[i] - above[i] + below[i + 2] - above[i + 2]) +
                          10 * (below[i + 1] - above[i + 1])) *
                         (1.0F / 32);
      }
    }
    for (Block<kSide>* values : {&grey_, &along_x_, &along_y_}) {
      clear_beyond_side(*values);
    }
    const float xx = product(along_x_, along_x_);
    const float xy = product(along_x_, along_y_);
    const float yy = product(along_y_, along_y_);
    const float least = (xx + yy - std::sqrt((xx - yy) * (xx - yy) + 4 * xy * xy)) / 2;
    if (!(least >= kLeastChange * kSamples)) {
      return false;
    }
    const float determinant = xx * yy - xy * xy;
    inverse_ = {yy / determinant, -xy / determinant, xx / determinant};
    return true;
  }

  // The offset of the content of a block from that of this window.
  Step step_to(const Block<kSide>& block) const {
    Row sums_x{};
    Row sums_y{};
    for (int r = 0; r < kSide; ++r) {
      for (int i = 0; i < kLanes; ++i) {
        const float error = block[r][i] - grey_[r][i];
        sums_x[i] += along_x_[r][i] * error;
        sums_y[i] += along_y_[r][i] * error;
      }
    }
    const float x = sum_of(sums_x);
    const float y = sum_of(sums_y);
    return {inverse_[0] * x + inverse_[1] * y, inverse_[1] * x + inverse_[2] * y};
  }

  const Block<kSide>& grey() const { return grey_; }

  // Normalised cross-correlation of two windows.
  float correlation(const Window& other) const {
    const Block<kSide> one = without_mean(grey_);
    const Block<kSide> two = without_mean(other.grey_);
    const float squares = product(one, one) * product(two, two);
    return product(one, two) / std::max(std::sqrt(squares), 1e-6F);
  }

 private:
  static constexpr int kLanes = lanes_of(kSide);
  static constexpr float kSamples = kSide * kSide;
  using Row = std::array<float, kLanes>;

  static void clear_beyond_side(Block<kSide>& block) {
    for (Row& row : block) {
      std::fill(row.begin() + kSide, row.end(), 0.0F);
    }
  }

  static Block<kSide> without_mean(Block<kSide> block) {
    Row sums{};
    for (const Row& row : block) {
      for (int i = 0; i < kLanes; ++i) {
        sums[i] += row[i];
      }
    }
    const float mean = sum_of(sums) / kSamples;
    for (Row& row : block) {
      for (float& value : row) {
        value -= mean;
      }
    }
    clear_beyond_side(block);
    return block;
  }

  static float product(const Block<kSide>& one, const Block<kSide>& two) {
    Row sums{};
    for (int r = 0; r < kSide; ++r) {
      for (int i = 0; i < kLanes; ++i) {
        sums[i] += one[r][i] * two[r][i];
      }
    }
    return sum_of(sums);
  }

  Block<kSide> grey_{};
  Block<kSide> along_x_{};
  Block<kSide> along_y_{};
  std::array<float, 3> inverse_{};
};

struct Place {
  float x = 0;
  float y = 0;
};

// Searches for the position of a window in a picture, from a start position.
std::optional<Place> find(const Window<kWindow>& window, const FloatPicture& target, float max_move,
                          Place start) {
  auto [x, y] = start;
  Block<kWindow> block;
  float moved = 0;
  for (int i = 0; i < kMostSteps; ++i) {
    if (!target.sample<kWindow>(x, y, block)) {
      return std::nullopt;
    }
    const Step step = window.step_to(block);
    x -= step.x;
    y -= step.y;
    if (!(std::abs(x - start.x) <= max_move && std::abs(y - start.y) <= max_move)) {
      return std::nullopt;
    }
    moved = std::max(std::abs(step.x), std::abs(step.y));
    if (moved < kLastStep) {
      break;
    }
  }
  if (!(moved <= kAtRest)) {
    return std::nullopt;
  }
  return Place{x, y};
}

// Samples the block of pixels around the point of a deformed patch; false if the patch is too
// small.
bool sample_patch(const CutPatches& patches, std::size_t i, Block<kWindow + 2>& block) {
  constexpr int kSide = kWindow + 2;
  const auto last = static_cast<float>(patches.side - 1);
  const std::uint8_t* pixels =
      patches.pixels.data() + patches.index[i] * patches.side * patches.side;
  const std::span<const float, 4> change(patches.change.data() + 4 * i, 4);
  for (int r = 0; r < kSide; ++r) {
    const auto down = static_cast<float>(r - kSide / 2);
    for (int c = 0; c < kSide; ++c) {
      const auto right = static_cast<float>(c - kSide / 2);
      const float x = last / 2 + patches.middle[2 * i] + change[0] * right + change[1] * down;
      const float y = last / 2 + patches.middle[2 * i + 1] + change[2] * right + change[3] * down;
      if (!(x >= 0 && y >= 0 && x < last && y < last)) {
        return false;
      }
      const auto column = static_cast<std::int64_t>(x);
      const auto row = static_cast<std::int64_t>(y);
      const float right_share = x - static_cast<float>(column);
      const float lower_share = y - static_cast<float>(row);
      const std::uint8_t* at = pixels + row * patches.side + column;
      const auto between = [right_share](const std::uint8_t* p) {
        return static_cast<float>(p[0]) + right_share * static_cast<float>(p[1] - p[0]);
      };
      const float upper = between(at);
      block[r][c] = upper + lower_share * (between(at + patches.side) - upper);
    }
  }
  return true;
}

}  // namespace

FoundPatches find_patches(const CutPatches& patches, const GreyPicture& target,
                          std::span<const float> start, float max_move) {
  const std::size_t count = patches.index.size();
  const auto size = static_cast<std::size_t>(patches.side * patches.side);
  if (patches.side < 1 || patches.side % 2 == 0 || patches.pixels.size() % size != 0 ||
      patches.middle.size() != 2 * count || patches.change.size() != 4 * count ||
      start.size() != 2 * count) {
    throw std::invalid_argument("patches and positions do not fit each other");
  }
  if (target.width <= 0 || target.height <= 0) {
    throw std::invalid_argument("the picture's size is 0");
  }
  const auto num_patches = static_cast<std::int64_t>(patches.pixels.size() / size);
  const FloatPicture picture(target, kMargin);
  FoundPatches found{
      .xy = {start.begin(), start.end()},
      .forward_backward_error = std::vector<float>(count, std::numeric_limits<float>::infinity()),
      .correlation = std::vector<float>(count, -1.0F)};
  Block<kWindow + 2> around;
  Window<kWindow> sought;
  Window<kWindow> shown;
  for (std::size_t i = 0; i < count; ++i) {
    if (patches.index[i] < 0 || patches.index[i] >= num_patches) {
      throw std::invalid_argument("there is no patch of an index");
    }
    if (!sample_patch(patches, i, around) || !sought.set(around)) {
      continue;
    }
    const auto place = find(sought, picture, max_move, {start[2 * i], start[2 * i + 1]});
    if (!place || !picture.sample<kWindow + 2>(place->x, place->y, around) || !shown.set(around)) {
      continue;
    }
    found.xy[2 * i] = place->x;
    found.xy[2 * i + 1] = place->y;
    // One step of the backward search returns to the start if both windows have the same content.
    const Step back = shown.step_to(sought.grey());
    found.forward_backward_error[i] = std::max(std::abs(back.x), std::abs(back.y));
    found.correlation[i] = sought.correlation(shown);
  }
  return found;
}

}  // namespace colmap_av1::geometry

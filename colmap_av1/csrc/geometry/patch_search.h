// Search of patches from some pictures in another picture by Lucas-Kanade.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "geometry/grey_picture.h"

namespace colmap_av1::geometry {

// The patches to search: squares cut out of pictures, and how another picture deforms them.
struct CutPatches {
  std::span<const std::uint8_t> pixels;  // [num_patches][side][side]
  std::int64_t side = 0;                 // odd
  std::span<const std::int64_t> index;   // [n] which patch to search
  std::span<const float> middle;  // [n][2] offset in pixels of its point from the patch's centre
  std::span<const float>
      change;  // [n][2][2] affine map from pixels of the other picture to those of the patch
};

// The positions of patches.
struct FoundPatches {
  std::vector<float> xy;                      // [n][2]
  std::vector<float> forward_backward_error;  // [n] in pixels; inf: not found
  std::vector<float> correlation;             // [n] normalised cross-correlation of both windows
};

// Searches for 11x11 pixels around the points of patches near the positions `start` [n][2], (x, y)
// in pixels; the centre of the first pixel is (0.5, 0.5). Inverse compositional steps are used
// (Baker and Matthews, "Lucas-Kanade 20 Years On", 2004), and the border of the picture is
// replicated. A patch is not found if it has no corner, moves by more than `max_move` pixels
// along x or y, or does not converge. Throws std::invalid_argument for inconsistent arrays.
FoundPatches find_patches(const CutPatches& patches, const GreyPicture& target,
                          std::span<const float> start, float max_move);

}  // namespace colmap_av1::geometry

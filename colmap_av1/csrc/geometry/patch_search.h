// Patches cut out of pictures, found in another picture by Lucas-Kanade.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "geometry/grey_picture.h"

namespace colmap_av1::geometry {

// What is to be found: squares cut out of pictures, and how another picture shows them.
struct CutPatches {
  std::span<const std::uint8_t> pixels;  // [num_patches][side][side]
  std::int64_t side = 0;                 // odd
  std::span<const std::int64_t> index;   // [n] which patch is sought
  std::span<const float> middle;  // [n][2] pixels by which its point lies off the patch's middle
  std::span<const float>
      change;  // [n][2][2] pixels (x, y) of the patch to one along x, and along y
};

// Where patches are found.
struct FoundPatches {
  std::vector<float> xy;        // [n][2]
  std::vector<float> missed;    // [n] pixels by which the way back misses; inf: not found
  std::vector<float> likeness;  // [n] normalised cross-correlation of what both show
};

// Looks for 11x11 pixels around the points of patches near the positions `start` [n][2], (x, y) in
// pixels, the centre of the first one at (0.5, 0.5), by inverse compositional steps (Baker and
// Matthews, "Lucas-Kanade 20 Years On", 2004); the picture goes on beyond its edges as it ends. Not
// found is what has no corner, what moves by more than `max_move` pixels along x or y, and what
// does not come to rest. Throws std::invalid_argument for arrays that do not fit.
FoundPatches find_patches(const CutPatches& patches, const GreyPicture& target,
                          std::span<const float> start, float max_move);

}  // namespace colmap_av1::geometry

// Correlation of square patches in two pictures.
#pragma once

#include <span>
#include <vector>

#include "geometry/grey_picture.h"

namespace colmap_av1::geometry {

// Side of a patch in pixels.
inline constexpr int kPatch = 8;

// Zero-mean normalised cross-correlations of the patch around each of n positions in one picture
// with those around d positions in another: [n][d], from -1 to 1. Positions are (x, y) in pixels;
// the centre of the first pixel is (0.5, 0.5). Patches are sampled bilinearly. -1 if a patch does
// not lie within its picture, or its standard deviation is less than `min_deviation` grey levels.
// Throws std::invalid_argument for inconsistent arrays.
std::vector<float> correlate_patches(const GreyPicture& one, std::span<const float> at_one,
                                     const GreyPicture& two, std::span<const float> at_two,
                                     float min_deviation);

}  // namespace colmap_av1::geometry

// Interpolates motion between blocks: within a block, and in blocks without trusted motion.
#pragma once

#include <vector>

#include "tracks/trusted_motion.h"

namespace colmap_av1::tracks {

// A block has a single vector, but real motion varies smoothly. Therefore the vector of every unit
// is interpolated between the centres of its block and of neighbouring blocks, across and down, if
// their displacements differ by less than `limit` coded pixels. A warp already describes how the
// motion varies within its block. At the border of a warped block, the displacement of its nearest
// unit is used, at the position of that unit. `unfilled` is working memory that the caller reuses.
void interpolate_blocks(float limit, std::vector<UnitMotion>& unfilled, TrustedMotion& motion);

// Units of a block without trusted motion, such as an intra block, get the motion interpolated
// between the units on both sides of the block, across and down, if these move similarly.
void bridge_blocks(float limit, std::vector<UnitMotion>& unfilled, TrustedMotion& motion);

}  // namespace colmap_av1::tracks

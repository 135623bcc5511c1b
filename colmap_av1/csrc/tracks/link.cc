#include "tracks/link.h"

#include <algorithm>
#include <cstdlib>
#include <limits>

namespace colmap_av1::tracks {
namespace {

// With the displacements of the other frame if `forward`, otherwise with those of the current
// frame.
Link make_link(const TrustedMotion& current, ChainedFrame& other_frame, bool forward,
               const CellGrid& grid) {
  const TrustedMotion& other = other_frame.motion;
  const TrustedMotion& from = forward ? other : current;
  const TrustedMotion& to = forward ? current : other;
  Link link;
  link.other = &other_frame;
  link.forward = forward;
  for (int ref = 1; ref < kNumRefs; ++ref) {
    link.refs[ref] = from.ref_decode_index[ref] == to.decode_index;
  }
  if (other.display_index >= 0 && current.display_index >= 0) {
    link.interval = other.display_index - current.display_index;
  }
  link.distance = link.interval != 0 ? std::abs(link.interval) : std::numeric_limits<int>::max();
  link.from_picture_x = current.coded_width / other.width;
  link.from_picture_y = current.height / other.height;
  const float cell = 2.F * grid.half_cell;
  link.to_cells_x = 1.F / (cell * other.upscale * link.from_picture_x);
  link.to_cells_y = 1.F / (cell * link.from_picture_y);
  link.picture_x = current.width / other.width;
  link.picture_y = current.height / other.height;
  if (link.interval != 0) {
    // A backward displacement spans the interval, a forward one its negative.
    const double interval = forward ? -link.interval : link.interval;
    link.to_velocity_x = current.width / from.coded_width / interval;
    link.to_velocity_y = current.height / from.height / interval;
  }
  return link;
}

}  // namespace

bool leads_to(const TrustedMotion& from, const TrustedMotion& to,
              const TrackBuilderOptions& options) {
  for (int ref = 1; ref < kNumRefs; ++ref) {
    if (from.ref_decode_index[ref] == to.decode_index) {
      return options.is_within_reach(from.ref_interval[ref]);
    }
  }
  return false;
}

std::vector<Link> find_links(const ChainedFrame& current,
                             std::span<const std::unique_ptr<ChainedFrame>> frames,
                             const CellGrid& grid, const TrackBuilderOptions& options) {
  std::vector<Link> links;
  for (const auto& other : frames) {
    if (!other->is_chained() || other.get() == &current) continue;
    if (leads_to(current.motion, other->motion, options)) {
      links.push_back(make_link(current.motion, *other, false, grid));
    }
    if (leads_to(other->motion, current.motion, options)) {
      links.push_back(make_link(current.motion, *other, true, grid));
    }
  }
  std::stable_sort(links.begin(), links.end(),
                   [](const Link& a, const Link& b) { return a.distance < b.distance; });
  return links;
}

}  // namespace colmap_av1::tracks

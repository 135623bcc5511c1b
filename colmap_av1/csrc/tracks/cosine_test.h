// The test that ends a track when its motion changes abruptly.
#pragma once

#include <optional>
#include <vector>

#include "tracks/chained_frame.h"
#include "tracks/dominant_motion.h"
#include "tracks/geometry.h"
#include "tracks/link.h"
#include "tracks/track_builder_options.h"

namespace colmap_av1::tracks {

// Space-time cosine (the angular error of Barron, Fleet and Beauchemin, IJCV 1994) between the
// motion of a step and the motion predicted from the previous step, which is the same motion
// relative to the dominant motion.
class CosineTest {
 public:
  explicit CosineTest(const TrackBuilderOptions& options);

  bool is_on() const { return least_.has_value(); }

  // Sets the velocities of a frame's cells to that of seeds.
  void start_frame(ChainedFrame& frame) const;
  // Sets the dominant motion of a link.
  void prepare(const ChainedFrame& current, Link& link);
  // Tests the step of a track from `from` to `moved`, in coded pixels of the frame that has the
  // displacement; `other_cell` is in the link's other frame. Returns the track's relative velocity
  // after the step, in pixels of the current picture; nothing if the test fails. If the test is
  // off, any velocity is returned.
  std::optional<Point> passed(const Link& link, int other_cell, Point from, Point moved) const;

 private:
  std::optional<double> least_;
  bool relative_to_dominant_;
  double scale2_;
  // Buffers that are reused for every frame.
  std::vector<MotionSample> samples_;
  std::vector<float> scratch_;
};

}  // namespace colmap_av1::tracks

// The test that ends a track where its motion changes abruptly.
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
// motion of a step and the one predicted from the step before: the same motion relative to the
// dominant one.
class CosineTest {
 public:
  explicit CosineTest(const TrackBuilderOptions& options);

  bool is_on() const { return least_.has_value(); }

  // Gives a frame's cells the velocity of seeds.
  void start_frame(ChainedFrame& frame) const;
  // Sets the link's dominant motion.
  void prepare(const ChainedFrame& current, Link& link);
  // Whether the track in a cell of the link's other frame may take the step `from` to `moved`, in
  // coded pixels of the frame whose displacement it is: the track's relative velocity after the
  // step, in pixels of the current picture, or nothing. Any velocity where the test is off.
  std::optional<Point> passed(const Link& link, int other_cell, Point from, Point moved) const;

 private:
  std::optional<double> least_;
  bool relative_to_dominant_;
  double scale2_;
  // Buffers that are kept from frame to frame.
  std::vector<MotionSample> samples_;
  std::vector<float> scratch_;
};

}  // namespace colmap_av1::tracks

// The trusted motion of a coded frame, unit by unit.
#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <span>
#include <vector>

#include "tracks/displacement.h"
#include "tracks/frame_motion.h"
#include "tracks/geometry.h"
#include "tracks/track_builder_options.h"

namespace colmap_av1::tracks {

// The motion of a unit in one of its lists; ref 0 if there is none that is trusted.
struct UnitMotion {
  float dx = 0.F;  // at the unit's centre, in coded pixels
  float dy = 0.F;
  std::int32_t warp = -1;  // index in TrustedMotion::warps; -1 for a translation
  float variance = 0.F;    // expected variance of the displacement, in coded px^2
  std::int8_t ref = 0;
};

struct TrustedMotion {
  int decode_index = -1;
  int display_index = -1;
  int rows = 0;
  int cols = 0;
  int visible_rows = 0;
  int visible_cols = 0;
  float width = 0.F;
  float height = 0.F;
  float coded_width = 0.F;
  float upscale = 1.F;  // picture pixels per coded pixel, above 1 with super-resolution
  std::array<int, kNumRefs> ref_decode_index{};
  std::array<int, kNumRefs> ref_interval{};      // in shown frames; 0 if unknown
  std::array<std::vector<UnitMotion>, 2> lists;  // the second stays unused without compounds
  int num_lists = 0;
  std::array<int, kNumRefs> num_linked{};  // number of entries of the lists, by ref
  std::vector<av1::WarpParams> warps;
  std::vector<std::uint8_t> mi_size;
  bool has_detail = false;  // whether the picture shows any detail

  std::span<std::vector<UnitMotion>> used_lists() { return std::span(lists).first(num_lists); }
  std::span<const std::vector<UnitMotion>> used_lists() const {
    return std::span(lists).first(num_lists);
  }
  bool moves(int unit) const {
    return lists[0][unit].ref != 0 || (num_lists > 1 && lists[1][unit].ref != 0);
  }
  bool is_visible(int row, int col) const {
    return row >= 0 && row < visible_rows && col >= 0 && col < visible_cols;
  }
  // Whether a position in coded pixels lies in the picture.
  bool contains(Point position) const {
    return position.x >= 0.F && position.y >= 0.F && position.x < coded_width &&
           position.y < height;
  }
  Point unit_centre(int unit) const {
    return {kUnit * (static_cast<float>(unit % cols) + 0.5F),
            kUnit * (static_cast<float>(unit / cols) + 0.5F)};
  }
  int block_area(int unit) const;  // of the block that contains a unit, in px^2
};

// Working memory of read_trusted_motion, which the caller reuses for every frame.
struct TrustScratch {
  // How much to trust the motion of a block.
  struct Verdict {
    float variance = 0.F;
    bool rough = false;
  };
  std::array<std::vector<Verdict>, 2> verdicts;
  std::vector<UnitMotion> unfilled;
};

// Whether the frame behind each RefFrame shows any detail; false for those without a frame.
using RefDetail = std::array<bool, kNumRefs>;

// Copies the motion of a coded frame that is trusted by the rules of `options`. Overwrites
// `motion`, whose memory is reused. The frame must have passed check_frame_motion.
void read_trusted_motion(const FrameMotion& frame, const TrackBuilderOptions& options,
                         const RefDetail& ref_has_detail, TrustScratch& scratch,
                         TrustedMotion& motion);

inline bool moves_alike(const UnitMotion& a, const UnitMotion& b, float limit) {
  return distance({a.dx, a.dy}, {b.dx, b.dy}) < limit;
}

// The position to which a unit's motion moves a position, in coded pixels.
inline Point move(const TrustedMotion& frame, const UnitMotion& motion, Point position) {
  if (motion.warp < 0) return {position.x + motion.dx, position.y + motion.dy};
  const Position moved = apply_warp(frame.warps[motion.warp], {position.x, position.y});
  return {static_cast<float>(moved.x), static_cast<float>(moved.y)};
}

// The position that `move` moves to `target`; nothing if the warp has no inverse.
inline std::optional<Point> move_back(const TrustedMotion& frame, const UnitMotion& motion,
                                      Point target) {
  if (motion.warp < 0) return Point{target.x - motion.dx, target.y - motion.dy};
  const auto source = invert_warp(frame.warps[motion.warp], {target.x, target.y});
  if (!source) return std::nullopt;
  return Point{static_cast<float>(source->x), static_cast<float>(source->y)};
}

}  // namespace colmap_av1::tracks

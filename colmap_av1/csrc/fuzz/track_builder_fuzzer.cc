// Any bytes as the motion of a video: parsed from temporal units, as `read_motion` would hand it
// over, or block data made up from the bytes, as a caller of the Python module could.

#include <array>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <map>
#include <memory>
#include <stdexcept>
#include <utility>
#include <vector>

#include "av1/error.h"
#include "av1/parser.h"
#include "fuzz/input.h"
#include "tracks/displacement.h"
#include "tracks/track_builder.h"

namespace {

using colmap_av1::av1::BitstreamError;
using colmap_av1::av1::Event;
using colmap_av1::av1::LimitError;
using colmap_av1::av1::Parser;
using colmap_av1::av1::ParserOptions;
using colmap_av1::fuzz::check;
using colmap_av1::fuzz::Input;
using colmap_av1::tracks::FrameMotion;
using colmap_av1::tracks::TrackArrays;
using colmap_av1::tracks::TrackBuilder;
using colmap_av1::tracks::TrackBuilderOptions;

// They bound the time of one input.
constexpr std::int64_t kMaxFrameSize = 256 * 256;
constexpr std::size_t kMaxFrames = 24;

// Fields of a frame, owned.
struct Frame {
  FrameMotion motion;
  std::vector<std::int8_t> ref_frame;
  std::vector<std::int16_t> mv;
  std::vector<std::uint8_t> mi_size, y_mode, is_inter, use_intrabc, motion_mode, interintra, skip;
  std::vector<std::int32_t> warp_index, warps;
  std::array<std::int32_t, 7> gm_type{};
  std::array<std::int32_t, 42> gm_params{};
  std::array<std::int32_t, 16> ref_size{};
  std::array<std::int32_t, 8> ref_decode_index{}, ref_display_index{}, slot_decode_index{};

  const FrameMotion& view() {
    motion.ref_frame = ref_frame.data();
    motion.mv = mv.data();
    motion.mi_size = mi_size.data();
    motion.y_mode = y_mode.data();
    motion.is_inter = is_inter.data();
    motion.use_intrabc = use_intrabc.data();
    motion.motion_mode = motion_mode.data();
    motion.interintra = interintra.data();
    motion.warp_index = warp_index.data();
    motion.local_warp_params = warps.data();
    motion.num_local_warps = static_cast<int>(warps.size() / 6);
    motion.gm_type = gm_type.data();
    motion.gm_params = gm_params.data();
    motion.ref_size = ref_size.data();
    motion.skip = skip.data();
    motion.ref_decode_index = ref_decode_index.data();
    motion.ref_display_index = ref_display_index.data();
    motion.slot_decode_index = slot_decode_index.data();
    return motion;
  }
};

TrackBuilderOptions read_options(Input& input) {
  const unsigned choice = input.byte();
  TrackBuilderOptions options;
  options.min_length = 1 + static_cast<int>(choice & 3);
  if ((choice & 4) != 0) options.cosine = 0.3;
  options.cosine_relative_to_dominant = (choice & 8) != 0;
  options.cosine_scale = (choice & 8) != 0 ? 1 : 0;
  if ((choice & 16) != 0) options.max_interval = 4;
  if ((choice & 32) != 0) options.max_block_area = 1024;
  if ((choice & 32) != 0) options.max_uncoded_block_area = 256;
  if ((choice & 64) != 0) options.smoothness = 2.5;
  if ((choice & 128) != 0) options.border = 16;
  if ((choice & 2) != 0) options.interpolation = 2;
  if ((choice & 1) != 0) options.bridge = 2;
  options.cells = 1 << (((choice >> 3) & 1) + ((choice >> 5) & 1));
  if ((choice & 64) != 0) options.seeding = (choice & 128) != 0 ? 2 * options.cells : options.cells;
  return options;
}

// Displacements and tracks of a frame. False where it contradicts itself.
bool add(TrackBuilder& builder, const FrameMotion& frame) {
  try {
    colmap_av1::tracks::check_frame_motion(frame);
    std::vector<float> out(2 * static_cast<std::size_t>(frame.num_units()));
    for (int list = 0; list < 2; ++list) {
      colmap_av1::tracks::displacement(frame, list, out.data());
    }
    builder.add(frame);
  } catch (const std::invalid_argument&) {
    return false;
  }
  return true;
}

void check_tracks(const TrackArrays& tracks, const TrackBuilderOptions& options) {
  check(!tracks.offsets.empty() && tracks.offsets.front() == 0, "offsets start at 0");
  check(tracks.offsets.back() == static_cast<std::int64_t>(tracks.frame.size()) &&
            tracks.xy.size() == 2 * tracks.frame.size() &&
            tracks.sigma.size() == tracks.frame.size(),
        "offsets end at the observations");
  for (std::size_t t = 0; t + 1 < tracks.offsets.size(); ++t) {
    const std::int64_t first = tracks.offsets[t];
    const std::int64_t last = tracks.offsets[t + 1];
    check(last - first >= options.min_length, "tracks are long enough");
    for (std::int64_t o = first; o < last; ++o) {
      const auto i = static_cast<std::size_t>(o);
      check(tracks.frame[i] >= 0 && tracks.frame[i] < tracks.num_frames, "frames are shown ones");
      check(tracks.sigma[i] >= 0.F, "the expected error is a number");
      check(o == first || tracks.frame[i - 1] < tracks.frame[i], "a frame sees a track once");
      const float x = tracks.xy[2 * i];
      const float y = tracks.xy[2 * i + 1];
      check(x >= 0.F && y >= 0.F && x <= static_cast<float>(tracks.width) &&
                y <= static_cast<float>(tracks.height),
            "observations lie in the picture");
    }
  }
}

std::vector<std::unique_ptr<Event>> parse(Input& input, bool headers_only, std::size_t max_events) {
  ParserOptions options;
  options.headers_only = headers_only;
  options.max_frame_size = kMaxFrameSize;
  Parser parser(options);
  try {
    while (!input.empty() && parser.events().size() < max_events) {
      const auto unit = input.unit();
      parser.parse(unit.data(), unit.size());
    }
  } catch (const BitstreamError&) {
  } catch (const LimitError&) {
  }
  return std::move(parser.events());
}

// What `read_motion` makes of the events (motion/reading.py)
void run_parsed(Input input, TrackBuilder& builder) {
  std::vector<int> shown;
  int last_unit = -1;
  Input again = input;
  for (const auto& event : parse(again, true, kMaxFrames)) {
    if (!event->header.show_frame && !event->header.show_existing_frame) continue;
    if (event->temporal_unit == last_unit && !shown.empty()) shown.pop_back();
    last_unit = event->temporal_unit;
    shown.push_back(event->header.show_existing_frame ? event->shown_decode_index
                                                      : event->decode_index);
  }
  std::map<int, int> display_index;
  for (std::size_t i = 0; i < shown.size(); ++i) {
    display_index.try_emplace(shown[i], static_cast<int>(i));
  }
  const auto displayed = [&](int decoded) {
    const auto found = display_index.find(decoded);
    return found == display_index.end() ? -1 : found->second;
  };
  for (const auto& event : parse(input, false, kMaxFrames)) {
    const auto& header = event->header;
    if (header.show_existing_frame) continue;
    Frame frame;
    auto& units = event->units;
    frame.motion.mi_rows = header.mi_rows;
    frame.motion.mi_cols = header.mi_cols;
    frame.motion.frame_width = header.frame_width;
    frame.motion.force_integer_mv = header.force_integer_mv;
    frame.motion.decode_index = event->decode_index;
    frame.motion.display_index = displayed(event->decode_index);
    frame.motion.show_frame = header.show_frame;
    frame.motion.width = header.upscaled_width;
    frame.motion.height = header.frame_height;
    const auto copy = [](auto& to, const auto& from) { to.assign(from.begin(), from.end()); };
    for (const auto& refs : units.ref_frame) {
      frame.ref_frame.insert(frame.ref_frame.end(), refs.begin(), refs.end());
    }
    for (const auto& mvs : units.mv) {
      for (const auto& mv : mvs) {
        frame.mv.push_back(mv.row);
        frame.mv.push_back(mv.col);
      }
    }
    copy(frame.mi_size, units.mi_size);
    copy(frame.y_mode, units.y_mode);
    copy(frame.is_inter, units.is_inter);
    copy(frame.use_intrabc, units.use_intrabc);
    copy(frame.motion_mode, units.motion_mode);
    copy(frame.interintra, units.interintra);
    copy(frame.skip, units.skip);
    copy(frame.warp_index, units.warp_index);
    for (const auto& warp : event->local_warps) {
      frame.warps.insert(frame.warps.end(), warp.params.begin(), warp.params.end());
    }
    for (std::size_t ref = 0; ref < 8; ++ref) {
      if (ref > 0) {
        frame.gm_type[ref - 1] = header.gm_type[ref];
        for (std::size_t i = 0; i < 6; ++i) {
          frame.gm_params[6 * (ref - 1) + i] = header.gm_params[ref][i];
        }
      }
      frame.ref_size[2 * ref] = event->ref_size[ref][0];
      frame.ref_size[2 * ref + 1] = event->ref_size[ref][1];
      frame.ref_decode_index[ref] = event->ref_decode_index[ref];
      frame.ref_display_index[ref] = displayed(event->ref_decode_index[ref]);
      frame.slot_decode_index[ref] = event->slot_decode_index[ref];
    }
    if (!add(builder, frame.view())) return;
  }
}

// A number as a caller could get it wrong: the edges are where sums overflow.
std::int32_t wrong_number(Input& input) {
  const unsigned choice = input.byte();
  switch (choice & 7) {
    case 0:
      return std::numeric_limits<std::int32_t>::max() - static_cast<std::int32_t>(choice >> 6);
    case 1:
      return std::numeric_limits<std::int32_t>::min() + static_cast<std::int32_t>(choice >> 6);
    case 2: return input.number<std::int32_t>();
    default: return static_cast<std::int32_t>(choice >> 3) - 1;
  }
}

// Block data that no parser has looked at
void run_made_up(Input input, TrackBuilder& builder) {
  int num_shown = 0;
  for (std::size_t count = 0; !input.empty() && count < kMaxFrames; ++count) {
    Frame frame;
    const unsigned choice = input.byte();
    const int number = static_cast<int>(count);
    auto& motion = frame.motion;
    motion.mi_rows = input.byte() % 17;
    motion.mi_cols = input.byte() % 17;
    const bool wild = (choice & 1) != 0;  // frame-wide numbers that no stream holds
    const bool wild_units = (choice & 0x82) == 0x82;
    motion.frame_width = wild ? wrong_number(input) : 4 * motion.mi_cols;
    motion.height = wild ? wrong_number(input) : 4 * motion.mi_rows;
    motion.width = wild ? wrong_number(input) : motion.frame_width;
    motion.force_integer_mv = (choice & 2) != 0;
    motion.show_frame = (choice & 4) == 0;
    motion.decode_index = wild ? wrong_number(input) : number;
    const bool hidden = (choice & 8) != 0;
    motion.display_index = wild ? wrong_number(input) : hidden ? -1 : num_shown++;
    const auto n = static_cast<std::size_t>(motion.num_units());
    const unsigned num_warps = input.byte() % 4;
    for (std::size_t i = 0; i < 6 * num_warps; ++i) {
      frame.warps.push_back(input.number<std::int32_t>() >> (choice >> 4 & 15));
    }
    const unsigned spread = input.byte();  // neighbours alike, as in real block data
    for (std::size_t i = 0; i < n; ++i) {
      const bool same = i > 0 && i % (1 + spread) != 0;
      const auto copy_or = [&](auto& values, auto value) {
        values.push_back(same ? values.back() : value());
      };
      const auto bounded = [&](unsigned bound) {
        return [&input, wild_units, bound] {
          const std::uint8_t value = input.byte();
          return static_cast<std::uint8_t>(wild_units ? value : value % bound);
        };
      };
      copy_or(frame.mi_size, bounded(22));
      copy_or(frame.y_mode, bounded(25));
      copy_or(frame.motion_mode, bounded(3));
      const std::uint8_t flags = input.byte();
      frame.is_inter.push_back((flags & 1) == 0);
      frame.use_intrabc.push_back((flags & 6) == 6);
      frame.interintra.push_back((flags & 24) == 24);
      frame.skip.push_back((flags & 32) != 0);
      for (int list = 0; list < 2; ++list) {
        const int ref = bounded(9)() - (wild_units ? 0 : 1);
        frame.ref_frame.push_back(static_cast<std::int8_t>(ref));
        frame.mv.push_back(static_cast<std::int16_t>(input.number<std::int16_t>() >> (flags >> 6)));
        frame.mv.push_back(input.number<std::int16_t>());
      }
      frame.warp_index.push_back(wild_units ? wrong_number(input)
                                            : input.byte() % static_cast<int>(num_warps + 1) - 1);
    }
    for (std::size_t i = 0; i < 7; ++i) frame.gm_type[i] = input.byte() % 4;
    for (auto& value : frame.gm_params) value = input.number<std::int32_t>() >> (choice >> 4 & 15);
    for (auto& value : frame.ref_size) {
      value = wild ? wrong_number(input) : 4 * (input.byte() % 17);
    }
    for (std::size_t ref = 0; ref < 8; ++ref) {
      if (wild) {
        frame.ref_decode_index[ref] = wrong_number(input);
        frame.ref_display_index[ref] = wrong_number(input);
        frame.slot_decode_index[ref] = wrong_number(input);
      } else {
        frame.ref_decode_index[ref] = number - 1 - input.byte() % 4;
        frame.ref_display_index[ref] = num_shown - 2 - input.byte() % 4;
        frame.slot_decode_index[ref] = number - input.byte() % 4;
      }
    }
    add(builder, frame.view());
  }
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  Input input(data, size);
  const bool made_up = (input.byte() & 1) != 0;
  const TrackBuilderOptions options = read_options(input);
  TrackBuilder builder(options);
  if (made_up) {
    run_made_up(input, builder);
  } else {
    run_parsed(input, builder);
  }
  check_tracks(builder.finish(), options);
  return 0;
}

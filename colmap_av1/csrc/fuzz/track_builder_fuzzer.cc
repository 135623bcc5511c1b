// Passes arbitrary bytes as the motion of a video: either parsed from temporal units, like
// `read_motion` does, or as block data made from the bytes, as a caller of the Python module could.

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <map>
#include <memory>
#include <stdexcept>
#include <utility>
#include <vector>

#include "av1/parser.h"
#include "fuzz/input.h"
#include "fuzz/parse.h"
#include "tracks/displacement.h"
#include "tracks/track_builder.h"

namespace {

using colmap_av1::av1::BlockInfo;
using colmap_av1::av1::Event;
using colmap_av1::av1::Parser;
using colmap_av1::av1::ParserOptions;
using colmap_av1::av1::WarpParams;
using colmap_av1::fuzz::check;
using colmap_av1::fuzz::Input;
using colmap_av1::tracks::FrameMotion;
using colmap_av1::tracks::TrackArrays;
using colmap_av1::tracks::TrackBuilder;
using colmap_av1::tracks::TrackBuilderOptions;

// These limits bound the time of one input.
constexpr std::int64_t kMaxFrameSize = 256 * 256;
constexpr std::size_t kMaxFrames = 24;

// A frame with the data that it refers to.
struct Frame {
  FrameMotion motion;
  std::vector<BlockInfo> blocks;
  std::vector<std::int32_t> block_index;
  std::vector<WarpParams> warps;

  const FrameMotion& view() {
    motion.blocks = blocks;
    motion.block_index = block_index;
    motion.local_warp_params = warps;
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
  options.tracks_per_sample = 1;
  if ((choice & 9) == 9) options.stored_frames = {0, 2, 3, 7};
  return options;
}

// Computes displacements and tracks of a frame; false if its data are inconsistent.
bool add(TrackBuilder& builder, const FrameMotion& frame) {
  try {
    colmap_av1::tracks::check_frame_motion(frame);
    for (int list = 0; list < 2; ++list) colmap_av1::tracks::displacement(frame, list);
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
    check(last - first >= (options.stored_frames ? 2 : options.min_length),
          "tracks are long enough");
    for (std::int64_t o = first; o < last; ++o) {
      const auto i = static_cast<std::size_t>(o);
      check(tracks.frame[i] >= 0 && tracks.frame[i] < tracks.num_frames, "frames are shown ones");
      check(!options.stored_frames ||
                std::ranges::binary_search(*options.stored_frames, tracks.frame[i]),
            "observations are in the frames that were asked for");
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

// Where all frames are observed, the ends of all tracks are kept.
void check_ends(const TrackArrays& ends, const TrackArrays& tracks) {
  check(ends.offsets.size() == tracks.offsets.size(), "every track has ends");
  for (std::size_t t = 0; t + 1 < tracks.offsets.size(); ++t) {
    const auto frame_at = [](const TrackArrays& arrays, std::int64_t observation) {
      return arrays.frame[static_cast<std::size_t>(observation)];
    };
    check(
        frame_at(ends, ends.offsets[t]) == frame_at(tracks, tracks.offsets[t]) &&
            frame_at(ends, ends.offsets[t + 1] - 1) == frame_at(tracks, tracks.offsets[t + 1] - 1),
        "the ends are those of the track");
  }
}

std::vector<std::unique_ptr<Event>> parse(Input& input, bool headers_only, std::size_t max_events) {
  ParserOptions options;
  options.headers_only = headers_only;
  options.max_frame_size = kMaxFrameSize;
  Parser parser(options);
  std::vector<std::unique_ptr<Event>> events;
  const auto take = [&](std::unique_ptr<Event> event) { events.push_back(std::move(event)); };
  while (!input.empty() && events.size() < max_events) {
    if (!colmap_av1::fuzz::parse(parser, input.unit(), take)) break;
  }
  return events;
}

// Converts events to frames like `read_motion` (motion/reading.py)
void run_parsed(Input input, TrackBuilder& builder) {
  std::vector<int> shown;
  int last_unit = -1;
  Input again = input;
  for (const auto& event : parse(again, true, kMaxFrames)) {
    if (!event->header.is_shown()) continue;
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
    frame.motion.mi_rows = header.mi_rows;
    frame.motion.mi_cols = header.mi_cols;
    frame.motion.frame_width = header.frame_width;
    frame.motion.force_integer_mv = header.force_integer_mv;
    frame.motion.decode_index = event->decode_index;
    frame.motion.display_index = displayed(event->decode_index);
    frame.motion.show_frame = header.show_frame;
    frame.motion.width = header.upscaled_width;
    frame.motion.height = header.frame_height;
    frame.blocks = std::move(event->blocks);
    frame.block_index = std::move(event->block_index);
    for (const auto& warp : event->local_warps) frame.warps.push_back(warp.params);
    for (std::size_t ref = 0; ref < 8; ++ref) {
      frame.motion.gm_type[ref] = header.gm_type[ref];
      frame.motion.gm_params[ref] = header.gm_params[ref];
      frame.motion.ref_size[ref] = {event->ref_size[ref][0], event->ref_size[ref][1]};
      frame.motion.ref_decode_index[ref] = event->ref_decode_index[ref];
      frame.motion.ref_display_index[ref] = displayed(event->ref_decode_index[ref]);
      frame.motion.slot_decode_index[ref] = event->slot_decode_index[ref];
    }
    if (!add(builder, frame.view())) return;
  }
}

// A number that a caller could pass by mistake, including those at which sums overflow.
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

// Block data that no parser has checked
void run_made_up(Input input, TrackBuilder& builder) {
  int num_shown = 0;
  for (std::size_t count = 0; !input.empty() && count < kMaxFrames; ++count) {
    Frame frame;
    const unsigned choice = input.byte();
    const int number = static_cast<int>(count);
    auto& motion = frame.motion;
    motion.mi_rows = input.byte() % 17;
    motion.mi_cols = input.byte() % 17;
    const bool wild = (choice & 1) != 0;  // values of the frame that no stream can have
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
    const auto read_warp = [&] {
      WarpParams params;
      for (auto& value : params) value = input.number<std::int32_t>() >> (choice >> 4 & 15);
      return params;
    };
    for (unsigned i = 0; i < num_warps; ++i) frame.warps.push_back(read_warp());
    const unsigned spread = input.byte();  // neighbours in one block, as in real block data
    const auto bounded = [&](unsigned bound) {
      const std::uint8_t value = input.byte();
      return static_cast<std::uint8_t>(wild_units ? value : value % bound);
    };
    for (std::size_t i = 0; i < n; ++i) {
      if (i == 0 || i % (1 + spread) == 0) {
        BlockInfo block;
        block.mi_size = bounded(22);
        block.y_mode = bounded(25);
        block.motion_mode = bounded(3);
        const std::uint8_t flags = input.byte();
        block.is_inter = (flags & 1) == 0;
        block.use_intrabc = (flags & 6) == 6;
        block.interintra = (flags & 24) == 24;
        block.skip = (flags & 32) != 0;
        for (std::size_t list = 0; list < 2; ++list) {
          block.ref_frame[list] = static_cast<std::int8_t>(bounded(9) - (wild_units ? 0 : 1));
          block.mv[list].row =
              static_cast<std::int16_t>(input.number<std::int16_t>() >> (flags >> 6));
          block.mv[list].col = input.number<std::int16_t>();
        }
        block.warp_index =
            wild_units ? wrong_number(input) : input.byte() % static_cast<int>(num_warps + 1) - 1;
        frame.blocks.push_back(block);
      }
      const auto last = static_cast<std::int32_t>(frame.blocks.size()) - 1;
      const bool lost = wild_units && input.byte() == 255;
      frame.block_index.push_back(lost ? wrong_number(input) : last);
    }
    for (std::size_t ref = 0; ref < 8; ++ref) {
      motion.gm_type[ref] = input.byte() % 4;
      motion.gm_params[ref] = read_warp();
      for (auto& value : motion.ref_size[ref]) {
        value = wild ? wrong_number(input) : 4 * (input.byte() % 17);
      }
      if (wild) {
        motion.ref_decode_index[ref] = wrong_number(input);
        motion.ref_display_index[ref] = wrong_number(input);
        motion.slot_decode_index[ref] = wrong_number(input);
      } else {
        motion.ref_decode_index[ref] = number - 1 - input.byte() % 4;
        motion.ref_display_index[ref] = num_shown - 2 - input.byte() % 4;
        motion.slot_decode_index[ref] = number - input.byte() % 4;
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
  const TrackBuilder::Result result = builder.finish();
  check_tracks(result.tracks, options);
  if (!options.stored_frames) check_ends(result.ends, result.tracks);
  return 0;
}

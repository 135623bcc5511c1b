// Passes arbitrary bytes as an AV1 stream. In addition to the checks of the sanitizers, values of
// the events that callers use as array indices must be in range.

#include <cstddef>
#include <cstdint>
#include <memory>
#include <span>

#include "av1/error.h"
#include "av1/parser.h"
#include "fuzz/input.h"
#include "fuzz/parse.h"

namespace {

using colmap_av1::av1::BitstreamError;
using colmap_av1::av1::Event;
using colmap_av1::av1::Parser;
using colmap_av1::av1::ParserOptions;
using colmap_av1::fuzz::check;
using colmap_av1::fuzz::parse;

// A few bytes can require a large frame; these limits bound the time of one input.
constexpr std::int64_t kMaxFrameSize = 512 * 512;
constexpr std::size_t kMaxEvents = 32;

void check_event(const Event& event, const ParserOptions& options) {
  const auto& header = event.header;
  for (const int decoded : event.slot_decode_index) {
    check(decoded >= -1 && decoded <= event.decode_index, "slots hold decoded frames");
  }
  if (header.show_existing_frame) {
    check(event.shown_decode_index >= 0 && event.shown_decode_index < event.decode_index,
          "a shown frame was decoded before");
    return;
  }
  for (const int decoded : event.ref_decode_index) {
    check(decoded >= -1 && decoded < event.decode_index, "references were decoded before");
  }
  check(std::int64_t{header.upscaled_width} * header.frame_height <= kMaxFrameSize,
        "frames are within the limit");
  const std::size_t n = options.headers_only ? 0
                                             : static_cast<std::size_t>(header.mi_rows) *
                                                   static_cast<std::size_t>(header.mi_cols);
  check(event.block_index.size() == n, "every unit has a block");
  check(event.blocks.size() <= n, "every block has a unit");
  for (const std::int32_t index : event.block_index) {
    check(index >= 0 && static_cast<std::size_t>(index) < event.blocks.size(), "blocks are there");
  }
  const auto num_warps = static_cast<std::int64_t>(event.local_warps.size());
  for (const auto& block : event.blocks) {
    check(block.mi_size < colmap_av1::av1::BLOCK_SIZES, "mi_size is a block size");
    check(block.y_mode <= colmap_av1::av1::NEW_NEWMV, "y_mode is a mode");
    check(block.segment_id < colmap_av1::av1::MAX_SEGMENTS, "segment_id is a segment");
    for (const int ref : block.ref_frame) {
      check(ref >= -1 && ref <= colmap_av1::av1::ALTREF_FRAME, "ref_frame is a reference");
      check(ref <= 0 || event.ref_decode_index[static_cast<std::size_t>(ref)] >= 0,
            "blocks refer to frames that are there");
    }
    check(block.warp_index >= -1 && block.warp_index < num_warps, "warps are there");
    check(block.warp_index == -1 || block.warp_index == block.local_warp, "warps are the block's");
  }
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  colmap_av1::fuzz::Input input(data, size);
  const unsigned choice = input.byte();
  ParserOptions options;
  options.headers_only = (choice & 1) != 0;
  options.operating_point = static_cast<int>(choice >> 2 & 31);
  options.num_threads = (choice & 128) != 0 ? 2 : 1;
  options.max_frame_size = kMaxFrameSize;
  Parser parser(options);
  std::size_t num_events = 0;
  std::span<const std::uint8_t> first;
  const auto take = [&](std::unique_ptr<Event> event) {
    ++num_events;
    check_event(*event, options);
  };
  while (!input.empty() && num_events < kMaxEvents) {
    const auto unit = input.unit();
    if (first.empty()) first = unit;
    parse(parser, unit, take);  // a caller may continue after an error
  }
  try {
    // Any data may follow a restart, as when a reader starts at a later group of frames.
    parser.restart(parser.restart_point());
    parse(parser, first, take);
    parser.finish();
  } catch (const BitstreamError&) {
  }
  return 0;
}

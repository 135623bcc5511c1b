// Passes arbitrary bytes as the content of a container: the OBUs of its configuration (an av1C
// box), then packets. They are read like the package reads them. First the headers, which determine
// where groups of frames start that refer to no earlier frames. Then everything, once from the
// start and once group by group, like threads do. Both must give the same frames and end at the
// same packet.

#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <span>
#include <vector>

#include "av1/error.h"
#include "av1/parser.h"
#include "fuzz/input.h"
#include "fuzz/parse.h"

namespace {

using colmap_av1::av1::BitstreamError;
using colmap_av1::av1::Event;
using colmap_av1::av1::Parser;
using colmap_av1::av1::ParserOptions;
using colmap_av1::av1::RestartPoint;
using colmap_av1::fuzz::check;

using Packet = std::vector<std::uint8_t>;
using Events = std::vector<std::unique_ptr<Event>>;

// A few bytes can require a large frame; these limits bound the time of one input.
constexpr std::int64_t kMaxFrameSize = 256 * 256;
constexpr std::size_t kMaxPackets = 32;
constexpr std::size_t kMaxEvents = 32;

struct Group {
  std::size_t first_packet = 0;
  std::optional<RestartPoint> start;  // none at the start of the stream
};

// Parses a packet and appends its events; false if the packet is damaged.
bool append(Parser& parser, const Packet& packet, Events& events) {
  return colmap_av1::fuzz::parse(
      parser, packet, [&](std::unique_ptr<Event> event) { events.push_back(std::move(event)); });
}

std::vector<Group> groups_of(const std::vector<Packet>& packets, ParserOptions options) {
  options.headers_only = true;
  Parser parser(options);
  std::vector<Group> groups(1);
  for (std::size_t i = 0; i < packets.size(); ++i) {
    std::optional<RestartPoint> start;
    try {
      start = parser.restart_point();
    } catch (const BitstreamError&) {  // the parser is inside a frame
    }
    Events events;
    const bool whole = append(parser, packets[i], events);
    if (i > 0 && start && !events.empty() && events.front()->header.is_shown_key_frame()) {
      groups.push_back({i, start});
    }
    if (!whole) break;
  }
  return groups;
}

void check_same(const Event& a, const Event& b) {
  check(a.decode_index == b.decode_index && a.temporal_unit == b.temporal_unit &&
            a.shown_decode_index == b.shown_decode_index,
        "groups number their frames as the stream does");
  check(a.ref_decode_index == b.ref_decode_index, "groups refer to the same frames");
  check(a.num_wrong_trailing_bits == b.num_wrong_trailing_bits, "groups find the same endings");
  check(a.block_index == b.block_index && a.blocks.size() == b.blocks.size(),
        "groups have the same blocks");
  for (std::size_t i = 0; i < a.blocks.size(); ++i) {
    check(a.blocks[i].mv == b.blocks[i].mv && a.blocks[i].ref_frame == b.blocks[i].ref_frame &&
              a.blocks[i].mi_size == b.blocks[i].mi_size && a.blocks[i].skip == b.blocks[i].skip &&
              a.blocks[i].segment_id == b.blocks[i].segment_id &&
              a.blocks[i].motion_mode == b.blocks[i].motion_mode,
          "groups have the same motion");
  }
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  colmap_av1::fuzz::Input input(data, size);
  const unsigned choice = input.byte();
  ParserOptions options;
  options.strict = (choice & 1) != 0;
  options.num_threads = (choice & 2) != 0 ? 2 : 1;
  options.operating_point = static_cast<int>(choice >> 2 & 31);
  options.max_frame_size = kMaxFrameSize;
  std::vector<Packet> packets;
  while (!input.empty() && packets.size() < kMaxPackets) {
    const auto unit = input.unit();
    packets.emplace_back(unit.begin(), unit.end());
  }
  const std::vector<Group> groups = groups_of(packets, options);

  // The first packet that is damaged or exceeds the limits.
  Parser parser(options);
  std::vector<Events> events(packets.size());
  std::size_t num_whole = 0;
  bool damaged = false;
  for (std::size_t num_events = 0; num_whole < packets.size() && num_events < kMaxEvents;
       ++num_whole) {
    if (!append(parser, packets[num_whole], events[num_whole])) {
      damaged = true;
      break;
    }
    num_events += events[num_whole].size();
  }
  for (std::size_t g = 1; g < groups.size(); ++g) {
    Parser reader(options);
    reader.restart(*groups[g].start);
    const std::size_t end = g + 1 < groups.size() ? groups[g + 1].first_packet : packets.size();
    for (std::size_t i = groups[g].first_packet; i < end && i <= num_whole; ++i) {
      if (i == num_whole && !damaged) break;
      Events found;
      const bool whole = append(reader, packets[i], found);
      check(whole == (i < num_whole), "groups end where the stream does");
      check(found.size() == events[i].size(), "groups have the same frames");
      for (std::size_t k = 0; k < found.size(); ++k) check_same(*found[k], *events[i][k]);
    }
  }
  return 0;
}

// The parser reads temporal units and returns one event per decoded or repeated frame.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <span>
#include <vector>

#include "av1/frame_state.h"
#include "av1/tile_parser.h"

namespace colmap_av1::av1 {

struct ParserOptions {
  int operating_point = 0;
  // Reads only the headers; events then have no blocks.
  bool headers_only = false;
  // Number of threads that parse the tiles of a tile group; the result does not depend on it.
  int num_threads = 1;
  // Tiles whose trailing bits are not those that the specification requires are errors.
  bool strict = false;
  // Largest accepted frame in luma samples.
  std::int64_t max_frame_size = std::int64_t{1} << 28;
};

// A decoded frame or a show_existing_frame header, in bitstream order.
struct Event {
  FrameHeader header;
  int decode_index = 0;  // index of this event
  int temporal_unit = 0;
  int obu_offset = 0;  // of the frame's first OBU in the data passed to `parse`, in bytes
  int num_tile_groups = 0;
  int num_wrong_trailing_bits = 0;  // tiles that do not end as the specification requires
  int shown_decode_index = -1;      // show_existing_frame: the event that decoded the frame
  // By RefFrame; -1 and 0 if there is no frame.
  std::array<int, TOTAL_REFS_PER_FRAME> ref_decode_index{};
  std::array<std::array<int, 2>, TOTAL_REFS_PER_FRAME> ref_size{};  // UpscaledWidth, FrameHeight
  // Reference slots after the reference frame update process
  std::array<int, NUM_REF_FRAMES> slot_decode_index{};
  std::vector<BlockInfo> blocks;          // in decoding order
  std::vector<std::int32_t> block_index;  // [mi_rows][mi_cols], the block of each unit
  std::vector<LocalWarp> local_warps;
  std::vector<int> tile_sizes;  // in bytes, in tile order
};

// The state from which parsing can start again at a shown key frame, which refers to no earlier
// frame.
struct RestartPoint {
  std::shared_ptr<const SequenceHeader> seq;
  int operating_point_idc = 0;
  int num_events = 0;
  int temporal_unit = -1;
  int shown_spatial_id = -1;
};

class Parser {
 public:
  explicit Parser(const ParserOptions& options) : options_(options) {}

  // Parses a temporal unit, or a part of one, of the low-overhead format (section 5.2) from
  // `position`, in bytes, to the end of the next frame or of the data, and moves `position` there.
  // Returns the frame; null if none ends. An OBU without a size field extends to the end of the
  // data. Throws BitstreamError or LimitError; the frame is then dropped, and the reference slots
  // that it would have refreshed keep their frames.
  std::unique_ptr<Event> parse(std::span<const std::uint8_t> data, std::size_t& position);

  // Throws BitstreamError if the stream ends inside a frame.
  void finish() const;

  // The current state of the parser. Throws BitstreamError inside a frame.
  RestartPoint restart_point() const;
  // Continues from a point of another parser of the same stream and operating point. Until the next
  // shown key frame, frames that refer to other frames are errors.
  void restart(const RestartPoint& point);

  // The current sequence header; null before the first one.
  const SequenceHeader* sequence_header() const { return seq_.get(); }
  int operating_point_idc() const { return operating_point_idc_; }

 private:
  struct Slot {
    bool valid = false;
    int order_hint = 0;
    std::shared_ptr<const FrameState> frame;
  };

  void start_temporal_unit() {
    ++temporal_unit_;
    shown_spatial_id_ = -1;
  }
  void parse_obus(std::span<const std::uint8_t> data, std::size_t& position);
  void sequence_header_obu(std::span<const std::uint8_t> data);
  // Returns the size of the header in bytes.
  std::size_t frame_header_obu(std::span<const std::uint8_t> data, int temporal_id, int spatial_id);
  void start_frame();
  void tile_group_obu(std::span<const std::uint8_t> data);
  struct TileData {
    int number;
    std::span<const std::uint8_t> data;
  };
  void parse_tiles(const std::vector<TileData>& tiles);
  void collect_local_warps();
  void collect_blocks();
  void finish_frame();
  void show_existing_frame();
  void update_references(const std::shared_ptr<const FrameState>& state, int refresh_frame_flags);
  std::array<const FrameState*, TOTAL_REFS_PER_FRAME> references() const;

  ParserOptions options_;
  std::shared_ptr<const SequenceHeader> seq_;
  int operating_point_idc_ = 0;
  std::array<Slot, NUM_REF_FRAMES> slots_;
  int num_events_ = 0;
  int temporal_unit_ = -1;
  int shown_spatial_id_ = -1;  // of the last shown frame of the temporal unit
  std::size_t obu_offset_ = 0;

  bool seen_frame_header_ = false;
  int tile_num_ = 0;
  FrameHeader header_;
  std::unique_ptr<Event> event_;  // of the current frame
  std::unique_ptr<Event> complete_event_;
  std::shared_ptr<FrameState> state_;
  FrameContext context_;
  std::vector<std::size_t> tile_first_block_;
  std::vector<std::size_t> tile_num_blocks_;
  std::vector<std::vector<LocalWarp>> tile_local_warps_;
  std::vector<char> tile_trailing_bits_valid_;
  std::vector<std::unique_ptr<TileParser>> tile_parsers_;  // one per thread
};

}  // namespace colmap_av1::av1

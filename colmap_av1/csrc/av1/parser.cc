// OBU syntax (specification sections 5.3 to 5.11.1), decode frame wrapup (7.4) and reference
// frame update (7.20, 7.21).
#include "av1/parser.h"

#include <algorithm>
#include <atomic>
#include <exception>
#include <system_error>
#include <thread>
#include <utility>

#include "av1/error.h"
#include "av1/motion_field.h"

namespace colmap_av1::av1 {
namespace {

using Bytes = std::span<const std::uint8_t>;

// 4.10.5 leb128( ), removed from the front of the data
std::size_t take_leb128(Bytes& data) {
  std::uint64_t value = 0;
  for (int i = 0; i < 8; ++i) {
    if (data.empty()) throw BitstreamError("OBU size ends early");
    const std::uint8_t byte = data.front();
    data = data.subspan(1);
    value |= static_cast<std::uint64_t>(byte & 0x7F) << (i * 7);
    if (!(byte & 0x80)) {
      if (value > 0xFFFFFFFFU) break;
      return static_cast<std::size_t>(value);
    }
  }
  throw BitstreamError("OBU size is longer than the specification allows");
}

// Threads that are joined at the end of their scope, also after an exception.
class JoinedThreads {
 public:
  JoinedThreads() = default;
  JoinedThreads(const JoinedThreads&) = delete;
  JoinedThreads& operator=(const JoinedThreads&) = delete;
  ~JoinedThreads() {
    for (std::thread& thread : threads_) thread.join();
  }

  // False if the system cannot start a thread.
  template <typename Work>
  bool start(Work work) {
    try {
      threads_.emplace_back(std::move(work));
      return true;
    } catch (const std::system_error&) {
      return false;
    }
  }

 private:
  std::vector<std::thread> threads_;
};

}  // namespace

std::unique_ptr<Event> Parser::parse(Bytes data, std::size_t& position) {
  try {
    parse_obus(data, position);
    return std::move(complete_event_);
  } catch (...) {
    // A damaged frame is dropped: later tile groups must not complete it.
    seen_frame_header_ = false;
    throw;
  }
}

void Parser::finish() const {
  if (seen_frame_header_) throw BitstreamError("stream ends inside a frame");
}

RestartPoint Parser::restart_point() const {
  finish();
  return {seq_, operating_point_idc_, num_events_, temporal_unit_, shown_spatial_id_};
}

void Parser::restart(const RestartPoint& point) {
  seq_ = point.seq;
  operating_point_idc_ = point.operating_point_idc;
  num_events_ = point.num_events;
  temporal_unit_ = point.temporal_unit;
  shown_spatial_id_ = point.shown_spatial_id;
  slots_ = {};
  seen_frame_header_ = false;
}

// 5.3 OBU syntax
void Parser::parse_obus(Bytes data, std::size_t& position) {
  Bytes rest = data.subspan(position);
  while (!rest.empty() && complete_event_ == nullptr) {
    obu_offset_ = data.size() - rest.size();
    const std::uint8_t header = rest.front();
    rest = rest.subspan(1);
    if (header & 0x80) throw BitstreamError("obu_forbidden_bit is set");
    const int obu_type = (header >> 3) & 15;
    const bool has_extension = header & 4;
    const bool has_size_field = header & 2;
    int temporal_id = 0;
    int spatial_id = 0;
    if (has_extension) {
      if (rest.empty()) throw BitstreamError("OBU header ends early");
      temporal_id = rest.front() >> 5;
      spatial_id = (rest.front() >> 3) & 3;
      rest = rest.subspan(1);
    }
    const std::size_t obu_size = has_size_field ? take_leb128(rest) : rest.size();
    if (obu_size > rest.size()) throw BitstreamError("OBU reaches beyond the end of the data");
    const Bytes payload = rest.first(obu_size);
    rest = rest.subspan(obu_size);
    if (obu_type != OBU_SEQUENCE_HEADER && obu_type != OBU_TEMPORAL_DELIMITER &&
        operating_point_idc_ != 0 && has_extension) {
      const bool in_temporal_layer = (operating_point_idc_ >> temporal_id) & 1;
      const bool in_spatial_layer = (operating_point_idc_ >> (spatial_id + 8)) & 1;
      if (!in_temporal_layer || !in_spatial_layer) continue;
    }
    switch (obu_type) {
      case OBU_SEQUENCE_HEADER: sequence_header_obu(payload); break;
      case OBU_TEMPORAL_DELIMITER:
        finish();
        start_temporal_unit();
        break;
      case OBU_FRAME_HEADER:
      case OBU_REDUNDANT_FRAME_HEADER: frame_header_obu(payload, temporal_id, spatial_id); break;
      case OBU_FRAME: {
        if (seen_frame_header_) throw BitstreamError("frame starts inside another frame");
        const std::size_t bytes = frame_header_obu(payload, temporal_id, spatial_id);
        if (!seen_frame_header_) throw BitstreamError("OBU_FRAME holds show_existing_frame");
        tile_group_obu(payload.subspan(bytes));
        break;
      }
      case OBU_TILE_GROUP: tile_group_obu(payload); break;
      default:  // metadata, tile lists, padding and reserved types do not affect motion
        break;
    }
  }
  position = data.size() - rest.size();
}

void Parser::sequence_header_obu(Bytes data) {
  if (seen_frame_header_) throw BitstreamError("sequence header inside a frame");
  BitReader reader(data);
  seq_ = std::make_shared<const SequenceHeader>(read_sequence_header(reader));
  const int op = options_.operating_point <= seq_->operating_points_cnt_minus_1
                     ? options_.operating_point
                     : 0;  // streams that lack the requested operating point have at least one
  operating_point_idc_ = seq_->operating_point_idc[op];
}

std::size_t Parser::frame_header_obu(Bytes data, int temporal_id, int spatial_id) {
  if (seen_frame_header_) return data.size();  // frame_header_copy( )
  if (!seq_) throw BitstreamError("frame comes before the first sequence header");
  References infos;
  for (int i = 0; i < NUM_REF_FRAMES; ++i) {
    const Slot& slot = slots_[i];
    infos[i].valid = slot.valid;
    infos[i].order_hint = slot.order_hint;
    if (slot.frame) {
      infos[i].header = &slot.frame->header;
      infos[i].frame_id = slot.frame->header.current_frame_id;
      infos[i].bit_depth = slot.frame->bit_depth;
      infos[i].subsampling_x = slot.frame->subsampling_x;
      infos[i].subsampling_y = slot.frame->subsampling_y;
    }
  }
  BitReader reader(data);
  header_ =
      read_frame_header(reader, *seq_, infos, temporal_id, spatial_id, options_.max_frame_size);
  for (int i = 0; i < NUM_REF_FRAMES; ++i) {
    slots_[i].valid = infos[i].valid;
    slots_[i].order_hint = infos[i].order_hint;
    if (infos[i].header == nullptr) slots_[i].frame.reset();
  }
  // Containers may omit temporal delimiters. A temporal unit has one shown frame for each spatial
  // layer, in ascending order (7.5).
  if (temporal_unit_ < 0 || spatial_id <= shown_spatial_id_) start_temporal_unit();
  if (header_.is_shown()) shown_spatial_id_ = spatial_id;
  event_ = std::make_unique<Event>();
  event_->header = header_;
  event_->decode_index = num_events_;
  event_->temporal_unit = temporal_unit_;
  event_->obu_offset = static_cast<int>(obu_offset_);
  event_->ref_decode_index.fill(-1);
  if (header_.show_existing_frame) {
    show_existing_frame();
    return data.size();
  }
  seen_frame_header_ = true;
  tile_num_ = 0;
  start_frame();
  reader.byte_alignment();
  return reader.position() / 8;
}

std::array<const FrameState*, TOTAL_REFS_PER_FRAME> Parser::references() const {
  std::array<const FrameState*, TOTAL_REFS_PER_FRAME> refs{};
  if (header_.frame_is_intra) return refs;
  for (int ref = LAST_FRAME; ref <= ALTREF_FRAME; ++ref) {
    refs[ref] = slots_[header_.ref_frame_idx[ref - LAST_FRAME]].frame.get();
  }
  return refs;
}

// The state that uncompressed_header( ) sets up besides its values: CDFs, segment ids, motion field
void Parser::start_frame() {
  state_ = std::make_shared<FrameState>();
  state_->decode_index = num_events_;
  state_->bit_depth = seq_->bit_depth;
  state_->subsampling_x = seq_->subsampling_x;
  state_->subsampling_y = seq_->subsampling_y;
  state_->header = header_;

  const auto refs = references();
  context_.seq = seq_.get();
  context_.header = &header_;
  context_.prev_segment_ids = nullptr;
  context_.ref_usable.fill(false);
  context_.ref_scaled.fill(false);
  context_.ref_distance.fill(0);
  for (int ref = LAST_FRAME; ref <= ALTREF_FRAME; ++ref) {
    if (refs[ref] == nullptr) continue;
    const FrameHeader& reference = refs[ref]->header;
    // is_scaled( ) of 5.11.27, and the limits on scaling of 7.11.3.3
    const int x_scale = ((reference.upscaled_width << REF_SCALE_SHIFT) + header_.frame_width / 2) /
                        header_.frame_width;
    const int y_scale = ((reference.frame_height << REF_SCALE_SHIFT) + header_.frame_height / 2) /
                        header_.frame_height;
    constexpr int kNoScale = 1 << REF_SCALE_SHIFT;
    context_.ref_scaled[ref] = x_scale != kNoScale || y_scale != kNoScale;
    context_.ref_usable[ref] = 2 * header_.frame_width >= reference.upscaled_width &&
                               2 * header_.frame_height >= reference.frame_height &&
                               header_.frame_width <= 16 * reference.upscaled_width &&
                               header_.frame_height <= 16 * reference.frame_height;
    context_.ref_distance[ref] = seq_->relative_dist(header_.order_hint, header_.order_hints[ref]);
    event_->ref_decode_index[ref] = refs[ref]->decode_index;
    event_->ref_size[ref] = {reference.upscaled_width, reference.frame_height};
  }
  if (options_.headers_only) return;

  const std::size_t units =
      static_cast<std::size_t>(header_.mi_rows) * static_cast<std::size_t>(header_.mi_cols);
  if (header_.primary_ref_frame == PRIMARY_REF_NONE) {
    context_.cdfs.init_non_coeff_cdfs();
    context_.cdfs.init_coeff_cdfs(header_.base_q_idx);
  } else {
    // load_cdfs( ) and load_previous_segment_ids( ); the header has checked that the frame exists
    const FrameState& previous = *slots_[header_.ref_frame_idx[header_.primary_ref_frame]].frame;
    context_.cdfs = previous.cdfs;
    if (header_.segmentation_enabled && previous.header.mi_rows == header_.mi_rows &&
        previous.header.mi_cols == header_.mi_cols && !previous.segment_ids.empty()) {
      context_.prev_segment_ids = previous.segment_ids.data();
    }
  }
  context_.grid.assign(units, nullptr);
  if (context_.blocks_capacity < units) {
    context_.blocks = make_block_buffer(units);
    context_.blocks_capacity = units;
  }
  if (header_.use_ref_frame_mvs) {
    context_.motion_field = estimate_motion_field(*seq_, header_, refs);
  }
  const std::size_t num_tiles = static_cast<std::size_t>(header_.tile_cols * header_.tile_rows);
  tile_first_block_.assign(num_tiles, 0);
  tile_num_blocks_.assign(num_tiles, 0);
  tile_local_warps_.assign(num_tiles, {});
  tile_trailing_bits_valid_.assign(num_tiles, true);
  std::size_t first = 0;
  for (int row = 0; row < header_.tile_rows; ++row) {
    for (int col = 0; col < header_.tile_cols; ++col) {
      tile_first_block_[static_cast<std::size_t>(row * header_.tile_cols + col)] = first;
      first +=
          static_cast<std::size_t>(header_.mi_row_starts[row + 1] - header_.mi_row_starts[row]) *
          static_cast<std::size_t>(header_.mi_col_starts[col + 1] - header_.mi_col_starts[col]);
    }
  }
}

// 5.11.1 General tile group OBU syntax
void Parser::tile_group_obu(Bytes data) {
  if (!seen_frame_header_) throw BitstreamError("tile group without a frame header");
  const int num_tiles = header_.tile_cols * header_.tile_rows;
  BitReader reader(data);
  int tg_start = 0;
  int tg_end = num_tiles - 1;
  if (num_tiles > 1 && reader.flag()) {  // tile_start_and_end_present_flag
    const int tile_bits = header_.tile_cols_log2 + header_.tile_rows_log2;
    tg_start = reader.literal(tile_bits);
    tg_end = reader.literal(tile_bits);
  }
  if (tg_start != tile_num_ || tg_end < tg_start || tg_end >= num_tiles) {
    throw BitstreamError("tile group does not continue the frame");
  }
  reader.byte_alignment();
  ++event_->num_tile_groups;
  Bytes rest = data.subspan(reader.position() / 8);
  std::vector<TileData> tiles;
  for (; tile_num_ <= tg_end; ++tile_num_) {
    std::size_t tile_size = rest.size();
    if (tile_num_ != tg_end) {
      const std::size_t bytes = static_cast<std::size_t>(header_.tile_size_bytes);
      if (rest.size() < bytes) throw BitstreamError("tile group ends inside a tile size");
      std::size_t minus_1 = 0;
      for (std::size_t i = 0; i < bytes; ++i) {
        minus_1 |= static_cast<std::size_t>(rest[i]) << (8 * i);
      }
      rest = rest.subspan(bytes);
      tile_size = minus_1 + 1;
    }
    if (tile_size > rest.size()) throw BitstreamError("tile reaches beyond its tile group");
    if (tile_size == 0) throw BitstreamError("tile is empty");
    event_->tile_sizes.push_back(static_cast<int>(tile_size));
    tiles.push_back({tile_num_, rest.first(tile_size)});
    rest = rest.subspan(tile_size);
  }
  if (!options_.headers_only) parse_tiles(tiles);
  if (tile_num_ == num_tiles) finish_frame();
}

// Tiles do not depend on each other (5.11.2). Each thread takes the next tile until one has an
// error. If several tiles have errors, that of the first tile is reported. Since tiles are taken in
// order, all tiles before it have been parsed, so the result does not depend on the number of
// threads.
void Parser::parse_tiles(const std::vector<TileData>& tiles) {
  // Starting a thread takes about as long as parsing some kilobytes.
  constexpr std::size_t kBytesPerThread = 8192;
  std::size_t bytes = 0;
  for (const TileData& tile : tiles) bytes += tile.data.size();
  const std::size_t num_threads =
      std::min({tiles.size(), static_cast<std::size_t>(std::max(1, options_.num_threads)),
                1 + bytes / kBytesPerThread});
  while (tile_parsers_.size() < num_threads) {
    tile_parsers_.push_back(std::make_unique<TileParser>());
  }
  std::vector<std::exception_ptr> errors(tiles.size());
  std::atomic<std::size_t> next{0};
  std::atomic<bool> failed{false};
  const auto work = [&](TileParser& parser) {
    for (std::size_t i; !failed && (i = next++) < tiles.size();) {
      try {
        const TileData& tile = tiles[i];
        const auto number = static_cast<std::size_t>(tile.number);
        parser.parse(context_, tile.number / header_.tile_cols, tile.number % header_.tile_cols,
                     tile.data, context_.blocks.get() + tile_first_block_[number]);
        tile_num_blocks_[number] = parser.num_blocks();
        tile_local_warps_[number] = parser.local_warps();
        tile_trailing_bits_valid_[number] = parser.trailing_bits_valid();
        if (options_.strict && !parser.trailing_bits_valid()) {
          throw BitstreamError("tile does not end with the bits that the specification demands");
        }
        if (!header_.disable_frame_end_update_cdf &&
            tile.number == header_.context_update_tile_id) {
          state_->cdfs = parser.cdfs();
          state_->cdfs.clear_counters();
        }
      } catch (...) {
        errors[i] = std::current_exception();
        failed = true;
      }
    }
  };
  {
    JoinedThreads threads;
    for (std::size_t i = 1; i < num_threads; ++i) {
      // If a thread cannot be started, the others parse all tiles.
      if (!threads.start([&work, parser = tile_parsers_[i].get()] { work(*parser); })) break;
    }
    work(*tile_parsers_[0]);
  }
  for (const auto& error : errors) {
    if (error) std::rethrow_exception(error);
  }
}

// The local warps of all tiles in one array, and the index of each block's warp
void Parser::collect_local_warps() {
  for (std::size_t tile = 0; tile < tile_local_warps_.size(); ++tile) {
    const std::vector<LocalWarp>& warps = tile_local_warps_[tile];
    if (warps.empty()) continue;
    const auto base = static_cast<std::int32_t>(event_->local_warps.size());
    BlockInfo* block = context_.blocks.get() + tile_first_block_[tile];
    for (std::size_t i = 0; i < tile_num_blocks_[tile]; ++i) {
      if (block[i].local_warp < 0) continue;
      const bool valid = warps[static_cast<std::size_t>(block[i].local_warp)].valid;
      block[i].local_warp += base;
      if (valid) block[i].warp_index = block[i].local_warp;
    }
    event_->local_warps.insert(event_->local_warps.end(), warps.begin(), warps.end());
  }
}

// The blocks of all tiles in one array, and the index of each unit's block
void Parser::collect_blocks() {
  std::size_t count = 0;
  for (const std::size_t num_blocks : tile_num_blocks_) count += num_blocks;
  event_->blocks.reserve(count);
  event_->block_index.resize(context_.grid.size());
  for (int tile_row = 0; tile_row < header_.tile_rows; ++tile_row) {
    for (int tile_col = 0; tile_col < header_.tile_cols; ++tile_col) {
      const auto tile = static_cast<std::size_t>(tile_row * header_.tile_cols + tile_col);
      const BlockInfo* first = context_.blocks.get() + tile_first_block_[tile];
      const auto base = static_cast<std::ptrdiff_t>(event_->blocks.size());
      event_->blocks.insert(event_->blocks.end(), first, first + tile_num_blocks_[tile]);
      const auto begin = static_cast<std::size_t>(header_.mi_col_starts[tile_col]);
      const auto end = static_cast<std::size_t>(header_.mi_col_starts[tile_col + 1]);
      for (int row = header_.mi_row_starts[tile_row]; row < header_.mi_row_starts[tile_row + 1];
           ++row) {
        const std::size_t row_start =
            static_cast<std::size_t>(row) * static_cast<std::size_t>(header_.mi_cols);
        for (std::size_t i = row_start + begin; i < row_start + end; ++i) {
          event_->block_index[i] = static_cast<std::int32_t>(base + (context_.grid[i] - first));
        }
      }
    }
  }
}

// 7.4 Decode frame wrapup process
void Parser::finish_frame() {
  seen_frame_header_ = false;
  if (!options_.headers_only) {
    collect_local_warps();
    event_->num_wrong_trailing_bits = static_cast<int>(
        std::count(tile_trailing_bits_valid_.begin(), tile_trailing_bits_valid_.end(), false));
    if (header_.disable_frame_end_update_cdf) state_->cdfs = context_.cdfs;
    state_->saved_motion = save_motion(*seq_, context_);
    const std::size_t units = context_.grid.size();
    if (header_.segmentation_enabled) {
      state_->segment_ids.resize(units);
      if (header_.segmentation_update_map) {
        for (std::size_t i = 0; i < units; ++i) {
          state_->segment_ids[i] = context_.grid[i]->segment_id;
        }
      } else if (context_.prev_segment_ids != nullptr) {
        std::copy_n(context_.prev_segment_ids, units, state_->segment_ids.begin());
      }
    }
    collect_blocks();
  }
  update_references(state_, header_.refresh_frame_flags);
  state_.reset();
  ++num_events_;
  complete_event_ = std::move(event_);
}

void Parser::show_existing_frame() {
  const std::shared_ptr<const FrameState> shown = slots_[header_.frame_to_show_map_idx].frame;
  event_->shown_decode_index = shown->decode_index;
  event_->header.order_hint = shown->header.order_hint;
  if (header_.frame_type == KEY_FRAME) {
    // 7.21 Reference frame loading process: the loaded frame is stored in every slot
    update_references(shown, header_.refresh_frame_flags);
  } else {
    update_references(nullptr, 0);
  }
  ++num_events_;
  complete_event_ = std::move(event_);
}

// 7.20 Reference frame update process
void Parser::update_references(const std::shared_ptr<const FrameState>& state,
                               int refresh_frame_flags) {
  for (int i = 0; i < NUM_REF_FRAMES; ++i) {
    if ((refresh_frame_flags >> i) & 1) slots_[i] = {true, state->header.order_hint, state};
    event_->slot_decode_index[i] = slots_[i].frame ? slots_[i].frame->decode_index : -1;
  }
}

}  // namespace colmap_av1::av1

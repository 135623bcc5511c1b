// A frame whose cells hold tracks. A cell is a unit or one of the equal parts of a unit.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "tracks/geometry.h"
#include "tracks/trusted_motion.h"

namespace colmap_av1::tracks {

// A cell holds at most one track, at a sub-pixel position in pixels of the picture. Most seeds are
// never continued; a seed becomes a track when it is continued.
inline constexpr std::int32_t kNoTrack = -1;
inline constexpr std::int32_t kSeed = -2;
struct Cell {
  std::int32_t track = kNoTrack;
  Point position;
  float variance = 0.F;  // of the position relative to the track's seed, in coded px^2
};

// The grid of equal squares into which units are divided.
struct CellGrid {
  explicit CellGrid(int cells_along_unit)
      : cells(cells_along_unit),
        log_cells(cells_along_unit / 2),
        half_cell(kUnit / 2.F / static_cast<float>(cells_along_unit)) {}

  int cells;        // along either side of a unit: 1, 2 or 4
  int log_cells;    // log2(cells)
  float half_cell;  // half a cell's width, in coded pixels

  Point centre(int row, int col) const {
    return {half_cell * static_cast<float>(2 * col + 1),
            half_cell * static_cast<float>(2 * row + 1)};
  }
  // Cells are half-open, so that neighbouring cells share no position.
  bool is_in_cell(Point position, Point centre) const {
    return position.x >= centre.x - half_cell && position.x < centre.x + half_cell &&
           position.y >= centre.y - half_cell && position.y < centre.y + half_cell;
  }
};

struct ChainedFrame {
  TrustedMotion motion;
  std::int32_t order = -1;  // among the chained frames; -1: not chained yet
  int cell_rows = 0;
  int cell_cols = 0;
  std::int64_t first_serial = 0;  // of the seed in the first cell
  std::vector<Cell> cells;
  // Velocity of the track's last step per shown frame, minus the frame's dominant motion; NaN for a
  // seed. Empty without the cosine test.
  std::vector<Point> velocity;

  bool is_chained() const { return order >= 0; }
  bool is_shown() const { return motion.display_index >= 0; }
  int unit_of(const CellGrid& grid, int cell) const {
    if (grid.cells == 1) return cell;
    const int row = cell / cell_cols;
    const int col = cell - row * cell_cols;
    return (row >> grid.log_cells) * motion.cols + (col >> grid.log_cells);
  }
};

}  // namespace colmap_av1::tracks

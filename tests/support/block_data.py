"""Block data made up for tests: a block for each unit, so that any unit can differ."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_av1.motion.frame_motion import BLOCK, FrameMotion


def blank_blocks(rows: int, cols: int) -> NDArray[np.void]:
    """Blocks of all zeros without a local warp, [rows, cols]."""
    blocks = np.zeros((rows, cols), BLOCK)
    blocks["local_warp"] = blocks["warp_index"] = -1
    return blocks


def frame_of_blocks(blocks: NDArray[np.void], **values: Any) -> FrameMotion:
    """A frame whose units have these blocks, [mi_rows, mi_cols], and no local warp."""
    index = np.arange(blocks.size, dtype=np.int32).reshape(blocks.shape)
    return FrameMotion(
        blocks=blocks.reshape(-1),
        block_index=index,
        local_warp_params=np.zeros((0, 6), np.int32),
        **values,
    )


def units(frame: FrameMotion) -> NDArray[np.void]:
    """The blocks of such a frame by their units, [mi_rows, mi_cols], to be written."""
    return frame.blocks.reshape(frame.block_index.shape)


def with_units(frame: FrameMotion, **fields: Any) -> FrameMotion:
    """Such a frame with other values of the units' fields."""
    changed = replace(frame, blocks=frame.blocks.copy())
    for name, values in fields.items():
        units(changed)[name] = values
    return changed

"""Synthetic block data, with one block per unit so that any unit can be changed."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_av1.motion.frame_motion import BLOCK, FrameMotion


def blank_blocks(rows: int, cols: int) -> NDArray[np.void]:
    """Zero blocks without a local warp, [rows, cols]."""
    blocks = np.zeros((rows, cols), BLOCK)
    blocks["local_warp"] = blocks["warp_index"] = -1
    return blocks


def frame_of_blocks(blocks: NDArray[np.void], **values: Any) -> FrameMotion:
    """A frame with one block per unit, [mi_rows, mi_cols], and no local warps."""
    index = np.arange(blocks.size, dtype=np.int32).reshape(blocks.shape)
    return FrameMotion(
        blocks=blocks.reshape(-1),
        block_index=index,
        local_warp_params=np.zeros((0, 6), np.int32),
        **values,
    )


def units(frame: FrameMotion) -> NDArray[np.void]:
    """Writable view of the blocks of such a frame, [mi_rows, mi_cols]."""
    return frame.blocks.reshape(frame.block_index.shape)


def with_units(frame: FrameMotion, **fields: Any) -> FrameMotion:
    """A copy of such a frame with other values of some fields of the units."""
    changed = replace(frame, blocks=frame.blocks.copy())
    for name, values in fields.items():
        units(changed)[name] = values
    return changed

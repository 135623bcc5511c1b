"""Block data of one coded frame."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from colmap_av1 import _core

# The record of a block: all values of its syntax, under the specification's names.
BLOCK = _core.block_dtype()

_Value = TypeVar("_Value", bound=np.generic)


class _PerUnit(cached_property[NDArray[_Value]], Generic[_Value]):
    """A field of the blocks as an array with one entry per unit, made on first access."""

    def __init__(self) -> None:
        super().__init__(self._spread)

    def _spread(self, frame: FrameMotion) -> NDArray[_Value]:
        assert self.attrname is not None
        values: NDArray[_Value] = frame.blocks[self.attrname][frame.block_index]
        values.setflags(write=False)
        return values


@dataclass(frozen=True)
class FrameMotion:
    """Block data of one coded frame. A frame that is shown again is not repeated.

    Arrays named after the AV1 specification hold one entry per 4x4 luma unit,
    shape [mi_rows, mi_cols]. Units may lie beyond the picture edge (MiRows and
    MiCols are even). The arrays are made from `blocks` and `block_index` and are read-only.

    Attributes:
        decode_index: index of the frame among the events (decoded frames and
            show_existing_frame headers) of the stream, from 0, in bitstream order.
        display_index: index of the frame among the shown frames, in output order,
            from 0; -1 for a frame that is never shown.
        width: width in pixels of the picture after super-resolution (UpscaledWidth).
        height: height in pixels (FrameHeight).
        header: the frame header's values under the specification's names in
            snake_case, as Python ints or int32 arrays.
        ref_decode_index: [8] decode_index of the frame behind RefFrame 0..7
            (entry 0, INTRA_FRAME, and absent references: -1).
        ref_display_index: [8] display_index of the same frames, -1 if never shown.
        ref_size: [8, 2] (width, height) in pixels of the same frames, 0 if absent.
        slot_decode_index: [8] decode_index of the frame in each reference slot after
            this frame's reference frame update process; -1 for an empty slot.
        blocks: BLOCK [n] records of the frame's blocks, in decoding order; their fields are
            those below and further values of the block syntax.
        block_index: int32 [mi_rows, mi_cols] index of the block that contains each unit.
        local_warp_params: int32 [n, 6] LocalWarpParams (7.11.3.8), 16 fractional bits.
        ref_frame: int8 [mi_rows, mi_cols, 2] RefFrame: 0 INTRA, 1..7 LAST..ALTREF, -1 none.
        mv: int16 [mi_rows, mi_cols, 2, 2] Mv[list] as (row, column) in 1/8 px.
        mi_size: uint8 MiSize (BLOCK_4X4 = 0 .. BLOCK_64X16 = 21).
        y_mode: uint8 YMode (DC_PRED = 0 .. NEW_NEWMV = 24).
        is_inter: uint8; 1 also with use_intrabc.
        skip: uint8; 1: no residual is coded.
        skip_mode: uint8.
        segment_id: uint8.
        motion_mode: uint8; 0 SIMPLE, 1 OBMC, 2 LOCALWARP.
        compound_type: uint8; 255 for intra.
        interintra: uint8.
        use_intrabc: uint8.
        warp_index: int32; row of local_warp_params of the unit's block, -1 without
            a valid local warp.

    Examples:
        >>> from colmap_av1 import read_motion
        >>> frames = read_motion("video.mp4")
        >>> key_frame, frame = next(frames), next(frames)
        >>> frame.width, frame.height, frame.mv.shape
        (640, 360, (90, 160, 2, 2))
        >>> reference = frame.ref_frame[45, 80, 0]  # at the centre of the picture
        >>> int(frame.ref_display_index[reference])
        0
    """

    decode_index: int
    display_index: int
    width: int
    height: int
    header: dict[str, Any]
    ref_decode_index: NDArray[np.int32]
    ref_display_index: NDArray[np.int32]
    ref_size: NDArray[np.int32]
    slot_decode_index: NDArray[np.int32]
    blocks: NDArray[np.void]
    block_index: NDArray[np.int32]
    local_warp_params: NDArray[np.int32]

    ref_frame = _PerUnit[np.int8]()
    mv = _PerUnit[np.int16]()
    mi_size = _PerUnit[np.uint8]()
    y_mode = _PerUnit[np.uint8]()
    is_inter = _PerUnit[np.uint8]()
    skip = _PerUnit[np.uint8]()
    skip_mode = _PerUnit[np.uint8]()
    segment_id = _PerUnit[np.uint8]()
    motion_mode = _PerUnit[np.uint8]()
    compound_type = _PerUnit[np.uint8]()
    interintra = _PerUnit[np.uint8]()
    use_intrabc = _PerUnit[np.uint8]()
    warp_index = _PerUnit[np.int32]()

    def displacement(self, list_index: int) -> NDArray[np.float32]:
        """Displacement of every unit's centre into the frame that its list references.

        Args:
            list_index: 0 or 1, the reference list.

        Returns:
            float32 [mi_rows, mi_cols, 2], (x, y) in pixels of the coded frame (before
            super-resolution), with local and global warp applied; NaN if the unit has no
            reference in this list.
        """
        return _core.displacement(self, list_index)


# Names of the arrays that hold one entry per unit.
UNIT_FIELDS = tuple(
    name for name, value in vars(FrameMotion).items() if isinstance(value, _PerUnit)
)

"""Masks of the valid pixels of pictures."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_av1.util.arrays import Bools

# Higher levels make masks hardly smaller.
_COMPRESSION = 1


@dataclass(frozen=True)
class Mask:
    """The valid pixels of a picture, compressed because a long video has many masks.

    Attributes:
        size: (width, height) in pixels.
        packed: zlib-compressed bits of the pixels, row by row.
        share: share of valid pixels.
    """

    size: tuple[int, int]
    packed: bytes
    share: float

    @property
    def kept(self) -> Bools:
        """The valid pixels, bool [height, width]."""
        width, height = self.size
        bits = np.frombuffer(zlib.decompress(self.packed), np.uint8)
        return np.unpackbits(bits, count=width * height).reshape(height, width).view(np.bool_)

    def keeps(self, xy: NDArray[np.floating], size: tuple[int, int]) -> Bools:
        """Whether positions in a picture lie on valid pixels.

        Args:
            xy: [n, 2] positions in pixels, the first pixel's centre at (0.5, 0.5).
            size: (width, height) of the picture, which may differ from the mask's.
        """
        return valid_at(self.kept, xy, size)


def make_mask(kept: Bools) -> Mask:
    """Make a mask of valid pixels, bool [height, width]."""
    height, width = kept.shape
    packed = zlib.compress(np.packbits(kept).tobytes(), _COMPRESSION)
    return Mask((width, height), packed, float(kept.mean()))


def joined_masks(a: Mask | None, b: Mask | None) -> Mask | None:
    """The mask of pixels that are valid in both, with the size of the first; None: all pixels."""
    if a is None or b is None:
        return a if b is None else b
    other = b.kept
    if b.size != a.size:
        resized = cv2.resize(other.astype(np.uint8), a.size, interpolation=cv2.INTER_NEAREST)
        other = resized > 0
    return make_mask(a.kept & other)


def valid_at(kept: Bools, xy: NDArray[np.floating], size: tuple[int, int]) -> Bools:
    """Whether positions lie on valid pixels, see `Mask.keeps`."""
    # Column by column: NumPy is several times slower on rows of two elements.
    column, row = (
        np.clip((along * (own / other)).astype(np.int64), 0, own - 1)
        for along, own, other in zip((xy[:, 0], xy[:, 1]), kept.shape[::-1], size, strict=True)
    )
    return np.asarray(kept[row, column])

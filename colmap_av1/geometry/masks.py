"""Masks: which pixels of a picture count."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

# Masks have few edges: more effort makes them hardly smaller.
_COMPRESSION = 1


@dataclass(frozen=True)
class Mask:
    """Which pixels of a picture count.

    Attributes:
        size: (width, height) in pixels.
        packed: a bit a pixel, row by row, compressed: a long video's masks are many.
        share: of the pixels, those that count.
    """

    size: tuple[int, int]
    packed: bytes
    share: float

    @property
    def kept(self) -> NDArray[np.bool_]:
        """Bool [height, width] the pixels that count."""
        width, height = self.size
        bits = np.frombuffer(zlib.decompress(self.packed), np.uint8)
        return np.unpackbits(bits, count=width * height).reshape(height, width).view(np.bool_)

    def keeps(self, xy: NDArray[np.floating], size: tuple[int, int]) -> NDArray[np.bool_]:
        """Whether positions in a picture lie on pixels that count.

        Args:
            xy: [n, 2] pixels, the first one's centre at (0.5, 0.5).
            size: (width, height) of the picture, which may be another than the mask's.
        """
        return counted_at(self.kept, xy, size)


def make_mask(kept: NDArray[np.bool_]) -> Mask:
    """The mask of bool [height, width]: the pixels that count."""
    height, width = kept.shape
    packed = zlib.compress(np.packbits(kept).tobytes(), _COMPRESSION)
    return Mask((width, height), packed, float(kept.mean()))


def joined_masks(a: Mask | None, b: Mask | None) -> Mask | None:
    """The mask of what counts by both, of the size of the first; None: all does."""
    if a is None or b is None:
        return a if b is None else b
    other = b.kept
    if b.size != a.size:
        resized = cv2.resize(other.astype(np.uint8), a.size, interpolation=cv2.INTER_NEAREST)
        other = resized > 0
    return make_mask(a.kept & other)


def counted_at(
    kept: NDArray[np.bool_], xy: NDArray[np.floating], size: tuple[int, int]
) -> NDArray[np.bool_]:
    """Whether positions lie on pixels that count, see `Mask.keeps`."""
    # By columns: NumPy's loops over rows of two take several times as long.
    column, row = (
        np.clip((along * (own / other)).astype(np.int64), 0, own - 1)
        for along, own, other in zip((xy[:, 0], xy[:, 1]), kept.shape[::-1], size, strict=True)
    )
    return np.asarray(kept[row, column])

"""The size at which pictures are coded where only their motion is wanted."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_av1.options import EncodeOptions

# Pixels that a picture keeps at least where it is coded smaller than it is.
_LEAST_PIXELS = 500_000


def with_downscale(options: EncodeOptions, size: tuple[int, int]) -> EncodeOptions:
    """The same options, with what pictures of a (width, height) are downscaled by."""
    if options.downscale is not None:
        return options
    return replace(options, downscale=float(usual_downscale(size)))


def usual_downscale(size: tuple[int, int]) -> int:
    """The largest whole factor by which pictures of a (width, height) stay large enough."""
    return max(1, math.isqrt(size[0] * size[1] // _LEAST_PIXELS))


def smaller_grey(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The grey picture of a BGR one, made smaller by the usual factor where it is large."""
    grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    factor = usual_downscale(grey.shape[::-1])
    if factor > 1:
        size = tuple(length // factor for length in grey.shape[::-1])
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    return np.asarray(grey, np.uint8)


def coded_size(size: tuple[int, int], options: EncodeOptions) -> tuple[int, int]:
    """The (width, height) at which pictures of a (width, height) are coded."""
    factor = options.downscale or 1.0
    if factor == 1:
        return size
    # Even: encoders of hardware want that, and the colours are halved once more.
    width, height = (max(2, 2 * math.floor(length / factor / 2 + 0.5)) for length in size)
    return width, height


def scaling(options: EncodeOptions) -> list[str]:
    """Filters of ffmpeg that scale pictures to `coded_size`; none where they stay."""
    factor = options.downscale or 1.0
    if factor == 1:
        return []
    # Of the picture as it arrives: turned and cropped as players do.
    width, height = (f"max(2\\,2*floor({side}/{factor!r}/2+0.5))" for side in ("iw", "ih"))
    return [f"scale=w={width}:h={height}:flags=area"]

"""Downscaling of large pictures, to code their motion or to find features in them."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_av1.options import EncodeOptions

# A downscaled picture keeps at least this many pixels.
_MIN_PIXELS = 500_000


def with_downscale(options: EncodeOptions, size: tuple[int, int]) -> EncodeOptions:
    """The same options with `downscale` set for pictures of size (width, height)."""
    if options.downscale is not None:
        return options
    return replace(options, downscale=float(usual_downscale(size)))


def usual_downscale(size: tuple[int, int]) -> int:
    """The largest integer factor that leaves pictures of size (width, height) large enough."""
    return max(1, math.isqrt(size[0] * size[1] // _MIN_PIXELS))


def smaller_grey(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Convert a BGR picture to grey, and downscale a large one by the usual factor.

    Features are found in the result.
    """
    grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    factor = usual_downscale(grey.shape[::-1])
    if factor > 1:
        size = tuple(length // factor for length in grey.shape[::-1])
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    return np.asarray(grey, np.uint8)


def coded_size(size: tuple[int, int], options: EncodeOptions) -> tuple[int, int]:
    """The (width, height) at which pictures of size (width, height) are coded."""
    factor = options.downscale or 1.0
    if factor == 1:
        return size
    # The size is even because chroma planes have half of it and hardware encoders require it.
    width, height = (max(2, 2 * math.floor(length / factor / 2 + 0.5)) for length in size)
    return width, height


def scaling(options: EncodeOptions) -> list[str]:
    """FFmpeg filters that scale pictures to `coded_size`; empty if the size does not change."""
    factor = options.downscale or 1.0
    if factor == 1:
        return []
    # `iw` and `ih` are the size of the picture after ffmpeg has rotated and cropped it.
    width, height = (f"max(2\\,2*floor({side}/{factor:.15g}/2+0.5))" for side in ("iw", "ih"))
    return [f"scale=w={width}:h={height}:flags=area"]

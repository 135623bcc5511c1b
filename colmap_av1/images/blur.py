"""Recognise blurred pictures: frames to avoid as images, and images that give few tracks."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_av1.errors import ImageError
from colmap_av1.images.files import grey_within, read_image
from colmap_av1.util.arrays import Floats, Picture
from colmap_av1.util.spread import evenly_spread

# Longer side in pixels at which sharpness is measured.
_SHARPNESS_SIZE = 640
# A frame is blurred if its sharpness is less than this share of the sharpest frame nearby.
_BLURRED = 0.7
# Largest distance by which an image may move, as a share of the distance to the next one.
_REACH = 0.25
# Longer side in pixels at which detail is measured. Larger pictures are often soft at full size,
# which does no harm.
_DETAIL_SIZE = 960
# A pixel has detail if its grey value changes by more than this when the picture is halved and
# enlarged again. 2 to 30 % of the pixels of sharp videos have detail, and at most two in ten
# thousand after a Gaussian blur of 2.5 to 12 px. Images with less than the second share are
# blurred.
_VISIBLE = 8.0
_MIN_DETAIL = 0.005
# Second differences of grey values along rows, columns and both diagonals. Motion blur leaves
# detail only across its direction. In sharp videos, the poorest direction has at least 12 % of the
# detail of the richest; after a blur along a line of 9 px at most 3 %, of 25 to 80 px 0.5 %, even
# with noise of 3 grey levels.
_SECOND_DIFFERENCES = tuple(
    np.array(kernel, np.float32) / 4
    for kernel in (
        [[0, 0, 0], [-1, 2, -1], [0, 0, 0]],
        [[0, -1, 0], [0, 2, 0], [0, -1, 0]],
        [[-1, 0, 0], [0, 2, 0], [0, 0, -1]],
        [[0, 0, -1], [0, 2, 0], [-1, 0, 0]],
    )
)
_MIN_OF_RICHEST = 0.02
# Number of images of a video in which detail is measured.
_NUM_MEASURED = 5


def skip_blurred(
    frames: NDArray[np.int32],
    sharpness: Callable[[Sequence[int]], Floats],
) -> NDArray[np.int32]:
    """Replace blurred frames by sharp ones nearby.

    An image moves by at most a quarter of the distance to its neighbours, to the sharpest frame.
    The first and the last image stay.

    Args:
        frames: chosen frames, ascending.
        sharpness: returns the sharpness of frames; called once, with ascending frames.

    Returns:
        int32 [len(frames)] frames, strictly ascending.

    Raises:
        ImageError: pictures cannot be decoded.
    """
    reach = np.floor(np.diff(frames) * _REACH).astype(np.int64)
    windows = {
        k: np.arange(frames[k] - reach[k - 1], frames[k] + reach[k] + 1)
        for k in range(1, len(frames) - 1)
        if reach[k - 1] or reach[k]
    }
    if not windows:
        return frames
    asked = np.unique(np.concatenate(list(windows.values())))
    values = sharpness(asked.tolist())
    if len(values) < len(asked):
        raise ImageError(
            f"only {len(values)} of {len(asked)} pictures can be decoded to find blurred ones: "
            "give --skip_blurred 0"
        )
    measured = dict(zip(asked.tolist(), values, strict=True))
    chosen = frames.copy()
    for k, window in windows.items():
        sharp = np.array([measured[int(f)] for f in window])
        if measured[int(frames[k])] < _BLURRED * sharp.max():
            chosen[k] = window[sharp.argmax()]
    return np.asarray(chosen, dtype=np.int32)


def sharpness_of(pictures: Iterable[tuple[int, Picture]]) -> Floats:
    """Variance of the Laplacian of pictures, downscaled to reduce noise."""
    small = (grey_within(picture, _SHARPNESS_SIZE) for _, picture in pictures)
    return np.array([float(cv2.Laplacian(grey, cv2.CV_32F).var()) for grey in small])


def blur_warning(files: Sequence[Path]) -> str | None:
    """Warning if the images are blurred, measured in a few of them.

    Raises:
        ImageError: an image is missing or cannot be read.
    """
    some = [files[i] for i in evenly_spread(len(files), _NUM_MEASURED, rounded=True)]
    greys = [grey_within(read_image(file), _DETAIL_SIZE) for file in some]
    if float(np.median([_detail(grey) for grey in greys])) < _MIN_DETAIL:
        return (
            f"{files[0].parent}: the images are blurred, dark or lack texture; images of half "
            "the size would show the same detail: their tracks are few and inaccurate; film in "
            "focus, in good light and more slowly"
        )
    directions = np.median([_detail_by_direction(grey) for grey in greys], axis=0)
    if directions.min() < _MIN_OF_RICHEST * directions.max():
        return (
            f"{files[0].parent}: the images are blurred in one direction, as by camera motion: "
            "their tracks are few and inaccurate; film more slowly, or in more light, which "
            "shortens the exposure"
        )
    return None


def _detail(grey: Picture) -> float:
    """Share of the pixels that have detail."""
    height, width = grey.shape
    half = (max(1, width // 2), max(1, height // 2))
    small = cv2.resize(grey, half, interpolation=cv2.INTER_AREA)
    again = cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC)
    return float(np.mean(cv2.absdiff(grey, again) > _VISIBLE))


def _detail_by_direction(grey: Picture) -> list[float]:
    """Share of the pixels that have detail along rows, columns and both diagonals."""
    return [
        float(np.mean(np.abs(cv2.filter2D(grey, cv2.CV_32F, kernel)) > _VISIBLE))
        for kernel in _SECOND_DIFFERENCES
    ]

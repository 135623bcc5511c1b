"""Corners followed from picture to picture, for poses where the motion vectors are misleading.

Where a camera jerks, or a rolling shutter bends a picture, an encoder chooses the motion that
compresses well. Whole regions then agree on false motion, and the pose of that image is off by
pixels although its residuals are small. Corners of the pictures (Shi and Tomasi, "Good Features to
Track", 1994) that are followed by pyramidal Lucas-Kanade are few, take some hundredths of a second
per image, and show the true pose.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.arrays import Bools, Ints
from colmap_av1.util.grouping import with_equal_keys
from colmap_av1.video.coded_size import smaller_grey

_Floats = NDArray[np.float32]
# Returns which positions [n, 2] are valid, given the index of a frame and the (width, height) of
# its picture.
IsValid = Callable[[int, _Floats, tuple[int, int]], Bools]

# Smallest strength of a corner, relative to the strongest one of the picture.
_QUALITY = 0.01
# New corners are detected when fewer than this share of the largest number are left.
_FEW = 0.8
_WINDOW = (15, 15)
_LEVELS = 3
_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.01)
# Largest forward-backward error in pixels.
_MAX_RETURN = 0.15
# Smallest number of images in which a corner is observed.
_MIN_IMAGES = 3
# Expected error in pixels of the searched picture, which may be downscaled.
_SIGMA = 0.25


@dataclass(frozen=True)
class CornerDensity:
    """How many corners are followed.

    Attributes:
        most: largest number of corners in an image.
        spacing: smallest distance between them in pixels of the searched picture.
    """

    most: int = 650
    spacing: int = 13


def follow_corners(
    guide: Tracks,
    pictures: Iterable[tuple[int, NDArray[np.uint8]]],
    is_valid: IsValid,
    progress: Callable[[int], None] | None = None,
    *,
    density: CornerDensity = CornerDensity(),
    keep: Callable[[int, NDArray[np.uint8]], None] | None = None,
) -> Tracks:
    """Follow corners from each picture to the next one.

    Large pictures are downscaled for the search, as large videos are for their motion.

    Args:
        guide: tracks of the same video: a corner is searched for where the nearest track moves.
        pictures: (frame, picture) in the order of frames, uint8 BGR [height, width, 3] of one size.
        is_valid: which positions are valid, see `IsValid`; for masks.
        progress: called after each picture with the number of pictures so far.
        density: how many corners to follow.
        keep: called with each frame and its grey picture that is searched.

    Returns:
        Tracks with observations in at least three pictures; their frames are those of `guide` and
        their positions are in pixels of the pictures.
    """
    by_frame, track = guide.by_frame(), guide.track
    seen: list[tuple[int, Ints, _Floats]] = []
    before: tuple[int, NDArray[np.uint8]] | None = None
    number, at = np.empty(0, np.int64), np.empty((0, 2), np.float32)
    count, scale = 0, np.ones(2, np.float32)
    for frame, picture in pictures:
        grey = smaller_grey(picture)
        if keep is not None:
            keep(frame, grey)
        scale = (np.array(picture.shape[1::-1]) / grey.shape[::-1]).astype(np.float32)
        usable = partial(_are_usable, is_valid, frame, grey.shape[::-1])
        if before is not None and len(at):
            first, second = with_equal_keys(track, by_frame[before[0]], by_frame[frame])
            start, motion = guide.xy[first], guide.xy[second] - guide.xy[first]
            expected = _nearest(start / scale, motion / scale, at)
            at, followed = _follow(before[1], grey, at, expected)
            followed &= usable(at)
            number, at = number[followed], at[followed]
        if len(at) < _FEW * density.most:
            new = _new_corners(grey, at, density)
            new = new[usable(new)]
            number = np.concatenate([number, np.arange(count, count + len(new))])
            at, count = np.concatenate([at, new]), count + len(new)
        seen.append((frame, number, at))
        before = frame, grey
        if progress is not None:
            progress(len(seen))
    return _as_tracks(guide, seen, scale)


def _nearest(start: _Floats, motion: _Floats, at: _Floats) -> _Floats:
    """The motion of the track nearest to each position; 0 if there are no tracks."""
    from scipy.spatial import cKDTree  # noqa: PLC0415 - slow to import

    if len(start) == 0:
        return np.zeros_like(at)
    return np.asarray(motion[cKDTree(start).query(at)[1]], np.float32)


def _follow(
    before: NDArray[np.uint8], now: NDArray[np.uint8], at: _Floats, motion: _Floats
) -> tuple[_Floats, Bools]:
    """Search for corners near the positions to which their expected motion leads.

    Returns:
        Their positions, and which were found and passed a forward-backward check.
    """
    flags = cv2.OPTFLOW_USE_INITIAL_FLOW

    def search(
        source: NDArray[np.uint8], target: NDArray[np.uint8], p: _Floats, to: _Floats, levels: int
    ) -> tuple[_Floats, Bools]:
        # OpenCV's origin is the centre of the first pixel.
        found, ok, _ = cv2.calcOpticalFlowPyrLK(
            source,
            target,
            p - 0.5,
            to - 0.5,
            winSize=_WINDOW,
            maxLevel=levels,
            criteria=_CRITERIA,
            flags=flags,
        )
        return np.asarray(found + np.float32(0.5), np.float32), ok.ravel() == 1

    found, forward = search(before, now, at, at + motion, _LEVELS)
    # The backward search starts at the original position: it only checks that the corner stays.
    back, backward = search(now, before, found, at, 0)
    error = np.abs(back - at).max(axis=1)
    return found, forward & backward & (error <= _MAX_RETURN)


def _are_usable(is_valid: IsValid, frame: int, size: tuple[int, int], at: _Floats) -> Bools:
    """Whether positions lie inside the picture of a frame and are valid."""
    inside = np.asarray(((at >= 0) & (at <= size)).all(axis=1))
    inside[inside] = is_valid(frame, at[inside], size)
    return inside


def _new_corners(grey: NDArray[np.uint8], at: _Floats, density: CornerDensity) -> _Floats:
    """Detect corners that keep their distance from those that are already followed."""
    free = np.full(grey.shape, 255, np.uint8)
    for x, y in at.astype(np.int64).tolist():
        cv2.circle(free, (x, y), density.spacing, 0, -1)
    wanted = density.most - len(at)
    found = cv2.goodFeaturesToTrack(grey, wanted, _QUALITY, density.spacing, mask=free)
    if found is None:
        return np.empty((0, 2), np.float32)
    return np.asarray(found.reshape(-1, 2) + np.float32(0.5), np.float32)


def _as_tracks(guide: Tracks, seen: list[tuple[int, Ints, _Floats]], scale: _Floats) -> Tracks:
    """The corners that are observed in enough images, as tracks."""
    number = np.concatenate([[], *(n for _, n, _ in seen)]).astype(np.int64)
    xy = np.concatenate([np.empty((0, 2), np.float32), *(at for _, _, at in seen)]) * scale
    frame = np.repeat([f for f, _, _ in seen], [len(n) for _, n, _ in seen]).astype(np.int32)
    return Tracks.from_observations(
        guide.num_frames,
        (guide.width, guide.height),
        track=number,
        frame=frame,
        xy=xy,
        sigma=_SIGMA * float(scale.max()),
        min_length=_MIN_IMAGES,
    )

"""Corners followed from picture to picture, for poses where the motion of a stream misleads.

Where a camera jerks, or a shutter's read-out bends a picture, an encoder takes what compresses
well: whole regions agree on motion that is not there, and the pose of that one image is off by
pixels while its residuals stay small. Corners of the pictures (Shi and Tomasi, "Good Features to
Track", 1994) followed by pyramidal Lucas-Kanade are few, take some hundredths of a second an image,
and say where it is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_av1.tracks.tracks import Tracks
from colmap_av1.video.coded_size import smaller_grey

_Floats = NDArray[np.float32]
# Which positions [n, 2] count in a frame, by its index, whose picture is (width, height) large.
Counts = Callable[[int, _Floats, tuple[int, int]], NDArray[np.bool_]]

# Share of the strongest corner's strength that one has at least.
_QUALITY = 0.01
# New ones are looked for where fewer than this share of them are left.
_FEW = 0.8
_WINDOW = (15, 15)
_LEVELS = 3
_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.01)
# Pixels by which the way there and back may miss its start.
_MAX_RETURN = 0.15
# Images that see a corner at least.
_LEAST_IMAGES = 3
# Expected error in pixels of the picture that is looked at.
_SIGMA = 0.25


@dataclass(frozen=True)
class CornerDensity:
    """How many corners are followed.

    Attributes:
        most: corners of an image.
        spacing: pixels between them, of the picture that is looked at.
    """

    most: int = 650
    spacing: int = 13


def follow_corners(
    guide: Tracks,
    pictures: Iterable[tuple[int, NDArray[np.uint8]]],
    counts: Counts,
    progress: Callable[[int], None] | None = None,
    *,
    density: CornerDensity = CornerDensity(),
    keep: Callable[[int, NDArray[np.uint8]], None] | None = None,
) -> Tracks:
    """Follow corners from each picture to the next one.

    Large pictures are looked at in smaller ones, as the motion of large videos is.

    Args:
        guide: tracks of the same video: a corner is looked for where the track next to it goes.
        pictures: (frame, picture) in the order of frames, uint8 BGR [height, width, 3] of one size.
        counts: which positions count, see `Counts`: masks leave out others.
        progress: called after each picture with the number of pictures so far.
        density: how many.
        keep: called with each frame and the grey picture of it that is looked at.

    Returns:
        Tracks of three and more of the pictures, in the frames of `guide` and pixels of the
        pictures.
    """
    by_frame = guide.order_by_frame()
    bounds = np.searchsorted(guide.frame[by_frame], np.arange(guide.num_frames + 1))
    track = guide.track

    def observations(frame: int) -> NDArray[np.int64]:
        return by_frame[bounds[frame] : bounds[frame + 1]]

    seen: list[tuple[int, NDArray[np.int64], _Floats]] = []
    before: tuple[int, NDArray[np.uint8]] | None = None
    number, at = np.empty(0, np.int64), np.empty((0, 2), np.float32)
    count, scale = 0, np.ones(2, np.float32)
    for frame, picture in pictures:
        grey = smaller_grey(picture)
        if keep is not None:
            keep(frame, grey)
        scale = (np.array(picture.shape[1::-1]) / grey.shape[::-1]).astype(np.float32)
        inside = partial(_counts, counts, frame, grey.shape[::-1])
        if before is not None and len(at):
            start, way = _motion(observations(before[0]), observations(frame), guide.xy, track)
            expected = _nearest(start / scale, way / scale, at)
            at, followed = _follow(before[1], grey, at, expected)
            followed &= inside(at)
            number, at = number[followed], at[followed]
        if len(at) < _FEW * density.most:
            new = _new_corners(grey, at, density)
            new = new[inside(new)]
            number = np.concatenate([number, np.arange(count, count + len(new))])
            at, count = np.concatenate([at, new]), count + len(new)
        seen.append((frame, number, at))
        before = frame, grey
        if progress is not None:
            progress(len(seen))
    return _as_tracks(guide, seen, scale)


def _motion(
    before: NDArray[np.int64],
    now: NDArray[np.int64],
    xy: _Floats,
    track: NDArray[np.int64],
) -> tuple[_Floats, _Floats]:
    """Where the tracks are that two frames see, by their observations, and their ways between."""
    _, first, second = np.intersect1d(
        track[before], track[now], assume_unique=True, return_indices=True
    )
    start = xy[before[first]]
    return start, xy[now[second]] - start


def _nearest(start: _Floats, way: _Floats, at: _Floats) -> _Floats:
    """The way of the nearest of some tracks; none where there are no tracks."""
    from scipy.spatial import cKDTree  # noqa: PLC0415 - slow to import

    if len(start) == 0:
        return np.zeros_like(at)
    return np.asarray(way[cKDTree(start).query(at)[1]], np.float32)


def _follow(
    before: NDArray[np.uint8], now: NDArray[np.uint8], at: _Floats, way: _Floats
) -> tuple[_Floats, NDArray[np.bool_]]:
    """Look for corners near the ends of their expected ways.

    Returns:
        Where they are, and which are found: those that lead back to where they were.
    """
    flags = cv2.OPTFLOW_USE_INITIAL_FLOW

    def look(
        source: NDArray[np.uint8], target: NDArray[np.uint8], p: _Floats, to: _Floats, levels: int
    ) -> tuple[_Floats, NDArray[np.bool_]]:
        # OpenCV counts from the centre of the first pixel.
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

    found, there = look(before, now, at, at + way, _LEVELS)
    # From where it should end: it is asked whether it stays there, not whether it is found.
    back, home = look(now, before, found, at, 0)
    missed = np.abs(back - at).max(axis=1)
    return found, there & home & (missed <= _MAX_RETURN)


def _counts(counts: Counts, frame: int, size: tuple[int, int], at: _Floats) -> NDArray[np.bool_]:
    """Whether positions lie in the picture of a frame, and count."""
    inside = np.asarray(((at >= 0) & (at <= size)).all(axis=1))
    inside[inside] = counts(frame, at[inside], size)
    return inside


def _new_corners(grey: NDArray[np.uint8], at: _Floats, density: CornerDensity) -> _Floats:
    """Corners of a picture apart from those that are followed already."""
    free = np.full(grey.shape, 255, np.uint8)
    for x, y in at.astype(np.int64).tolist():
        cv2.circle(free, (x, y), density.spacing, 0, -1)
    wanted = density.most - len(at)
    found = cv2.goodFeaturesToTrack(grey, wanted, _QUALITY, density.spacing, mask=free)
    if found is None:
        return np.empty((0, 2), np.float32)
    return np.asarray(found.reshape(-1, 2) + np.float32(0.5), np.float32)


def _as_tracks(
    guide: Tracks, seen: list[tuple[int, NDArray[np.int64], _Floats]], scale: _Floats
) -> Tracks:
    """The corners that enough images saw, as tracks."""
    number = np.concatenate([[], *(n for _, n, _ in seen)]).astype(np.int64)
    xy = np.concatenate([np.empty((0, 2), np.float32), *(at for _, _, at in seen)]) * scale
    frame = np.repeat([f for f, _, _ in seen], [len(n) for _, n, _ in seen]).astype(np.int32)
    lengths = np.bincount(number)
    # Frames stay in their order.
    order = np.argsort(number, kind="stable")
    order = order[lengths[number[order]] >= _LEAST_IMAGES]
    lengths = lengths[lengths >= _LEAST_IMAGES]
    return Tracks(
        num_frames=guide.num_frames,
        width=guide.width,
        height=guide.height,
        offsets=np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
        frame=frame[order],
        xy=xy[order].astype(np.float32),
        sigma=np.full(len(order), _SIGMA * float(scale.max()), np.float32),
        confirmed=np.ones(len(order), np.bool_),
    )

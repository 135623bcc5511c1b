"""Tracks: chains of block displacements through the frames of a video."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_av1 import _core
from colmap_av1.errors import VideoError
from colmap_av1.motion.frame_motion import FrameMotion
from colmap_av1.options import TrackOptions
from colmap_av1.util.arguments import checks_arguments
from colmap_av1.util.memory import give_back_free_memory
from colmap_av1.video.display import Display, shown_points, shown_size

# Width in pixels of the squares that motion is coded for.
_UNIT = 4
_MIN_LENGTH = 4


@dataclass(frozen=True)
class Tracks:
    """Point tracks through a whole video, in compressed sparse row form.

    Track t has the observations offsets[t] : offsets[t + 1], sorted by frame.

    Attributes:
        num_frames: number of shown frames of the video.
        width: picture width in pixels, after super-resolution.
        height: picture height in pixels.
        offsets: int64 [num_tracks + 1].
        frame: int32 [num_observations] display index of the observing frame.
        xy: float32 [num_observations, 2] position in pixels, (x right, y down), origin at
            the top-left corner of the image: the first pixel's centre is (0.5, 0.5).
        sigma: float32 [num_observations] expected standard deviation of the position along
            either axis, in pixels, against the track's first observation.
        confirmed: bool [num_observations] whether decoded pixels confirmed the position;
            without refinement none is.
    """

    num_frames: int
    width: int
    height: int
    offsets: NDArray[np.int64]
    frame: NDArray[np.int32]
    xy: NDArray[np.float32]
    sigma: NDArray[np.float32]
    confirmed: NDArray[np.bool_]

    @property
    def track(self) -> NDArray[np.int64]:
        """Int64 [num_observations] the track of each observation."""
        return np.repeat(np.arange(len(self.offsets) - 1), np.diff(self.offsets))


@checks_arguments
def build_tracks(
    motion: Iterable[FrameMotion],
    options: TrackOptions | None = None,
    progress: Callable[[int], None] | None = None,
    *,
    frames: NDArray[np.int32] | None = None,
) -> Tracks:
    """Chain the motion of a video into point tracks.

    The motion of a block holds for each of its 4x4 units. A unit carries on the track
    found where its displacement lands in the referenced frame, to the sub-pixel place
    that moves exactly onto it, and a track moves with its unit into a reference shown
    later. Where two tracks want one cell, a unit unless `options.cell` cuts it into parts, the
    longer is continued. Frames are chained in display order
    and links to the nearest frame come first, so a frame that was coded far ahead is reached by
    the short steps between; frames that are never shown are chained through last. A unit without
    coded motion moves as those on either side of it do, where these agree. A unit without a
    track starts one at its centre. No cell holds two tracks, no frame sees a track twice. Frames
    are consumed one by one; beyond a few frames of motion, memory grows with the observations
    only.

    Args:
        motion: the coded frames of one video, in bitstream order.
        options: how to chain; the defaults of TrackOptions if None.
        progress: called after each coded frame with the number of frames so far.
        frames: int32 [n] display indices of the frames whose observations are kept, which bounds
            memory; None: those of all.

    Returns:
        Tracks of at least `options.min_length` shown frames, 4 if None, in the order of their seeds
        (display order of the frame, then raster order). Where frames differ in size,
        positions are in pixels of the first shown frame's size. With `frames` they are the same
        tracks, without those that fewer than two of these see.

    Raises:
        VideoError: no frame is shown.
        ValueError: the frames are not in bitstream order, or their arrays contradict
            each other.
    """
    options = options if options is not None else TrackOptions()
    core_options = _core_options(options)
    if frames is not None:
        core_options.observed = frames.tolist()
    builder = _core.TrackBuilder(core_options)
    for count, frame in enumerate(motion, start=1):
        if not isinstance(frame, FrameMotion):
            raise TypeError(
                f"build_tracks: motion gives {type(frame).__name__}: give frames of read_motion"
            )
        builder.add(frame)
        if progress is not None:
            progress(count)
    num_frames, width, height, offsets, frame_index, xy, sigma = builder.finish()
    give_back_free_memory()  # what was needed to build the tracks, as much as they are
    if num_frames == 0:
        raise VideoError("the video shows no frame: give a video with at least one picture")
    confirmed = np.zeros(len(frame_index), dtype=np.bool_)
    return Tracks(num_frames, width, height, offsets, frame_index, xy, sigma, confirmed)


def show_tracks(
    tracks: Tracks, display: Display, presented: NDArray[np.int32] | None = None
) -> Tracks:
    """The tracks in the pictures that players show, in place of those that are stored.

    Args:
        tracks: tracks through all shown frames of a bitstream.
        display: how its pictures are cut and turned.
        presented: indices of the frames that players show, ascending; None: all.

    Returns:
        The observations within what is shown; frames are numbered anew where some are left out.
    """
    size = shown_size((tracks.width, tracks.height), display)
    xy = shown_points(tracks.xy, (tracks.width, tracks.height), display)
    shown = replace(tracks, width=size[0], height=size[1], xy=xy)
    # By columns: NumPy's loops over rows of two take several times as long, here and below.
    x, y = xy[:, 0], xy[:, 1]
    kept = (x >= 0) & (x <= size[0]) & (y >= 0) & (y <= size[1])
    if presented is not None:
        presented = presented[presented < tracks.num_frames]
        number = np.full(tracks.num_frames, -1, dtype=np.int32)
        number[presented] = np.arange(len(presented), dtype=np.int32)
        shown = replace(shown, num_frames=len(presented), frame=number[tracks.frame])
        kept &= shown.frame >= 0
    return keep_observations(shown, kept)


def keep_observations(tracks: Tracks, kept: NDArray[np.bool_]) -> Tracks:
    """The tracks with some of their observations only.

    Args:
        tracks: any tracks.
        kept: bool [num_observations].

    Returns:
        Tracks in their former order, without those that keep nothing.
    """
    if kept.all():
        return tracks
    so_far = np.zeros(len(kept) + 1, dtype=np.min_scalar_type(len(kept)))
    np.cumsum(kept, out=so_far[1:])
    lengths = np.diff(so_far[tracks.offsets].astype(np.int64))
    return replace(
        tracks,
        offsets=np.concatenate([[0], np.cumsum(lengths[lengths > 0])]).astype(np.int64),
        frame=tracks.frame[kept],
        xy=_rows(tracks.xy, kept),
        sigma=tracks.sigma[kept],
        confirmed=tracks.confirmed[kept],
    )


def _rows(xy: NDArray[np.float32], kept: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Some rows of a [n, 2] array: as numbers of eight bytes, which takes no indices."""
    rows = np.ascontiguousarray(xy).view(np.uint64)[:, 0]
    return rows[kept].view(np.float32).reshape(-1, 2)


def keep_frames(tracks: Tracks, frames: NDArray[np.int32]) -> Tracks:
    """The tracks with the observations in these frames only, as `keep_observations`."""
    wanted = np.zeros(tracks.num_frames, dtype=np.bool_)
    wanted[frames] = True
    return keep_observations(tracks, wanted[tracks.frame])


def in_frames_alone(tracks: Tracks, frames: NDArray[np.int32]) -> Tracks:
    """The tracks as of a video that shows some frames only, and no others between them.

    Args:
        tracks: any tracks.
        frames: int32 [n] display indices, ascending.
    """
    number = np.full(tracks.num_frames, -1, dtype=np.int32)
    number[frames] = np.arange(len(frames), dtype=np.int32)
    seen = keep_frames(tracks, frames)
    return replace(seen, num_frames=len(frames), frame=number[seen.frame])


def keep_tracks_of(tracks: Tracks, frames: NDArray[np.int32], fewest: int) -> Tracks:
    """The tracks that this many of some frames see at least, with all their observations."""
    counted = np.zeros(tracks.num_frames, dtype=np.bool_)
    counted[frames] = True
    so_far = np.concatenate([[0], np.cumsum(counted[tracks.frame])])
    counts = np.diff(so_far[tracks.offsets])
    return keep_observations(tracks, np.repeat(counts >= fewest, np.diff(tracks.offsets)))


def keep_long_tracks(tracks: Tracks, min_length: int) -> Tracks:
    """The tracks that are observed in `min_length` frames or more, in their former order."""
    lengths = np.diff(tracks.offsets)
    return keep_observations(tracks, np.repeat(lengths >= min_length, lengths))


def every_nth_track(tracks: Tracks, n: int) -> Tracks:
    """One in `n` of the tracks, in their former order."""
    kept = np.arange(len(tracks.offsets) - 1) % n == 0
    return keep_observations(tracks, np.repeat(kept, np.diff(tracks.offsets)))


def shorter_tracks(tracks: Tracks, most: int) -> Tracks:
    """Tracks in pieces of much the same length that have so many observations at most.

    Args:
        tracks: any tracks.
        most: observations of a piece.

    Returns:
        All observations in their former order.
    """
    length = np.diff(tracks.offsets)
    piece = -(-length // -(-length // most))
    place = np.arange(len(tracks.frame)) - np.repeat(tracks.offsets[:-1], length)
    starts = np.flatnonzero(place % np.repeat(piece, length) == 0)
    return replace(tracks, offsets=np.append(starts, len(tracks.frame)).astype(np.int64))


def cut_tracks(tracks: Tracks, after: Sequence[int]) -> Tracks:
    """The tracks, cut in two wherever they pass from one of these frames to the next.

    Args:
        tracks: any tracks.
        after: display indices of the frames before each cut.

    Returns:
        All observations in their former order; the same object where nothing is cut.
    """
    if len(after) == 0:
        return tracks
    part = np.searchsorted(np.sort(np.asarray(after)), tracks.frame, side="left")
    starts = np.zeros(len(tracks.frame) + 1, dtype=np.bool_)
    starts[tracks.offsets] = True
    starts[1:-1] |= np.diff(part) != 0
    return replace(tracks, offsets=np.flatnonzero(starts).astype(np.int64))


def split_tracks(tracks: Tracks, kept: NDArray[np.bool_], cut: NDArray[np.bool_]) -> Tracks:
    """The tracks with some of their observations only, cut in two where one between is left out.

    Args:
        tracks: any tracks.
        kept: bool [num_observations].
        cut: bool [num_observations] those before which a track is cut all the same.
    """
    part = np.cumsum(~kept | cut)
    begins = np.ones(int(np.count_nonzero(kept)), dtype=np.bool_)
    begins[1:] = (np.diff(tracks.track[kept]) != 0) | (np.diff(part[kept]) != 0)
    return replace(
        tracks,
        offsets=np.append(np.flatnonzero(begins), len(begins)).astype(np.int64),
        frame=tracks.frame[kept],
        xy=_rows(tracks.xy, kept),
        sigma=tracks.sigma[kept],
        confirmed=tracks.confirmed[kept],
    )


def no_tracks(num_frames: int, size: tuple[int, int]) -> Tracks:
    """Tracks of a video where there are none."""
    return Tracks(
        *(num_frames, *size, np.zeros(1, np.int64), np.empty(0, np.int32)),
        *(np.empty((0, 2), np.float32), np.empty(0, np.float32), np.empty(0, np.bool_)),
    )


def join_tracks(a: Tracks, b: Tracks) -> Tracks:
    """All tracks of one video that two sets hold, those of the first first."""
    if len(b.offsets) == 1:
        return a
    return replace(
        a,
        offsets=np.concatenate([a.offsets, b.offsets[1:] + a.offsets[-1]]),
        frame=np.concatenate([a.frame, b.frame]),
        xy=np.concatenate([a.xy, b.xy]),
        sigma=np.concatenate([a.sigma, b.sigma]),
        confirmed=np.concatenate([a.confirmed, b.confirmed]),
    )


def tracks_in_a_row(videos: Sequence[Tracks], num_frames: int) -> Tracks:
    """The tracks of several videos as of one that shows them in a row.

    Args:
        videos: tracks of each.
        num_frames: frames of them all, and of what has no tracks after them.

    Returns:
        All tracks, those of the first video first, each in pixels of its own; width and height are
        the largest. The same object where there is but one video and nothing after it.
    """
    first = videos[0]
    if len(videos) == 1 and num_frames == first.num_frames:
        return first
    starts = np.cumsum([0, *(video.num_frames for video in videos)])
    counts = np.cumsum([0, *(video.offsets[-1] for video in videos)])
    return Tracks(
        num_frames=num_frames,
        width=max(video.width for video in videos),
        height=max(video.height for video in videos),
        offsets=np.concatenate(
            [[0], *(v.offsets[1:] + n for v, n in zip(videos, counts, strict=False))]
        ).astype(np.int64),
        frame=np.concatenate(
            [v.frame + np.int32(n) for v, n in zip(videos, starts, strict=False)]
        ).astype(np.int32),
        xy=np.concatenate([video.xy for video in videos]),
        sigma=np.concatenate([video.sigma for video in videos]),
        confirmed=np.concatenate([video.confirmed for video in videos]),
    )


def order_by_frame(frame: NDArray[np.integer[Any]], num_frames: int) -> NDArray[np.int64]:
    """Indices of observations by their frames, those of a frame in their former order."""
    # A type of two bytes is sorted by radix, in a quarter of the time.
    return np.argsort(frame.astype(np.min_scalar_type(num_frames)), kind="stable")


def scale_tracks(tracks: Tracks, size: tuple[int, int]) -> Tracks:
    """The tracks in pictures that are scaled to another (width, height) in pixels."""
    if size == (tracks.width, tracks.height):
        return tracks
    # All in numbers of four bytes: the arrays are the largest of a whole run.
    factor = np.array([size[0] / tracks.width, size[1] / tracks.height], np.float32)
    return replace(
        tracks,
        width=size[0],
        height=size[1],
        xy=tracks.xy * factor,
        sigma=tracks.sigma * np.float32(math.sqrt(float(factor.prod()))),
    )


def least_length(options: TrackOptions) -> int:
    """Shown frames that a track is seen in at least."""
    return _MIN_LENGTH if options.min_length is None else options.min_length


def _core_options(options: TrackOptions) -> _core.TrackBuilderOptions:
    """The options as the C++ core takes them: cells instead of their widths."""
    # Squares that tracks start in are not smaller than those that hold one.
    cell = options.cell or min(_UNIT, options.seeding)
    core = _core.TrackBuilderOptions()
    core.min_length = least_length(options)
    core.cosine = options.cosine
    core.cosine_relative_to_dominant = options.cosine_relative_to == "dominant"
    core.cosine_scale = options.cosine_scale
    core.max_interval = options.max_interval
    core.max_block_area = options.max_block_area
    core.max_uncoded_block_area = options.max_uncoded_block_area
    core.smoothness = options.smoothness
    core.border = options.border
    core.interpolation = options.interpolation
    core.bridge = options.bridge
    core.cells = _UNIT // cell
    core.seeding = options.seeding // cell
    return core

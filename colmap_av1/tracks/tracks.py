"""Tracks: chains of block displacements through the frames of a video."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_av1 import _core
from colmap_av1.errors import VideoError
from colmap_av1.motion.frame_motion import FrameMotion
from colmap_av1.options import TrackOptions
from colmap_av1.util.arrays import Bools, Ints
from colmap_av1.util.grouping import groups, indices_in
from colmap_av1.util.memory import give_back_free_memory
from colmap_av1.util.progress import Progress, no_progress
from colmap_av1.video.display import Display, shown_points, shown_size

# Width in pixels of the units that have motion.
_UNIT = 4
_MIN_LENGTH = 4


@dataclass(frozen=True)
class Tracks:
    """Point tracks through a whole video, in compressed sparse row form.

    Track t has the observations offsets[t] : offsets[t + 1], sorted by frame.

    Attributes:
        num_frames: number of frames of the video, or of all videos if tracks are joined.
        width: width in pixels of the pictures that positions refer to.
        height: their height.
        offsets: int64 [num_tracks + 1].
        frame: int32 [num_observations] the observing frame, in the order of display.
        xy: float32 [num_observations, 2] position in pixels, (x right, y down), origin at
            the top-left corner of the image: the first pixel's centre is (0.5, 0.5).
        sigma: float32 [num_observations] expected standard deviation of the position along
            either axis, in pixels, relative to the track's first observation.
        confirmed: bool [num_observations] whether decoded pixels confirmed the position;
            False without refinement.

    Examples:
        >>> from colmap_av1 import build_tracks, read_motion
        >>> tracks = build_tracks(read_motion("video.mp4")).keep_long(20)
        >>> first = slice(tracks.offsets[0], tracks.offsets[1])
        >>> tracks.frame[first][:4].tolist(), tracks.xy[first][:4].shape
        ([0, 1, 2, 3], (4, 2))
    """

    num_frames: int
    width: int
    height: int
    offsets: Ints
    frame: NDArray[np.int32]
    xy: NDArray[np.float32]
    sigma: NDArray[np.float32]
    confirmed: Bools

    @property
    def num_tracks(self) -> int:
        """Number of tracks."""
        return len(self.offsets) - 1

    @property
    def num_observations(self) -> int:
        """Number of observations of all tracks."""
        return len(self.frame)

    @property
    def lengths(self) -> Ints:
        """Number of observations of each track: int64 [num_tracks]."""
        return np.diff(self.offsets)

    @property
    def track(self) -> Ints:
        """Index of the track of each observation: int64 [num_observations]."""
        return np.repeat(np.arange(self.num_tracks), self.lengths)

    @staticmethod
    def empty(num_frames: int, size: tuple[int, int]) -> Tracks:
        """An empty set of tracks for a video of `num_frames` frames of `size` (width, height)."""
        return Tracks(
            num_frames=num_frames,
            width=size[0],
            height=size[1],
            offsets=np.zeros(1, np.int64),
            frame=np.empty(0, np.int32),
            xy=np.empty((0, 2), np.float32),
            sigma=np.empty(0, np.float32),
            confirmed=np.empty(0, np.bool_),
        )

    @staticmethod
    def from_arrays(arrays: Mapping[str, NDArray[Any]]) -> Tracks:
        """Tracks from the arrays that `np.savez` makes of the attributes, by their names."""
        values: dict[str, Any] = {field.name: arrays[field.name] for field in fields(Tracks)}
        for name in ("num_frames", "width", "height"):
            values[name] = int(values[name])
        return Tracks(**values)

    @staticmethod
    def concatenate(first: Tracks, *others: Tracks) -> Tracks:
        """The tracks of several sets through the same frames, one set after the other.

        The number of frames and the size are those of the first set. If the others are empty, the
        first set is returned.
        """
        sets = [first, *(other for other in others if other.num_tracks)]
        if len(sets) == 1:
            return first
        return replace(
            first,
            offsets=_joined_offsets(sets),
            frame=np.concatenate([one.frame for one in sets]),
            xy=np.concatenate([one.xy for one in sets]),
            sigma=np.concatenate([one.sigma for one in sets]),
            confirmed=np.concatenate([one.confirmed for one in sets]),
        )

    @staticmethod
    def in_sequence(videos: Sequence[Tracks], num_frames: int) -> Tracks:
        """The tracks of several videos as if they were one video, one after the other.

        Args:
            videos: the tracks of each video.
            num_frames: number of frames of all videos, plus those without tracks that follow, such
                as photos.

        Returns:
            All tracks in the order of the videos. Positions stay in pixels of their own video;
            width and height are the largest. The same object for one video without frames after it.
        """
        first = videos[0]
        if len(videos) == 1 and num_frames == first.num_frames:
            return first
        starts = np.cumsum([0, *(video.num_frames for video in videos[:-1])])
        frames = [v.frame + np.int32(start) for v, start in zip(videos, starts, strict=True)]
        return Tracks(
            num_frames=num_frames,
            width=max(video.width for video in videos),
            height=max(video.height for video in videos),
            offsets=_joined_offsets(videos),
            frame=np.concatenate(frames).astype(np.int32),
            xy=np.concatenate([video.xy for video in videos]),
            sigma=np.concatenate([video.sigma for video in videos]),
            confirmed=np.concatenate([video.confirmed for video in videos]),
        )

    @staticmethod
    def from_observations(
        num_frames: int,
        size: tuple[int, int],
        *,
        track: NDArray[np.integer[Any]],
        frame: NDArray[np.int32],
        xy: NDArray[np.floating[Any]],
        sigma: float,
        min_length: int,
    ) -> Tracks:
        """Make tracks from their observations.

        Args:
            num_frames: number of frames of the video.
            size: (width, height) in pixels of the pictures that positions refer to.
            track: integers [n] number of the track of each observation. A track is observed at most
                once in a frame.
            frame: int32 [n] display index of its frame.
            xy: [n, 2] its position in pixels.
            sigma: standard deviation of the positions in pixels.
            min_length: tracks with fewer observations are dropped.

        Returns:
            Confirmed tracks, in the order of their numbers.
        """
        lengths = np.bincount(track)
        order = np.lexsort((frame, track))
        order = order[lengths[track[order]] >= min_length]
        lengths = lengths[lengths >= min_length]
        return Tracks(
            num_frames=num_frames,
            width=size[0],
            height=size[1],
            offsets=np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
            frame=frame[order].astype(np.int32),
            xy=xy[order].astype(np.float32),
            sigma=np.full(len(order), sigma, np.float32),
            confirmed=np.ones(len(order), np.bool_),
        )

    def by_frame(self) -> list[Ints]:
        """The indices of the observations in each frame, in the order of their tracks."""
        return groups(self.frame, self.num_frames)

    def having(self, observations: Bools) -> Bools:
        """Which tracks have any of these observations: bool [num_tracks].

        Args:
            observations: bool [num_observations].
        """
        return np.logical_or.reduceat(observations, self.offsets[:-1])

    def keep_observations(self, kept: Bools) -> Tracks:
        """Keep some of the observations.

        Args:
            kept: bool [num_observations].

        Returns:
            Tracks in the same order, without those that keep no observation. The same object if
            all observations are kept.
        """
        if kept.all():
            return self
        so_far = np.zeros(len(kept) + 1, dtype=np.min_scalar_type(len(kept)))
        np.cumsum(kept, out=so_far[1:])
        lengths = np.diff(so_far[self.offsets].astype(np.int64))
        offsets = np.concatenate([[0], np.cumsum(lengths[lengths > 0])]).astype(np.int64)
        return self.take(kept, offsets)

    def keep_frames(self, frames: NDArray[np.int32]) -> Tracks:
        """Keep the observations in these frames, as `keep_observations`."""
        wanted = np.zeros(self.num_frames, dtype=np.bool_)
        wanted[frames] = True
        return self.keep_observations(wanted[self.frame])

    def subsample_frames(self, frames: NDArray[np.int32]) -> Tracks:
        """The tracks of a video that consists of these frames only, numbered from 0.

        Args:
            frames: int32 [n] display indices, ascending.
        """
        seen = self.keep_frames(frames)
        frame = indices_in(frames, self.num_frames)[seen.frame]
        return replace(seen, num_frames=len(frames), frame=frame)

    def keep_tracks(self, kept: Bools) -> Tracks:
        """Keep some of the tracks, in the same order.

        Args:
            kept: bool [num_tracks].
        """
        return self.keep_observations(np.repeat(kept, self.lengths))

    def keep_long(self, min_length: int) -> Tracks:
        """Keep the tracks with at least `min_length` observations."""
        return self.keep_tracks(self.lengths >= min_length)

    def keep_lasting(self, num_frames: int) -> Tracks:
        """Keep the tracks that reach over at least `num_frames` frames, observed or not."""
        last = self.offsets[1:] - 1
        return self.keep_tracks(self.frame[last] - self.frame[self.offsets[:-1]] >= num_frames - 1)

    def keep_observed_in(self, frames: NDArray[np.int32], min_frames: int) -> Tracks:
        """Keep the whole tracks that are observed in at least `min_frames` of these frames."""
        counted = np.zeros(self.num_frames, dtype=np.bool_)
        counted[frames] = True
        so_far = np.concatenate([[0], np.cumsum(counted[self.frame])])
        return self.keep_tracks(np.diff(so_far[self.offsets]) >= min_frames)

    def with_repeats(
        self, first: NDArray[np.int32], frames: NDArray[np.int32] | None = None
    ) -> Tracks:
        """Observe pictures that are shown again as at their first showing.

        Args:
            first: int32 [n] for each frame the frame that first shows its picture; n is at least
                `num_frames`.
            frames: int32 [m] the only frames that get observations; None: all.

        Returns:
            Tracks in the same order; the same object if no picture is shown again.
        """
        repeats = np.flatnonzero(first != np.arange(len(first)))
        if len(repeats) == 0:
            return self
        if frames is not None:  # copying all observations of a still picture needs much memory
            repeats = repeats[np.isin(repeats, frames)]
        # The observations of each frame, and how often they are repeated.
        by_frame = self.by_frame()
        copies = [by_frame[frame] for frame in first[repeats].tolist()]
        source = np.concatenate([np.arange(self.num_observations), *copies])
        added = np.repeat(repeats, [len(copy) for copy in copies])
        frame = np.concatenate([self.frame, added.astype(np.int32)])
        track = self.track[source]
        by_track = np.lexsort([frame, track])
        lengths = np.bincount(track, minlength=self.num_tracks)
        return replace(
            self,
            num_frames=len(first),
            offsets=np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
            frame=frame[by_track],
            xy=self.xy[source[by_track]],
            sigma=self.sigma[source[by_track]],
            confirmed=self.confirmed[source[by_track]],
        )

    def every_nth(self, n: int) -> Tracks:
        """Keep every n-th track, beginning with the first."""
        return self.keep_tracks(np.arange(self.num_tracks) % n == 0)

    def split_to_length(self, max_length: int) -> Tracks:
        """Split each track into parts of at most `max_length` observations.

        All parts of a track but the last have the same length.
        """
        lengths = self.lengths
        part = -(-lengths // -(-lengths // max_length))
        rank = np.arange(self.num_observations) - np.repeat(self.offsets[:-1], lengths)
        starts = np.flatnonzero(rank % np.repeat(part, lengths) == 0)
        offsets = np.append(starts, self.num_observations).astype(np.int64)
        return replace(self, offsets=offsets)

    def split_after_frames(self, frames: Sequence[int]) -> Tracks:
        """Split the tracks between each of these frames and the next.

        Args:
            frames: display indices; if empty, the same object is returned.
        """
        if len(frames) == 0:
            return self
        part = np.searchsorted(np.sort(np.asarray(frames)), self.frame, side="left")
        starts = np.zeros(self.num_observations + 1, dtype=np.bool_)
        starts[self.offsets] = True
        starts[1:-1] |= np.diff(part) != 0
        return replace(self, offsets=np.flatnonzero(starts).astype(np.int64))

    def split_at_removed(self, kept: Bools, starts: Bools) -> Tracks:
        """Keep some of the observations, and split tracks where one in between is removed.

        Args:
            kept: bool [num_observations].
            starts: bool [num_observations] further observations before which a track is split.
        """
        part = np.cumsum(~kept | starts)
        begins = np.ones(int(np.count_nonzero(kept)), dtype=np.bool_)
        begins[1:] = (np.diff(self.track[kept]) != 0) | (np.diff(part[kept]) != 0)
        return self.take(kept, np.append(np.flatnonzero(begins), len(begins)).astype(np.int64))

    def scale_to(self, size: tuple[int, int]) -> Tracks:
        """The tracks in pictures that are scaled to another (width, height) in pixels."""
        if size == (self.width, self.height):
            return self
        # Computed in float32 because the arrays are the largest of a run.
        factor = np.array([size[0] / self.width, size[1] / self.height], np.float32)
        return replace(
            self,
            width=size[0],
            height=size[1],
            xy=self.xy * factor,
            sigma=self.sigma * np.float32(math.sqrt(float(factor.prod()))),
        )

    def as_displayed(self, display: Display, presented: NDArray[np.int32] | None = None) -> Tracks:
        """Convert tracks in stored pictures to tracks in the pictures that players show.

        Args:
            display: how the pictures are cropped and rotated.
            presented: indices of the frames that players show, ascending; None: all.

        Returns:
            The observations inside the shown pictures. Frames are renumbered if some of them are
            not shown.
        """
        size = shown_size((self.width, self.height), display)
        xy = shown_points(self.xy, (self.width, self.height), display)
        shown = replace(self, width=size[0], height=size[1], xy=xy)
        # Columns are compared because NumPy takes several times as long for rows of two numbers.
        x, y = xy[:, 0], xy[:, 1]
        kept = (x >= 0) & (x <= size[0]) & (y >= 0) & (y <= size[1])
        if presented is not None:
            presented = presented[presented < self.num_frames]
            frame = indices_in(presented, self.num_frames)[self.frame]
            shown = replace(shown, num_frames=len(presented), frame=frame)
            kept &= shown.frame >= 0
        return shown.keep_observations(kept)

    def take(self, kept: Bools | Ints, offsets: Ints) -> Tracks:
        """Some of the observations, in tracks with these offsets.

        Args:
            kept: bool [num_observations] which are kept, or int64 [n] their indices.
            offsets: int64 [num_tracks + 1] index of the first kept observation of each track, and
                the number of kept observations.
        """
        # A position is indexed as one number of eight bytes: rows of two numbers take several times
        # as long.
        xy = np.ascontiguousarray(self.xy).view(np.uint64)[:, 0][kept]
        return replace(
            self,
            offsets=offsets,
            frame=self.frame[kept],
            xy=xy.view(np.float32).reshape(-1, 2),
            sigma=self.sigma[kept],
            confirmed=self.confirmed[kept],
        )


def build_tracks(
    motion: Iterable[FrameMotion],
    options: TrackOptions = TrackOptions(),
    progress: Progress = no_progress,
) -> Tracks:
    """Chain the motion of a video into point tracks.

    The motion of a block applies to each of its 4x4 units. A unit continues the track that it finds
    where its displacement leads in the referenced frame. The new observation is the sub-pixel
    position that the displacement moves exactly onto the track. A track also moves with its unit
    into a reference that is shown later. If several tracks lead to one cell, the longest is
    continued; a cell is a unit, or a part of a unit with `options.cell`. A unit without a track
    starts one at its centre. No cell holds two tracks, and no track is observed twice in a frame.

    Frames are chained in display order, and links to the nearest frame come first, so that a frame
    that was coded far ahead is reached in short steps. Frames that are never shown are chained
    through last. A unit without a motion vector moves like the units on both sides of it if these
    agree. Frames are consumed one by one. In addition to a few frames of motion, memory grows only
    with the observations.

    Args:
        motion: the coded frames of one video, in bitstream order.
        options: how to chain.
        progress: called after each coded frame with the stage "tracks" and the number of frames so
            far.

    Returns:
        Tracks of at least `options.min_length` shown frames, 4 if None, in the order of their
        seeds (display order of the frame, then raster order). If frames differ in size, positions
        are in pixels of the first shown frame.

    Raises:
        VideoError: no frame is shown.
        ValueError: the frames are not in bitstream order, or their arrays contradict
            each other.
        TypeError: an element is not a `FrameMotion`.

    Examples:
        >>> from colmap_av1 import TrackOptions, build_tracks, read_motion
        >>> tracks = build_tracks(read_motion("video.mp4"), TrackOptions(min_length=10))
        >>> tracks.num_frames, tracks.width, tracks.height
        (60, 640, 360)
        >>> print(tracks.lengths.min(), tracks.lengths.max())
        10 60
    """
    return build_tracks_and_ends(motion, options, progress)[0]


def build_tracks_and_ends(
    motion: Iterable[FrameMotion],
    options: TrackOptions,
    progress: Progress,
    *,
    frames: NDArray[np.int32] | None = None,
    tracks_per_sample: int = 0,
) -> tuple[Tracks, Tracks]:
    """Chain the motion of a video into point tracks, and sample their ends in all frames.

    Args:
        motion: see `build_tracks`, as the next three.
        options: how to chain.
        progress: called after each coded frame.
        frames: int32 [n] display indices of the frames whose observations are kept, which limits
            memory; None: all.
        tracks_per_sample: the ends of one in this many tracks are returned; 0: of none.

    Returns:
        The tracks, see `build_tracks`; with `frames`, without those that are observed in fewer than
        two of these frames. The first and the last observation of some tracks in all
        frames, including tracks that are not observed in two of the frames: one observation per
        track if both are the same.

    Raises:
        VideoError: see `build_tracks`.
        ValueError: see `build_tracks`.
    """
    core_options = _core_options(options)
    core_options.tracks_per_sample = tracks_per_sample
    if frames is not None:
        core_options.stored_frames = frames.tolist()
    builder = _core.TrackBuilder(core_options)
    for count, frame in enumerate(motion, start=1):
        if not isinstance(frame, FrameMotion):
            raise TypeError(
                f"build_tracks: motion gives {type(frame).__name__}: give frames of read_motion"
            )
        builder.add(frame)
        progress("tracks", count, None)
    tracks, ends = (
        Tracks(*arrays, confirmed=np.zeros(len(arrays[4]), dtype=np.bool_))
        for arrays in builder.finish()
    )
    give_back_free_memory()  # building needs as much memory again as the tracks
    if tracks.num_frames == 0:
        raise VideoError("the video shows no frame: give a video with at least one picture")
    return tracks, ends


def least_length(options: TrackOptions) -> int:
    """Smallest number of shown frames in which a track is observed."""
    return _MIN_LENGTH if options.min_length is None else options.min_length


def _joined_offsets(sets: Sequence[Tracks]) -> Ints:
    """Offsets of the tracks of several sets, one set after the other."""
    return np.cumsum(np.concatenate([[0], *(one.lengths for one in sets)]), dtype=np.int64)


def _core_options(options: TrackOptions) -> _core.TrackBuilderOptions:
    """The options of the C++ core, which counts in cells instead of pixels."""
    # The squares in which tracks start are not smaller than the cells that hold one track.
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

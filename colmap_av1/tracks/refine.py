"""Sub-pixel correction of tracks on decoded pictures."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_av1.errors import ImageError
from colmap_av1.options import DensityOptions, RefineOptions
from colmap_av1.tracks.selection import spread_observations
from colmap_av1.tracks.texture import texture_at
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.arrays import Bools, Floats, Ints

# Pixels around the window of a template: one for its gradients, two for the backward search.
_MARGIN = 3
_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 12, 0.01)
# A track that is not confirmed in more than this many frames gets a new template.
_MAX_MISSES = 3
# Largest mean difference of matching windows in grey levels, in addition to a share of their
# contrast.
_GREY_TOLERANCE = 2.0
# Largest forward-backward error in pixels.
_MAX_RETURN = 0.25
# A window with less texture confirms nothing: noise of one grey level would move its match by more
# than this many pixels.
_MAX_SOFTNESS = 0.15
# The logarithm of the variance of a match in px^2 is a constant plus a slope for each of two
# logarithms: of the error that the difference of the windows suggests, and of the variance of the
# bitstream's motion since the template. Fitted by examples/benchmarks/fit_trust.py.
_MATCH_CONSTANT, _MATCH_NOISE, _MATCH_PRIOR = 1.49, 1.17, 0.80
# Standard deviation in pixels that is added where there is texture but no match with the template:
# the point is occluded, or was followed wrongly.
_REFUSED_SIGMA = 0.7
# Density of the observations that are corrected for poses: more than a mapper or a bundle
# adjustment gets, because the observations for these are selected among them.
_SPREAD = DensityOptions(preset="sparse", max_tracks_per_image=2000, spacing=10.0)


def refine_tracks(
    tracks: Tracks,
    frames: Iterable[tuple[int, NDArray[np.uint8]]],
    options: RefineOptions,
    progress: Callable[[int], None] | None = None,
    *,
    expected: Bools | None = None,
) -> Tracks:
    """Correct track positions by Lucas-Kanade on the decoded pictures.

    A track whose first picture has texture gets a template, which is the picture around an earlier
    observation. An observation is searched for near the position to which the step in the bitstream
    leads: first with the template, which does not drift, then with the picture around the previous
    observation. If only the second search finds it, it becomes the new template. If neither finds
    it, it keeps the bitstream's step and its larger expected error, and is not marked as confirmed.
    So do all observations of a track without a template: templates that begin later are less
    accurate. No observation is removed.

    Frames are consumed one by one. In addition to the tracks, memory holds two pictures and one
    template for each track of a frame.

    Args:
        tracks: tracks of the whole video.
        frames: (frame number, picture) of the frames in display order, uint8 BGR
            [height, width, 3] or grey [height, width]. Observations in frames that are
            missing keep the bitstream's step.
        options: how to refine; `refine` is "lk".
        progress: called after each frame with the number of frames so far.
        expected: bool [num_observations] observations that are only predicted, not observed;
            None: none. If such an observation is not found, the picture around it is not used to
            search for others. The first observation of a track is never a predicted one.

    Returns:
        The same tracks and observations with corrected positions, their expected errors and
        which of them are confirmed.

    Raises:
        ImageError: a picture differs in size from the tracks' frames, or comes out of order.
    """
    state = RefinedTracks.start(tracks, options, expected)
    state.refine_all(frames, progress)
    return replace(
        tracks,
        xy=state.xy,
        sigma=np.sqrt(state.variance).astype(np.float32),
        confirmed=state.confirmed,
    )


def refine_spread_tracks(
    tracks: Tracks,
    frames: NDArray[np.int32],
    pictures: Iterable[tuple[int, NDArray[np.uint8]]],
    progress: Callable[[int], None] | None = None,
) -> Tracks:
    """Correct long tracks that are spread over every image, in the images only, by Lucas-Kanade.

    The corrected observations have smaller expected errors, so that a later selection prefers
    them.

    Args:
        tracks: tracks of the whole video.
        frames: int32 [n] frames that are images, ascending.
        pictures: (frame number, picture) of these frames, see `refine_tracks`.
        progress: called after each picture with the number of pictures so far.

    Returns:
        The same tracks and observations; those that are not corrected are unchanged.

    Raises:
        ImageError: as `refine_tracks`.
    """
    observation = np.flatnonzero(np.isin(tracks.frame, frames))
    seen = tracks.keep_frames(frames)
    if len(observation) == 0:
        return tracks
    spread = spread_observations(seen, _SPREAD)
    observation = observation[spread]
    refined = refine_tracks(
        seen.keep_observations(spread), pictures, RefineOptions(refine="lk"), progress
    )
    xy, sigma, confirmed = tracks.xy.copy(), tracks.sigma.copy(), tracks.confirmed.copy()
    xy[observation] = refined.xy
    sigma[observation] = refined.sigma
    confirmed[observation] = refined.confirmed
    return replace(tracks, xy=xy, sigma=sigma, confirmed=confirmed)


@dataclass
class RefinedTracks:
    """The state of every track after some of the frames.

    Attributes:
        tracks: the tracks before refinement.
        options: how to refine.
        track: int64 [num_observations] index of the track of each observation.
        is_first: bool [num_observations] the first observation of each track.
        is_last: bool [num_observations] the last observation of each track.
        is_located: bool [num_observations] observed or found, so that the picture there shows the
            track.
        step: float32 [num_observations, 2] the bitstream's motion from the previous observation.
        step_variance: float64 [num_observations] growth of the variance in this step.
        bitstream_variance: float64 [num_observations] variance before refinement.
        xy: float32 [num_observations, 2] corrected positions in pixels.
        variance: float64 [num_observations] their expected variance in px^2.
        confirmed: bool [num_observations], see `Tracks`.
        templates: the patches to find.
        last_image: the grey picture of the last frame; None before the first.
        last_frame: display index of this frame; -1 before the first.
    """

    tracks: Tracks
    options: RefineOptions
    track: Ints
    is_first: Bools
    is_last: Bools
    is_located: Bools
    step: NDArray[np.float32]
    step_variance: Floats
    bitstream_variance: Floats
    xy: NDArray[np.float32]
    variance: Floats
    confirmed: Bools
    templates: _Templates
    last_image: NDArray[np.uint8] | None = None
    last_frame: int = -1

    @classmethod
    def start(cls, tracks: Tracks, options: RefineOptions, expected: Bools | None) -> RefinedTracks:
        """The state before the first frame."""
        num_observations = tracks.num_observations
        is_first = np.zeros(num_observations, dtype=np.bool_)
        is_first[tracks.offsets[:-1]] = True
        is_last = np.zeros(num_observations, dtype=np.bool_)
        is_last[tracks.offsets[1:] - 1] = True
        variance = tracks.sigma.astype(np.float64) ** 2
        # The error may not grow in a step through hidden frames.
        step_variance = np.maximum(np.diff(variance, prepend=0.0), 0.0)
        alive = np.bincount(tracks.frame[is_first], minlength=tracks.num_frames + 1)
        alive[1:] -= np.bincount(tracks.frame[is_last], minlength=tracks.num_frames + 1)[:-1]
        return cls(
            tracks=tracks,
            options=options,
            track=tracks.track,
            is_first=is_first,
            is_last=is_last,
            is_located=np.ones(num_observations, np.bool_) if expected is None else ~expected,
            step=np.diff(tracks.xy, axis=0, prepend=np.zeros((1, 2), np.float32)),
            step_variance=step_variance,
            bitstream_variance=variance,
            xy=tracks.xy.copy(),
            variance=variance.copy(),
            confirmed=np.zeros(num_observations, dtype=np.bool_),
            templates=_Templates.empty(tracks, options, int(np.cumsum(alive).max(initial=0))),
        )

    def refine_all(
        self,
        frames: Iterable[tuple[int, NDArray[np.uint8]]],
        progress: Callable[[int], None] | None = None,
    ) -> None:
        """Correct the observations in all frames, see `refine_tracks`."""
        tracks = self.tracks
        by_frame = tracks.by_frame()
        next_frame = 0
        for count, (index, image) in enumerate(frames, start=1):
            if index < next_frame or index >= tracks.num_frames:
                raise ImageError(f"frame {index} comes out of order: give frames in display order")
            if image.shape[:2] != (tracks.height, tracks.width):
                raise ImageError(
                    f"frame {index} is {image.shape[1]}x{image.shape[0]}, the tracks are of "
                    f"{tracks.width}x{tracks.height}: re-encode the video at one size"
                )
            for missing in range(next_frame, index):
                self.skip(by_frame[missing])
            grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
            self.refine(by_frame[index], grey)
            next_frame = index + 1
            if progress is not None:
                progress(count)
        for missing in range(next_frame, tracks.num_frames):
            self.skip(by_frame[missing])

    def skip(self, seen: Ints) -> None:
        """Move the observations in a frame without a picture by the bitstream's steps."""
        later = seen[~self.is_first[seen]]
        self._follow(later)
        self.templates.drop(self.track[seen[self.is_last[seen]]])

    def refine(self, seen: Ints, image: NDArray[np.uint8]) -> None:
        """Correct the observations in the frame whose picture is `image`."""
        frame = int(self.tracks.frame[seen[0]]) if len(seen) else -1
        later = seen[~self.is_first[seen]]
        self._follow(later)
        templates = self.templates
        canvas = templates.canvas(image)

        # Search with the template.
        tracked = later[templates.slot[self.track[later]] >= 0]
        track = self.track[tracked]
        found = _match(
            templates.atlas,
            canvas,
            templates.point[track],
            self.xy[tracked],
            size=image.shape[::-1],
            options=self.options,
        )
        sure = self.accept(tracked, found, templates.source[track])
        templates.misses[track[sure]] = 0
        templates.misses[track[~sure]] += 1

        # Search with the picture of the previous observation; what is found becomes the template.
        lost = tracked[~sure]
        fresh = np.empty(0, dtype=np.int64)
        if self.last_image is not None:
            lost = lost[
                (self.tracks.frame[lost - 1] == self.last_frame) & self.is_located[lost - 1]
            ]
            track = self.track[lost]
            found = _match(
                self.last_image,
                image,
                self.xy[lost - 1] - 0.5,
                self.xy[lost],
                size=image.shape[::-1],
                options=self.options,
            )
            sure = self.accept(lost, found, lost - 1)
            fresh = lost[sure]
            self.variance[lost[~sure]] += _REFUSED_SIGMA**2

        given_up = tracked[templates.misses[self.track[tracked]] > _MAX_MISSES]
        given_up = given_up[self.is_located[given_up]]
        renewed = np.concatenate([seen[self.is_first[seen]], np.union1d(fresh, given_up)])
        renewed = renewed[~self.is_last[renewed]]
        templates.drop(self.track[seen[self.is_last[seen]]])
        templates.take(image, self.track[renewed], self.xy[renewed])
        templates.source[self.track[renewed]] = renewed
        self.last_image, self.last_frame = image, frame

    def _follow(self, later: Ints) -> None:
        """Predict observations from the previous ones by the bitstream's steps."""
        limits = np.array([self.tracks.width, self.tracks.height], np.float32)
        self.xy[later] = np.clip(self.xy[later - 1] + self.step[later], 0, limits)
        self.variance[later] = self.variance[later - 1] + self.step_variance[later]

    def accept(
        self,
        observations: Ints,
        found: _Matches,
        source: Ints,
    ) -> Bools:
        """Use the matches that are good enough, and return which ones are.

        Args:
            observations: int64 [n].
            found: their matches.
            source: int64 [n] the observations whose pictures were searched for.
        """
        track = self.track[observations]
        contrast = self.templates.contrast[track]
        tolerance = _GREY_TOLERANCE + self.options.refine_difference * contrast
        sure = found.ok & (found.difference <= tolerance)
        taken = observations[sure]
        noise = found.difference[sure] * self.templates.softness[track[sure]]
        self.xy[taken] = found.position[sure]
        since = self.bitstream_variance[taken] - self.bitstream_variance[source[sure]]
        self.variance[taken] = self.variance[source[sure]] + _match_variance(noise, since)
        self.confirmed[taken] = True
        self.is_located[taken] = True
        return sure


@dataclass
class _Templates:
    """The pictures around one earlier observation of each live track, as tiles of one picture.

    With all tiles in one picture, the atlas, a single call of Lucas-Kanade searches for all tracks,
    although their templates come from different frames.
    """

    tile: int  # width of a tile in pixels
    columns: int
    atlas: NDArray[np.uint8]
    free: Ints  # free slots, a stack
    num_free: int
    slot: Ints  # of each track; -1: none
    point: NDArray[np.float32]  # of each track in the atlas; the first pixel's centre is (0, 0)
    source: Ints  # the observation of each track that its template shows
    contrast: NDArray[np.float32]  # mean absolute deviation in grey levels
    softness: NDArray[np.float32]  # matching error in pixels for noise of one grey level
    misses: NDArray[np.int32]  # frames without a confirmation

    @classmethod
    def empty(cls, tracks: Tracks, options: RefineOptions, capacity: int) -> _Templates:
        tile = options.refine_window + 2 * _MARGIN
        columns = max(1, tracks.width // tile)
        height = max(tracks.height, tile * math.ceil(max(capacity, 1) / columns))
        num_tracks = tracks.num_tracks
        return cls(
            tile=tile,
            columns=columns,
            atlas=np.zeros((height, max(tracks.width, tile)), dtype=np.uint8),
            free=np.arange(capacity)[::-1].copy(),
            num_free=capacity,
            slot=np.full(num_tracks, -1),
            point=np.zeros((num_tracks, 2), dtype=np.float32),
            source=np.full(num_tracks, -1),
            contrast=np.zeros(num_tracks, dtype=np.float32),
            softness=np.zeros(num_tracks, dtype=np.float32),
            misses=np.zeros(num_tracks, dtype=np.int32),
        )

    def canvas(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Pad the picture to the size of the atlas: Lucas-Kanade needs two pictures of one size."""
        bottom = self.atlas.shape[0] - image.shape[0]
        right = self.atlas.shape[1] - image.shape[1]
        framed = cv2.copyMakeBorder(image, 0, bottom, 0, right, cv2.BORDER_REPLICATE)
        return np.asarray(framed, dtype=np.uint8)

    def drop(self, track: Ints) -> None:
        """Release the tracks' templates."""
        track = track[self.slot[track] >= 0]
        self.free[self.num_free : self.num_free + len(track)] = self.slot[track]
        self.num_free += len(track)
        self.slot[track] = -1

    def take(
        self,
        image: NDArray[np.uint8],
        track: Ints,
        xy: NDArray[np.float32],
    ) -> None:
        """Store the picture around positions as templates of tracks, if there is texture."""
        self.drop(track)
        if len(track) == 0:
            return
        half = self.tile // 2
        corner = np.floor(xy).astype(np.int64) - half
        last = np.array(image.shape[::-1]) - self.tile
        centre = np.clip(corner + half, 0, np.array(image.shape[::-1]) - 1)
        softness, contrast = texture_at(image, centre, self.tile - 2 * _MARGIN)
        usable = ((corner >= 0) & (corner <= last)).all(axis=1) & (softness <= _MAX_SOFTNESS)
        track, xy, corner = track[usable], xy[usable], corner[usable]
        self.num_free -= len(track)
        slot = self.free[self.num_free : self.num_free + len(track)]
        left = self.tile * (slot % self.columns)
        top = self.tile * (slot // self.columns)
        offset = np.arange(self.tile)
        self.atlas[(top[:, None] + offset)[:, :, None], (left[:, None] + offset)[:, None, :]] = (
            image[(corner[:, 1:] + offset)[:, :, None], (corner[:, :1] + offset)[:, None, :]]
        )
        self.slot[track] = slot
        self.point[track] = np.stack([left, top], axis=1) + (xy - corner) - 0.5
        self.softness[track] = softness[usable]
        self.contrast[track] = contrast[usable]
        self.misses[track] = 0


@dataclass(frozen=True)
class _Matches:
    ok: Bools
    position: NDArray[np.float32]  # [n, 2], origin at the picture's corner
    difference: NDArray[np.float32]  # [n] mean absolute difference in grey levels


def _match(
    source: NDArray[np.uint8],
    target: NDArray[np.uint8],
    point: NDArray[np.float32],
    expected: NDArray[np.float32],
    *,
    size: tuple[int, ...],
    options: RefineOptions,
) -> _Matches:
    """Search `target` near expected positions for what `source` shows at some points.

    Args:
        source: picture with the points.
        target: picture of the same size, which may have a margin on the right and at the bottom.
        point: float32 [n, 2] in source; the first pixel's centre is (0, 0).
        expected: float32 [n, 2] in target; the origin is the picture's corner.
        size: (width, height) of the target without its margin.
        options: window size and largest correction.
    """
    if len(point) == 0:
        none = np.empty(0, np.float32)
        return _Matches(none.astype(np.bool_), none.reshape(0, 2), none)
    how: dict[str, Any] = {
        "winSize": (options.refine_window, options.refine_window),
        "maxLevel": 0,
        "criteria": _CRITERIA,
        "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
        "minEigThreshold": 1e-6,
    }
    start = expected - np.float32(0.5)
    found, seen, difference = cv2.calcOpticalFlowPyrLK(source, target, point, start.copy(), **how)
    back, seen_back, _ = cv2.calcOpticalFlowPyrLK(target, source, found, point.copy(), **how)
    ok = (seen.ravel() == 1) & (seen_back.ravel() == 1)
    ok &= np.abs(back - point).max(axis=1) <= _MAX_RETURN
    ok &= np.abs(found - start).max(axis=1) <= options.refine_move
    found += np.float32(0.5)
    ok &= ((found >= 0) & (found < size)).all(axis=1)
    return _Matches(ok, found, np.where(ok, difference.ravel(), np.inf))


def _match_variance(noise: NDArray[np.float32], prior: Floats) -> Floats:
    """Expected variance in px^2 of matches.

    Args:
        noise: error in pixels that the difference of the windows would cause if it were noise.
        prior: variance in px^2 of the bitstream's motion over the same frames.
    """
    exponent = _MATCH_CONSTANT + _MATCH_NOISE * np.log(0.02 + noise)
    exponent += _MATCH_PRIOR * np.log(0.01 + np.maximum(prior, 0.0))
    return np.asarray(np.exp(exponent), np.float64)

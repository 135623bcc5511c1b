"""Select tracks: few accurate ones for poses, more for maps, all for dense clouds."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from colmap_av1 import _core
from colmap_av1.options import DensityOptions
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.arrays import Bools
from colmap_av1.util.grouping import groups


@dataclass(frozen=True)
class _Limits:
    """The limits to apply, see `DensityOptions`; 0: no limit."""

    max_tracks_per_image: int
    spacing: float
    min_images: int
    max_sigma: float
    wide_tracks: int


# max_sigma is for images of every frame. For images that are n frames apart it is multiplied by
# sqrt(n), because errors grow from step to step.
PRESETS = {
    # Poses need wide baselines. Points do not, and long tracks slow down a mapper.
    "sparse": _Limits(1500, spacing=12.0, min_images=3, max_sigma=0.8, wide_tracks=1000),
    "default": _Limits(3500, spacing=7.5, min_images=3, max_sigma=0.8, wide_tracks=300),
    "dense": _Limits(0, spacing=0.0, min_images=1, max_sigma=0.0, wide_tracks=0),
}

# Error in pixels that is added to every observation. It keeps one accurate observation from
# outweighing many good ones.
_SIGMA_FLOOR = 0.3
# How much an observation constrains the cameras depends on its motion relative to its error, so one
# that moved far may be less accurate. Its error is at most this share of the distance.
_MAX_ERROR_SHARE = 1 / 30
# An observation has a wide baseline if it moved at least this share of the largest distances.
_WIDE = 0.8


def select_tracks(tracks: Tracks, options: DensityOptions = DensityOptions()) -> Tracks:
    """Select tracks that are long, accurate and spread over every image.

    First, observations are removed whose error, relative to the first observation of their track,
    exceeds `max_sigma`. Observations with a wide baseline may have a larger error, up to a
    thirtieth of the distance from the first observation. In each image, a baseline is wide that is
    nearly as long as the longest ones. The `wide_tracks` observations with a wide baseline and the
    smallest error relative to the distance are kept, and all others of the image that are as
    accurate.

    Then tracks are selected, the best first. The weight of a track is the sum of the inverse
    expected variances of its observations. A track is selected if at least half of its observations
    lie in images that are not full, and there in cells of width `spacing` without a better track.
    It loses its observations in full images.

    Args:
        tracks: tracks of the whole video.
        options: how many to select.

    Returns:
        The selected tracks in the same order, each with at least `min_images` observations. The
        same object if nothing is removed.
    """
    limits = _limits_of(options)
    if limits.min_images <= 1 and not (
        limits.max_sigma or limits.spacing or limits.max_tracks_per_image
    ):
        return tracks
    variance = _variance_since_first(tracks)
    if limits.max_sigma > 0:
        max_variance = limits.max_sigma**2
        if options.max_sigma is None:
            max_variance *= _frames_between_images(tracks)
        distance = _distance_since_first(tracks)
        share = _error_shares(tracks, np.sqrt(variance), distance, limits.wide_tracks)
        # Computed in place, here and below, because these arrays are the largest of a run.
        distance *= share[tracks.frame]
        distance *= distance
        sure = variance <= np.maximum(np.float32(max_variance), distance, out=distance)
        del distance
        tracks, variance = tracks.keep_observations(sure), variance[sure]
    return tracks.keep_observations(_spread(tracks, variance, limits))


def spread_observations(tracks: Tracks, options: DensityOptions) -> Bools:
    """Which observations `select_tracks` would keep without limits on errors: bool [n]."""
    return _spread(tracks, _variance_since_first(tracks), _limits_of(options))


def _limits_of(options: DensityOptions) -> _Limits:
    """The limits of the preset, replaced by those that the options give."""
    names = [field.name for field in fields(_Limits)]
    given = {n: getattr(options, n) for n in names if getattr(options, n) is not None}
    return replace(PRESETS[options.preset], **given)


def _spread(tracks: Tracks, variance: NDArray[np.float32], limits: _Limits) -> Bools:
    """Which observations to keep so that tracks are long, accurate and spread: bool [n].

    Args:
        tracks: any tracks.
        variance: float32 [n] variance of each observation in px^2; overwritten.
        limits: how many tracks to keep, and how far apart.
    """
    variance += _SIGMA_FLOOR**2
    weight = np.reciprocal(variance, out=variance)
    score = np.add.reduceat(weight, tracks.offsets[:-1])
    kept = _core.select_spread(
        num_frames=tracks.num_frames,
        offsets=tracks.offsets,
        frame=tracks.frame,
        xy=tracks.xy,
        order=np.argsort(-score, kind="stable"),
        spacing=limits.spacing,
        max_tracks_per_image=limits.max_tracks_per_image,
        min_length=limits.min_images,
    )
    return kept.view(np.bool_)


def _variance_since_first(tracks: Tracks) -> NDArray[np.float32]:
    """Variance of each observation relative to the first one of its track, in px^2."""
    variance = tracks.sigma * tracks.sigma
    variance -= np.repeat(variance[tracks.offsets[:-1]], tracks.lengths)
    np.maximum(variance, 0, out=variance)
    return variance


def _distance_since_first(tracks: Tracks) -> NDArray[np.float32]:
    """Distance of each observation to the first one of its track, in px."""
    squared = np.zeros(len(tracks.xy), dtype=np.float32)
    for along in (tracks.xy[:, 0], tracks.xy[:, 1]):
        step = np.repeat(along[tracks.offsets[:-1]], tracks.lengths)
        np.subtract(along, step, out=step)
        squared += np.multiply(step, step, out=step)
    np.sqrt(squared, out=squared)
    return squared


def _error_shares(
    tracks: Tracks, error: NDArray[np.float32], distance: NDArray[np.float32], wide_tracks: int
) -> NDArray[np.float32]:
    """Largest error of wide baselines in each frame, as a share of the distance: [num_frames]."""
    if wide_tracks == 0:
        return np.zeros(tracks.num_frames, dtype=np.float32)
    shares = np.full(tracks.num_frames, _MAX_ERROR_SHARE, dtype=np.float32)
    usable = np.flatnonzero(error <= _MAX_ERROR_SHARE * distance)
    for frame, rows in enumerate(groups(tracks.frame[usable], tracks.num_frames)):
        own = usable[rows]
        if len(own) <= wide_tracks:
            continue
        farthest = np.partition(distance[own], -wide_tracks)[-wide_tracks]
        wide = own[(distance[own] >= _WIDE * farthest) & (distance[own] > 0)]
        if len(wide) > wide_tracks:
            share = error[wide] / distance[wide]
            shares[frame] = np.partition(share, wide_tracks - 1)[wide_tracks - 1]
    return shares


def _frames_between_images(tracks: Tracks) -> float:
    frames = np.flatnonzero(np.bincount(tracks.frame))
    return float(np.median(np.diff(frames))) if len(frames) > 1 else 1.0

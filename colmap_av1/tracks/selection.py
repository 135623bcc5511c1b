"""Selection of tracks: few accurate ones for poses, more for maps, all for dense clouds."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from colmap_av1 import _core
from colmap_av1.options import DensityOptions
from colmap_av1.tracks.tracks import Tracks, order_by_frame


@dataclass(frozen=True)
class _Limits:
    """The limits in force, see `DensityOptions`; 0 is none."""

    max_tracks_per_image: int
    spacing: float
    min_images: int
    max_sigma: float
    wide_tracks: int


# max_sigma is for images of every frame; where images lie n frames apart it is sqrt(n) times that,
# as errors grow from step to step.
PRESETS = {
    # Poses need wide baselines; points do not, and long tracks take a mapper's time.
    "sparse": _Limits(1500, spacing=12.0, min_images=3, max_sigma=0.8, wide_tracks=1000),
    "default": _Limits(3500, spacing=7.5, min_images=3, max_sigma=0.8, wide_tracks=300),
    "dense": _Limits(0, spacing=0.0, min_images=1, max_sigma=0.0, wide_tracks=0),
}

# Error in pixels that an observation has however accurate its motion is; keeps one sure
# observation from outweighing many good ones.
_SIGMA_FLOOR = 0.3
# What an observation says of the cameras is its motion relative to its error: one that moved far
# may be less accurate, up to this share of the distance.
_MAX_ERROR_SHARE = 1 / 30
# An observation is wide that moved at least this share of what those that moved farthest did.
_WIDE = 0.8


def select_tracks(tracks: Tracks, options: DensityOptions | None = None) -> Tracks:
    """Choose tracks that are long, accurate and spread over every image.

    Observations with an error above `max_sigma`, relative to the first one of their track, are left
    out but for those with a wide baseline: of each image, `wide_tracks` that moved nearly as far
    from there as any of its do, those with the least error for their distance, and all that are as
    accurate; where the error is a thirtieth of the distance or less. Then tracks are taken best
    first, the weight of an observation being its inverse expected variance. One is used where at
    least half of its observations lie in images that are not full, and there in cells, `spacing`
    wide, that no better track lies in; it loses the observations in full images.

    Args:
        tracks: tracks of the whole video.
        options: how many to use; the defaults of DensityOptions if None.

    Returns:
        The chosen tracks in their former order, each with `min_images` observations or more.
        The same object where nothing is left out.
    """
    options = options if options is not None else DensityOptions()
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
        way = _way_since_first(tracks)
        share = _error_shares(tracks, np.sqrt(variance), way, limits.wide_tracks)
        # In place, here and below: these arrays are the largest of a whole run.
        way *= share[tracks.frame]
        way *= way
        sure = variance <= np.maximum(np.float32(max_variance), way, out=way)
        del way
        tracks, variance = tracks.keep_observations(sure), variance[sure]
    return tracks.keep_observations(_spread(tracks, variance, limits))


def spread_observations(tracks: Tracks, options: DensityOptions) -> NDArray[np.bool_]:
    """Which observations `select_tracks` keeps where errors are not limited: bool [n]."""
    return _spread(tracks, _variance_since_first(tracks), _limits_of(options))


def _limits_of(options: DensityOptions) -> _Limits:
    """The limits of the preset, with those of the options in place of its own."""
    names = [field.name for field in fields(_Limits)]
    given = {n: getattr(options, n) for n in names if getattr(options, n) is not None}
    return replace(PRESETS[options.preset], **given)


def _spread(tracks: Tracks, variance: NDArray[np.float32], limits: _Limits) -> NDArray[np.bool_]:
    """Which observations are kept so that tracks are long, accurate and spread; bool [n].

    Args:
        tracks: any tracks.
        variance: float32 [n] variance of each observation in px^2, overwritten.
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
    """Variance of each observation relative to the first kept one of its track, in px^2."""
    variance = tracks.sigma * tracks.sigma
    variance -= np.repeat(variance[tracks.offsets[:-1]], tracks.lengths)
    np.maximum(variance, 0, out=variance)
    return variance


def _way_since_first(tracks: Tracks) -> NDArray[np.float32]:
    """Distance of each observation to the first kept one of its track, in px."""
    squared = np.zeros(len(tracks.xy), dtype=np.float32)
    for along in (tracks.xy[:, 0], tracks.xy[:, 1]):
        step = np.repeat(along[tracks.offsets[:-1]], tracks.lengths)
        np.subtract(along, step, out=step)
        squared += np.multiply(step, step, out=step)
    np.sqrt(squared, out=squared)
    return squared


def _error_shares(
    tracks: Tracks, error: NDArray[np.float32], way: NDArray[np.float32], wide_tracks: int
) -> NDArray[np.float32]:
    """Error allowed in each frame for wide baselines, as a share of the motion, [num_frames]."""
    if wide_tracks == 0:
        return np.zeros(tracks.num_frames, dtype=np.float32)
    shares = np.full(tracks.num_frames, _MAX_ERROR_SHARE, dtype=np.float32)
    usable = np.flatnonzero(error <= _MAX_ERROR_SHARE * way)
    usable = usable[order_by_frame(tracks.frame[usable], tracks.num_frames)]
    bounds = np.searchsorted(tracks.frame[usable], np.arange(tracks.num_frames + 1))
    for frame, (start, stop) in enumerate(pairwise(bounds)):
        own = usable[start:stop]
        if len(own) <= wide_tracks:
            continue
        farthest = np.partition(way[own], -wide_tracks)[-wide_tracks]
        wide = own[(way[own] >= _WIDE * farthest) & (way[own] > 0)]
        if len(wide) > wide_tracks:
            share = error[wide] / way[wide]
            shares[frame] = np.partition(share, wide_tracks - 1)[wide_tracks - 1]
    return shares


def _frames_between_images(tracks: Tracks) -> float:
    frames = np.flatnonzero(np.bincount(tracks.frame))
    return float(np.median(np.diff(frames))) if len(frames) > 1 else 1.0

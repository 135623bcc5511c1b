"""Which tracks are used: few and sure ones for poses, more for maps, all for dense clouds."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from colmap_av1 import _core
from colmap_av1.errors import OptionError
from colmap_av1.options import DensityOptions
from colmap_av1.tracks import Tracks, keep_observations

# Error in pixels that an observation has however sure its motion is; keeps one sure
# observation from outweighing many good ones.
_SIGMA_FLOOR = 0.3
# What an observation tells of the cameras is its motion beside its error: one that moved far may
# be less sure, as the wide views that poses need are where the camera moves quickly.
_MAX_ERROR_SHARE = 1 / 30


@dataclass(frozen=True)
class _Limits:
    """The limits in force; 0 is none."""

    max_tracks_per_image: int
    spacing: float
    min_length: int
    max_sigma: float


# max_sigma is for images of every frame; where images lie n frames apart it is sqrt(n) times that,
# as errors grow from step to step.
_PRESETS = {
    "sparse": _Limits(max_tracks_per_image=1500, spacing=12.0, min_length=3, max_sigma=0.8),
    "default": _Limits(max_tracks_per_image=3000, spacing=8.0, min_length=3, max_sigma=0.8),
    "dense": _Limits(max_tracks_per_image=0, spacing=0.0, min_length=1, max_sigma=0.0),
}


def select_tracks(tracks: Tracks, options: DensityOptions | None = None) -> Tracks:
    """Choose tracks that are long, sure and spread over every image.

    Observations less sure than `max_sigma`, against the first one of their track, are left out
    unless the error is a thirtieth of the way from there or less. Then tracks are taken best
    first, the weight of an observation being its inverse expected variance. One is used where at
    least half of its observations lie in images that are not full, and there in cells, `spacing`
    wide, that no better track lies in; it loses the observations in full images.

    Args:
        tracks: tracks of the whole video.
        options: how many to use; the defaults of DensityOptions if None.

    Returns:
        The chosen tracks in their former order, each with `min_length` observations or more.
        The same object where nothing is left out.

    Raises:
        OptionError: an option has a value that cannot work.
    """
    options = options if options is not None else DensityOptions()
    limits = _limits(options)
    variance = _variance_since_first(tracks)
    if limits.max_sigma > 0:
        max_variance = limits.max_sigma**2
        if options.max_sigma is None:
            max_variance *= _frames_between_images(tracks)
        allowed = np.maximum(max_variance, _MAX_ERROR_SHARE**2 * _squared_way_since_first(tracks))
        sure = variance <= allowed
        tracks, variance = keep_observations(tracks, sure), variance[sure]
    weight = 1.0 / (_SIGMA_FLOOR**2 + variance)
    total = np.concatenate([[0.0], np.cumsum(weight)])
    score = total[tracks.offsets[1:]] - total[tracks.offsets[:-1]]
    kept = _core.select_spread(
        num_frames=tracks.num_frames,
        offsets=tracks.offsets,
        frame=tracks.frame,
        xy=tracks.xy,
        order=np.argsort(-score, kind="stable"),
        spacing=limits.spacing,
        max_tracks_per_image=limits.max_tracks_per_image,
        min_length=limits.min_length,
    )
    return keep_observations(tracks, kept.astype(np.bool_))


def _variance_since_first(tracks: Tracks) -> NDArray[np.float64]:
    """Variance of each observation against the first of its track that is left, in px^2."""
    variance = tracks.sigma.astype(np.float64) ** 2
    first = np.repeat(variance[tracks.offsets[:-1]], np.diff(tracks.offsets))
    return np.asarray(np.maximum(variance - first, 0.0), np.float64)


def _squared_way_since_first(tracks: Tracks) -> NDArray[np.float64]:
    """Squared distance of each observation to the first of its track that is left, in px^2."""
    first = np.repeat(tracks.xy[tracks.offsets[:-1]], np.diff(tracks.offsets), axis=0)
    return np.asarray(((tracks.xy - first).astype(np.float64) ** 2).sum(1), np.float64)


def _frames_between_images(tracks: Tracks) -> float:
    frames = np.unique(tracks.frame)
    return float(np.median(np.diff(frames))) if len(frames) > 1 else 1.0


def _limits(options: DensityOptions) -> _Limits:
    if options.preset not in _PRESETS:
        raise OptionError(f"preset is {options.preset!r}: give 'sparse', 'default' or 'dense'")
    names = ("max_tracks_per_image", "spacing", "min_length", "max_sigma")
    given = {n: getattr(options, n) for n in names if getattr(options, n) is not None}
    for name, value in given.items():
        if not 0 <= value < math.inf:
            raise OptionError(f"{name} is {value}: give 0 (no limit) or more")
    return replace(_PRESETS[options.preset], **given)

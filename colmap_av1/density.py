"""Which tracks are used: few and sure ones for poses, more for maps, all for dense clouds."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from colmap_av1 import _core
from colmap_av1.errors import OptionError
from colmap_av1.options import DensityOptions
from colmap_av1.tracks import Tracks, keep_observations

# Error in pixels that an observation has however sure its motion is; keeps one sure
# observation from outweighing many good ones.
_SIGMA_FLOOR = 0.3


@dataclass(frozen=True)
class _Limits:
    """The limits in force; 0 is none."""

    max_tracks_per_image: int
    spacing: float
    min_length: int
    max_sigma: float


_PRESETS = {
    "sparse": _Limits(max_tracks_per_image=1500, spacing=12.0, min_length=4, max_sigma=0.8),
    "default": _Limits(max_tracks_per_image=4000, spacing=8.0, min_length=4, max_sigma=1.0),
    "dense": _Limits(max_tracks_per_image=0, spacing=0.0, min_length=1, max_sigma=0.0),
}


def select_tracks(tracks: Tracks, options: DensityOptions | None = None) -> Tracks:
    """Choose tracks that are long, sure and spread over every image.

    Observations less sure than `max_sigma` go first. Then tracks are taken best first, the
    weight of an observation being its inverse expected variance. One is used where at least
    half of its observations lie in images that are not full, and there in cells, `spacing`
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
    limits = _limits(options if options is not None else DensityOptions())
    if limits.max_sigma > 0:
        tracks = keep_observations(tracks, tracks.sigma <= limits.max_sigma)
    weight = 1.0 / (_SIGMA_FLOOR**2 + tracks.sigma.astype(np.float64) ** 2)
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


def _limits(options: DensityOptions) -> _Limits:
    if options.preset not in _PRESETS:
        raise OptionError(f"preset is {options.preset!r}: give 'sparse', 'default' or 'dense'")
    names = ("max_tracks_per_image", "spacing", "min_length", "max_sigma")
    given = {n: getattr(options, n) for n in names if getattr(options, n) is not None}
    for name, value in given.items():
        if not 0 <= value < math.inf:
            raise OptionError(f"{name} is {value}: give 0 (no limit) or more")
    return replace(_PRESETS[options.preset], **given)

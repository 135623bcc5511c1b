"""Sub-pixel correction of few tracks in few pictures: those that poses are estimated from."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from colmap_av1.options import DensityOptions, RefineOptions
from colmap_av1.tracks.refine import refine_tracks
from colmap_av1.tracks.selection import spread_observations
from colmap_av1.tracks.tracks import Tracks

# More than a mapper or a bundle adjustment is given: these choose anew among them.
_SPREAD = DensityOptions(preset="sparse", max_tracks_per_image=2000, spacing=10.0, max_sigma=0.0)
_LK = RefineOptions(refine="lk")


def refine_spread_tracks(
    tracks: Tracks,
    frames: NDArray[np.int32],
    pictures: Iterable[tuple[int, NDArray[np.uint8]]],
    progress: Callable[[int], None] | None = None,
) -> Tracks:
    """Correct long tracks, spread over every image, in these images by Lucas-Kanade.

    The corrected observations have smaller expected errors, so that a later selection prefers
    them.

    Args:
        tracks: tracks of the whole video.
        frames: int32 [n] frames that are images, ascending.
        pictures: (display index, picture) of these frames, see `refine_tracks`.
        progress: called after each picture with the number of pictures so far.

    Returns:
        The same tracks and observations; those that are not corrected are as they were.

    Raises:
        ImageError: as `refine_tracks`.
    """
    in_image = np.zeros(tracks.num_frames, dtype=np.bool_)
    in_image[frames] = True
    observation = np.flatnonzero(in_image[tracks.frame])
    seen = tracks.keep_observations(in_image[tracks.frame])
    if len(observation) == 0:
        return tracks
    spread = spread_observations(seen, _SPREAD)
    observation = observation[spread]
    refined = refine_tracks(seen.keep_observations(spread), pictures, _LK, progress)
    xy, sigma, confirmed = tracks.xy.copy(), tracks.sigma.copy(), tracks.confirmed.copy()
    xy[observation] = refined.xy
    sigma[observation] = refined.sigma
    confirmed[observation] = refined.confirmed
    return replace(tracks, xy=xy, sigma=sigma, confirmed=confirmed)

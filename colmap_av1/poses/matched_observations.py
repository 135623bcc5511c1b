"""Choose the observations of tracks that become keypoints for a mapper.

The time of a mapper grows with the number of observations. A few long tracks connect the images.
The others only have to become points, for which three observations suffice.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from colmap_av1.options import DensityOptions
from colmap_av1.tracks.selection import spread_observations
from colmap_av1.tracks.tracks import Tracks

# The longest and most accurate tracks, up to 150 per image, keep all observations. With more of
# them, models are not more accurate, and the mapper is slower.
_WHOLE = DensityOptions(
    preset="sparse", max_tracks_per_image=150, spacing=8.0, min_images=3, max_sigma=0.0
)
# So do corners with up to this number of observations, as where the camera moves fast, and corners
# that are seen again after more than this number of images. There, few tracks connect the images.
_SHORT, _REVISITED = 8, 10
# The others keep three observations: the first one, and those half and all of one of these spans
# later, in images. Pairs at such distances are matched.
SPANS = (2, 4, 6, 8, 10, 12, 16, 20, 24, 32, 40, 48, 64, 80, 96, 128)
NUM_OBSERVATIONS = 3
# Largest number of keypoints per image from tracks with three observations, by the density preset:
# this share of the SIFT features of a picture, and this number. With the default preset, a mapper
# makes at least 1.2 times as many points as from SIFT, whose features give 3 to 8 points per
# hundred.
_THREE_OBSERVATIONS = {"sparse": (0.14, 500), "default": (0.28, 1050)}


def matched_observations(
    tracks: Tracks,
    frames: NDArray[np.int32],
    is_corner: NDArray[np.bool_],
    is_whole: NDArray[np.bool_],
    limits: DensityOptions,
) -> NDArray[np.bool_]:
    """Choose the observations that are matched: all of some tracks, three of the others.

    Args:
        tracks: tracks with three or more observations.
        frames: int32 [num_images] the frames of all images, ascending.
        is_corner: bool [num_tracks] which tracks are corners of the pictures or SIFT links. The
            others are motion tracks.
        is_whole: bool [num_tracks] tracks that keep all observations in any case.
        limits: limits of the number of tracks that keep three observations, see
            `limits_of_density`.

    Returns:
        bool [num_observations].
    """
    view = np.searchsorted(frames, tracks.frame)
    kept = spread_observations(tracks, _WHOLE)
    needed = is_whole | (is_corner & _are_needed(tracks, view))
    kept |= np.repeat(needed, tracks.lengths)
    is_matched = np.add.reduceat(kept, tracks.offsets[:-1]) > 0
    few = _first_middle_last(tracks, view)
    few[np.repeat(is_matched, tracks.lengths)] = False
    few[few] = spread_observations(tracks.keep_observations(few), limits)
    return np.asarray(kept | few)


def limits_of_density(density: DensityOptions, num_features: Callable[[], float]) -> DensityOptions:
    """Limits of the number of tracks that keep three observations.

    Args:
        density: the density that is asked for.
        num_features: counts the SIFT features of a picture; called if the limits depend on it.
    """
    most = density.max_tracks_per_image
    if most is None:
        most = 0
        if density.preset in _THREE_OBSERVATIONS:
            share, limit = _THREE_OBSERVATIONS[density.preset]
            most = min(limit, round(share * num_features()))
    return replace(density, max_tracks_per_image=most, min_images=NUM_OBSERVATIONS)


def _are_needed(tracks: Tracks, view: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which tracks are short or see a place again, bool [num_tracks].

    Args:
        tracks: the tracks.
        view: int64 [num_observations] index of the image of each observation.
    """
    skipped = np.diff(view, prepend=view[:1])
    skipped[tracks.offsets[:-1]] = 0
    farthest = np.maximum.reduceat(skipped, tracks.offsets[:-1])
    return np.asarray((tracks.lengths <= _SHORT) | (farthest > _REVISITED))


def _first_middle_last(tracks: Tracks, view: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Choose three observations of each track at distances at which pairs are matched.

    Args:
        tracks: tracks with three or more observations.
        view: int64 [num_observations] index of the image of each observation.
    """
    first = tracks.offsets[:-1]
    begin, end = view[first], view[tracks.offsets[1:] - 1]
    # Three observations span two images or more.
    span = np.array(SPANS)[np.searchsorted(SPANS, end - begin, side="right") - 1]
    # Observations are sorted by track, then by image.
    num_views = int(view.max()) + 1
    place = tracks.track * num_views + view
    number = np.arange(tracks.num_tracks)[:, None]
    at = begin[:, None] + np.column_stack([0 * span, span // 2, span])
    wanted = np.searchsorted(place, number * num_views + at)
    there = np.take(place, wanted, mode="clip") == number * num_views + at
    middle = first + (tracks.lengths - 1) // 2
    ends = np.column_stack([first, middle, tracks.offsets[1:] - 1])
    index = np.where(there.all(axis=1, keepdims=True), wanted, ends)
    chosen = np.zeros(tracks.num_observations, np.bool_)
    chosen[index.ravel()] = True
    return chosen

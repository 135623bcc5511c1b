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
from colmap_av1.util.arrays import Bools, Ints

# The longest and most accurate tracks, up to 150 per image, keep their observations. With more of
# them, models are not more accurate, and the mapper is slower.
_LONGEST = DensityOptions(
    preset="sparse", max_tracks_per_image=150, spacing=8.0, min_images=3, max_sigma=0.0
)
# Corners with at most _SHORT observations keep all of them, because they connect images where the
# camera moves fast. So do corners that are seen again after more than _REVISITED images.
_SHORT, _REVISITED = 8, 10
# All other tracks have three matched observations: two that are one of these numbers of images
# apart, and the one in the middle. Pairs of images at such distances are matched.
SPANS = (2, 4, 6, 8, 10, 12, 16, 20, 24, 32, 40, 48, 64, 80, 96, 128)
NUM_OBSERVATIONS = 3
# Each density preset limits the number of keypoints per image from such tracks to a share of the
# number of SIFT features of a picture, between two numbers. With the default preset, a mapper makes
# at least 1.2 times as many points as from SIFT in most videos: 100 SIFT features of an image give
# 3 to 8 points. With fewer than 300 such keypoints per image, the mapper divided a dark and noisy
# video into two models.
_LIMITS = {"sparse": (0.14, 150, 500), "default": (0.28, 300, 1000)}


def matched_observations(
    tracks: Tracks,
    frames: NDArray[np.int32],
    is_corner: Bools,
    is_needed: Bools,
    limits: DensityOptions,
) -> Bools:
    """Choose the observations that are matched.

    A few tracks keep all observations. The other tracks get three matched observations each, the
    best tracks first, until every image has enough of them.

    Args:
        tracks: tracks with three or more observations.
        frames: int32 [num_images] the frames of all images, ascending.
        is_corner: bool [num_tracks] which tracks are corners of the pictures or SIFT links. The
            others are motion tracks.
        is_needed: bool [num_tracks] tracks that keep all observations in any case.
        limits: limits of the number of tracks with three observations, see `limits_of_density`.

    Returns:
        bool [num_observations].
    """
    view = np.searchsorted(frames, tracks.frame)
    kept = spread_observations(tracks, _LONGEST)
    keeps_all = is_needed | (is_corner & _is_short_or_revisited(tracks, view))
    kept |= np.repeat(keeps_all, tracks.lengths)
    is_matched = tracks.having(kept)
    three = _three_observations(tracks, view)
    three[np.repeat(is_matched, tracks.lengths)] = False
    three[three] = spread_observations(tracks.keep_observations(three), limits)
    return np.asarray(kept | three)


def limits_of_density(density: DensityOptions, num_features: Callable[[], float]) -> DensityOptions:
    """Limits of the number of tracks with three observations.

    Args:
        density: the density that is asked for.
        num_features: counts the SIFT features of a picture; called if the limits depend on it.
    """
    most = density.max_tracks_per_image
    if most is None:
        most = 0
        if density.preset in _LIMITS:
            share, least, limit = _LIMITS[density.preset]
            most = min(limit, max(least, round(share * num_features())))
    return replace(density, max_tracks_per_image=most, min_images=NUM_OBSERVATIONS)


def _is_short_or_revisited(tracks: Tracks, view: Ints) -> Bools:
    """Which tracks are short, or seen again after many images, bool [num_tracks].

    Args:
        tracks: the tracks.
        view: int64 [num_observations] index of the image of each observation.
    """
    skipped = np.diff(view, prepend=view[:1])
    skipped[tracks.offsets[:-1]] = 0
    farthest = np.maximum.reduceat(skipped, tracks.offsets[:-1])
    return np.asarray((tracks.lengths <= _SHORT) | (farthest > _REVISITED))


def _three_observations(tracks: Tracks, view: Ints) -> Bools:
    """Choose three observations of each track, as far apart as possible, bool [num_observations].

    They begin with the first observation of the track or end with its last one, by turns, so that
    the images at its beginning and at its end get keypoints.

    Args:
        tracks: tracks with three or more observations.
        view: int64 [num_observations] index of the image of each observation.
    """
    first, last = tracks.offsets[:-1], tracks.offsets[1:] - 1
    begin, end = view[first], view[last]
    # Observations are sorted by track, then by image.
    num_views = int(view.max(initial=0)) + 1
    key = tracks.track * num_views + view
    # If no span has all three observations, their distances are arbitrary.
    chosen = np.column_stack([first, (first + last) // 2, last])
    left = np.arange(tracks.num_tracks)
    for span in reversed(SPANS):
        start = np.where(left % 2 == 0, begin[left], end[left] - span)
        wanted = (left * num_views + start)[:, None] + [0, span // 2, span]
        found = np.searchsorted(key, wanted)
        exist = (np.take(key, found, mode="clip") == wanted).all(axis=1)
        exist &= span <= end[left] - begin[left]
        chosen[left[exist]] = found[exist]
        left = left[~exist]
    is_chosen = np.zeros(tracks.num_observations, np.bool_)
    is_chosen[chosen.ravel()] = True
    return is_chosen

"""Which observations of tracks become keypoints."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from image_sets import tracks_from
from numpy.typing import NDArray

from colmap_av1.options import DensityOptions
from colmap_av1.poses.matched_observations import limits_of_density, matched_observations
from colmap_av1.tracks.tracks import Tracks

FRAMES = np.arange(100, dtype=np.int32)
UNLIMITED = limits_of_density(DensityOptions(preset="dense"), lambda: 0.0)


def spread(spans: list[list[int]]) -> Tracks:
    """Tracks through the given frames, each at a place of its own."""
    tracks = tracks_from(spans, num_frames=len(FRAMES))
    at = np.random.default_rng(0).uniform(0, 1000, (tracks.num_tracks, 2)).astype(np.float32)
    return replace(tracks, width=1000, height=1000, xy=np.repeat(at, tracks.lengths, axis=0))


def matched(
    tracks: Tracks,
    *,
    corners: bool = False,
    needed: tuple[int, ...] = (),
    limits: DensityOptions = UNLIMITED,
) -> list[list[int]]:
    """The images in which each track is matched."""
    is_corner = np.full(tracks.num_tracks, corners)
    is_needed = np.isin(np.arange(tracks.num_tracks), needed)
    kept = matched_observations(tracks, FRAMES, is_corner, is_needed, limits)
    return [tracks.frame[kept & (tracks.track == t)].tolist() for t in range(tracks.num_tracks)]


def num_matched(
    tracks: Tracks, *, corners: bool = False, needed: tuple[int, ...] = ()
) -> NDArray[np.int64]:
    """Number of matched observations of each track."""
    return np.array([len(own) for own in matched(tracks, corners=corners, needed=needed)])


@pytest.mark.parametrize("corners", [False, True])
def test_few_long_tracks_keep_all_observations(*, corners: bool) -> None:
    counts = num_matched(spread([list(range(40))] * 600), corners=corners)
    assert set(counts.tolist()) == {3, 40}
    assert 50 < np.count_nonzero(counts == 40) <= 150


def test_short_corners_keep_all_observations() -> None:
    """Where the camera moves fast, all tracks are short and few connect the images."""
    tracks = spread([list(range(6))] * 600)
    assert set(num_matched(tracks, corners=True).tolist()) == {6}
    assert np.count_nonzero(num_matched(tracks) == 3) >= 450


def test_corners_of_places_seen_again_keep_all_observations() -> None:
    again = [*range(12), *range(60, 72)]
    counts = num_matched(spread([again] * 300 + [list(range(24))] * 300), corners=True)
    assert set(counts[:300].tolist()) == {24}
    assert np.count_nonzero(counts[300:] == 3) >= 150


def test_given_tracks_keep_all_observations() -> None:
    tracks = spread([list(range(40))] * 600)
    few = np.flatnonzero(num_matched(tracks) == 3)[:5]
    assert num_matched(tracks, needed=tuple(few.tolist()))[few].tolist() == [40] * 5


def test_three_observations_cover_all_images_of_the_tracks() -> None:
    three = [own for own in matched(spread([list(range(64))] * 600)) if len(own) == 3]
    assert {tuple(np.diff(own).tolist()) for own in three} == {(24, 24)}
    assert {own[0] for own in three} == {0, 15}


def test_three_observations_avoid_missing_ones() -> None:
    """Images at distances that are not matched would not be connected."""
    seen = [*range(12), *range(13, 25)]
    three = [own for own in matched(spread([seen] * 600)) if len(own) == 3]
    assert {tuple(np.diff(own).tolist()) for own in three} <= {(10, 10), (8, 8)}


def test_tracks_with_three_observations_are_limited() -> None:
    limits = replace(UNLIMITED, max_tracks_per_image=50)
    counts = np.array([len(own) for own in matched(spread([[0, 5, 10]] * 600), limits=limits)])
    assert 100 < np.count_nonzero(counts) <= 200


@pytest.mark.parametrize(
    ("preset", "limits"),
    [("sparse", (150, 280, 500)), ("default", (300, 560, 1000)), ("dense", (0, 0, 0))],
)
def test_number_of_tracks_depends_on_the_features_of_the_pictures(
    preset: str, limits: tuple[int, ...]
) -> None:
    for num_features, most in zip((1.0, 2000.0, 10000.0), limits, strict=True):
        found = limits_of_density(DensityOptions(preset=preset), lambda n=num_features: n)
        assert found.max_tracks_per_image == most
    given = DensityOptions(preset=preset, max_tracks_per_image=77)
    assert limits_of_density(given, lambda: 2000.0).max_tracks_per_image == 77

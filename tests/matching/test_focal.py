from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from walking_camera import FOCAL, HEIGHT, NUM_FRAMES, WIDTH, seen_by, walk

from colmap_av1.matching.focal import estimate_focal_length
from colmap_av1.matching.pairs import image_keypoints, pair_matches, schedule_pairs
from colmap_av1.tracks.tracks import Tracks


def estimate(tracks: Tracks, pixel_aspect: float = 1.0) -> float | None:
    keypoints = image_keypoints(tracks, range(tracks.num_frames))
    pairs = schedule_pairs(keypoints)
    matches = [pair_matches(keypoints[i], keypoints[j]) for i, j in pairs]
    size = (tracks.width, tracks.height)
    return estimate_focal_length(keypoints, pairs, matches, size, pixel_aspect=pixel_aspect)


def test_focal_length_of_a_walk_is_estimated() -> None:
    found = estimate(walk())
    assert found == pytest.approx(FOCAL, rel=0.04)
    assert estimate(walk()) == found


def test_focal_length_with_non_square_pixels() -> None:
    tracks = walk()
    narrow = replace(tracks, width=WIDTH // 2, xy=tracks.xy / np.array([2, 1], np.float32))
    assert estimate(narrow, pixel_aspect=2.0) == pytest.approx(FOCAL, rel=0.04)


def test_focal_length_with_outliers() -> None:
    tracks, rng = walk(), np.random.default_rng(0)
    xy = tracks.xy.copy()
    wrong = rng.random(len(xy)) < 0.1
    xy[wrong] = rng.uniform(0, [WIDTH, HEIGHT], (int(wrong.sum()), 2)).astype(np.float32)
    assert estimate(replace(tracks, xy=xy)) == pytest.approx(FOCAL, rel=0.08)


def test_forward_motion_gives_no_focal_length() -> None:
    t = np.linspace(0, 1, NUM_FRAMES)[:, None]
    assert estimate(seen_by(np.hstack([0 * t, 0 * t, 4 * t]), np.zeros((NUM_FRAMES, 3)))) is None


def test_orbit_gives_no_focal_length() -> None:
    """The focal length is not observable if optical axes meet at equal distances."""
    angle = np.linspace(-0.5, 0.5, NUM_FRAMES)[:, None]
    centre = np.hstack([12 * np.sin(angle), 0 * angle, 12 - 12 * np.cos(angle)])
    found = estimate(seen_by(centre, np.hstack([0 * angle, angle, 0 * angle])))
    assert found is None


def test_still_camera_gives_no_focal_length() -> None:
    assert estimate(seen_by(np.zeros((NUM_FRAMES, 3)), np.zeros((NUM_FRAMES, 3)))) is None
    tracks = walk()
    xy = np.repeat(tracks.xy[::NUM_FRAMES], NUM_FRAMES, axis=0)
    assert estimate(replace(tracks, xy=xy)) is None


def test_pair_whose_matches_lie_on_a_line_is_ignored() -> None:
    """They determine no pose, for example the matches of a news ticker."""
    tracks = replace(walk(), num_frames=NUM_FRAMES + 2)
    rng = np.random.default_rng(0)
    x = np.repeat(rng.uniform(0, WIDTH - 50, 100), 2)
    x[1::2] += rng.uniform(0, 50, 100)
    on_line = replace(
        tracks,
        offsets=np.arange(0, 201, 2),
        frame=np.tile([NUM_FRAMES, NUM_FRAMES + 1], 100).astype(np.int32),
        xy=np.column_stack([x, np.full(200, HEIGHT / 2)]).astype(np.float32),
        sigma=np.full(200, 0.1, np.float32),
        confirmed=np.zeros(200, np.bool_),
    )
    found = estimate(Tracks.concatenate(tracks, on_line))
    assert found == pytest.approx(FOCAL, rel=0.04)


def test_too_few_matches_give_no_focal_length() -> None:
    assert estimate(walk(num_points=40)) is None

"""Corners are tracked in the pictures, with tracks as a guide."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from colmap_av1.tracks.corners import CornerDensity, follow_corners
from colmap_av1.tracks.tracks import Tracks

SIZE = (320, 240)
BORDER = 200


def texture(seed: int) -> NDArray[np.uint8]:
    """A texture with detail at several scales, larger than the views of it."""
    rng = np.random.default_rng(seed)
    shape = (SIZE[1] + 2 * BORDER, SIZE[0] + 2 * BORDER)
    sum_of = np.zeros(shape)
    for sigma in (2.0, 4.0, 8.0):
        blurred = cv2.GaussianBlur(rng.normal(size=shape), (0, 0), sigma)
        sum_of += blurred / blurred.std()
    return np.clip(128 + 40 * sum_of, 0, 255).astype(np.uint8)


def view(whole: NDArray[np.uint8], shift: NDArray[np.float64]) -> NDArray[np.uint8]:
    """A BGR view of the texture, shifted by some pixels."""
    move = np.array([[1.0, 0, shift[0] - BORDER], [0, 1.0, shift[1] - BORDER]])
    return cv2.cvtColor(
        cv2.warpAffine(whole, move, SIZE, flags=cv2.INTER_CUBIC), cv2.COLOR_GRAY2BGR
    )


def guide_along(shifts: NDArray[np.float64], starts: NDArray[np.float64]) -> Tracks:
    """Tracks that start at the given points and move with the texture."""
    xy = (starts[:, None] + shifts[None]).reshape(-1, 2).astype(np.float32)
    n, length = len(starts), len(shifts)
    return Tracks(
        num_frames=length,
        width=SIZE[0],
        height=SIZE[1],
        offsets=np.arange(0, n * length + 1, length),
        frame=np.tile(np.arange(length, dtype=np.int32), n),
        xy=xy,
        sigma=np.full(n * length, 0.3, np.float32),
        confirmed=np.zeros(n * length, np.bool_),
    )


def all_valid(_: int, xy: NDArray[np.float32], __: tuple[int, int]) -> NDArray[np.bool_]:
    return np.ones(len(xy), np.bool_)


def motion_of(tracks: Tracks, shifts: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance of each observation from the true motion since the first one, in pixels."""
    first = np.repeat(tracks.offsets[:-1], tracks.lengths)
    moved = shifts[tracks.frame] - shifts[tracks.frame[first]]
    return np.linalg.norm(tracks.xy - tracks.xy[first] - moved, axis=1)


SLOW = np.array([[0.0, 0], [3.3, -1.2], [7.1, 0.4], [10.9, 2.8], [13.2, 6.6]])
STARTS = np.array([[80.0, 60], [160, 120], [240, 180]])


def test_corners_follow_the_texture() -> None:
    whole = texture(1)
    pictures = [(f, view(whole, s)) for f, s in enumerate(SLOW)]
    found = follow_corners(guide_along(SLOW, STARTS), pictures, all_valid)
    assert found.num_tracks > 50
    assert found.lengths.min() >= 3
    assert np.percentile(motion_of(found, SLOW), 95) < 0.1
    assert found.confirmed.all()


def test_large_jump_is_followed_with_the_guide() -> None:
    shifts = np.array([[0.0, 0], [2, 1], [92, -61], [95, -60]])
    whole = texture(2)
    pictures = [(f, view(whole, s)) for f, s in enumerate(shifts)]
    found = follow_corners(guide_along(shifts, STARTS), pictures, all_valid)
    across = np.isin(np.arange(found.num_tracks), found.track[found.frame == 1])
    across &= np.isin(np.arange(found.num_tracks), found.track[found.frame == 2])
    assert across.sum() > 30
    assert np.percentile(motion_of(found, shifts), 95) < 0.1


def test_corners_are_only_found_where_allowed() -> None:
    whole = texture(3)
    pictures = [(f, view(whole, s)) for f, s in enumerate(SLOW)]

    def right_half(_: int, xy: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.bool_]:
        return np.asarray(xy[:, 0] >= size[0] / 2)

    found = follow_corners(guide_along(SLOW, STARTS), pictures, right_half)
    assert found.num_tracks > 20
    assert found.xy[:, 0].min() >= SIZE[0] / 2


def test_corners_of_large_pictures_are_in_full_size_pixels() -> None:
    shifts = SLOW * 5
    pictures = []
    whole = texture(4)
    for frame, shift in enumerate(SLOW):
        small = view(whole, shift)
        large = cv2.resize(small, None, fx=5, fy=5, interpolation=cv2.INTER_CUBIC)
        pictures.append((frame, large))
    found = follow_corners(guide_along(shifts, STARTS * 5), pictures, all_valid)
    assert found.xy[:, 0].max() > SIZE[0] * 4
    assert np.percentile(motion_of(found, shifts), 95) < 0.5


def test_density_sets_the_number_of_corners() -> None:
    pictures = [(k, view(texture(1), shift)) for k, shift in enumerate(SLOW)]
    few, many = (
        follow_corners(guide_along(SLOW, STARTS), pictures, all_valid, density=density)
        for density in (CornerDensity(most=50), CornerDensity(most=300, spacing=6))
    )
    assert np.bincount(few.frame).max() <= 50
    assert 150 < np.bincount(many.frame).max() <= 300
    assert np.median(motion_of(many, SLOW)) < 0.1


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_or_untextured_pictures_give_no_tracks(count: int) -> None:
    whole = texture(5)
    shown = [(f, view(whole, s)) for f, s in enumerate(SLOW[:count])]
    guide = guide_along(SLOW, STARTS)
    assert follow_corners(guide, shown, all_valid).num_tracks == 0
    plain = [(f, np.full((SIZE[1], SIZE[0], 3), 90, np.uint8)) for f in range(4)]
    assert follow_corners(guide, plain, all_valid).num_tracks == 0

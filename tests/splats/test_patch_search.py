"""The patch search finds patches in another image with subpixel accuracy."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from colmap_av1 import _core

SIDE, SIZE = 37, 400
UPRIGHT = np.array([[1, 0], [0, 1]], np.float32)


def texture() -> NDArray[np.float32]:
    """An image with fine texture."""
    rng = np.random.default_rng(2)
    noise = cv2.GaussianBlur(rng.normal(size=(SIZE, SIZE)).astype(np.float32), (0, 0), 1.8)
    return np.asarray(128 + 30 * noise / noise.std(), np.float32)


def grey(picture: NDArray[np.float32]) -> NDArray[np.uint8]:
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def sought(source: NDArray[np.uint8], count: int) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """Patches of an image, and their centre pixels [n, 2]."""
    at = np.random.default_rng(3).integers(60, SIZE - 60, (count, 2))
    half = SIDE // 2
    return np.stack([source[y - half : y + half + 1, x - half : x + half + 1] for x, y in at]), at


def find(patches: NDArray[np.uint8], target: NDArray[np.uint8], start: Any, **how: Any) -> Any:
    count = len(start)
    given: dict[str, Any] = {
        "index": np.arange(count),
        "middle": np.zeros((count, 2), np.float32),
        "change": np.tile(UPRIGHT, (count, 1, 1)),
        "target": target,
        "start": np.asarray(start, np.float32),
        "max_move": 4.0,
    } | how
    return _core.find_patches(patches, given.pop("index"), **given)


def test_patches_are_found_in_a_rotated_image() -> None:
    whole = texture()
    patches, at = sought(grey(whole), 200)
    turn = cv2.getRotationMatrix2D((200.3, 199.4), 25.0, 1.1)
    target = grey(cv2.warpAffine(whole, turn, (SIZE, SIZE), flags=cv2.INTER_CUBIC))
    places = at @ turn[:, :2].T + turn[:, 2] + 0.5
    start = places + np.random.default_rng(4).uniform(-1.5, 1.5, places.shape)
    # From target pixels to patch pixels.
    change = np.tile(np.linalg.inv(turn[:, :2]).astype(np.float32), (len(at), 1, 1))
    xy, missed, likeness = find(patches, target, start, change=change)
    found = missed <= 0.15
    assert found.mean() > 0.9
    off = np.linalg.norm(xy - places, axis=1)[found]
    assert np.median(off) < 0.03
    assert np.quantile(off, 0.95) < 0.1
    assert np.quantile(likeness[found], 0.05) > 0.97


def test_patch_centre_may_lie_between_pixels() -> None:
    source = grey(texture())
    patches, at = sought(source, 50)
    middle = np.full((len(at), 2), (0.3, -0.4), np.float32)
    xy, missed, _ = find(patches, source, at + 0.5, middle=middle)
    found = missed <= 0.15
    assert found.mean() > 0.9
    assert np.abs(xy - (at + 0.5 + middle))[found].max() < 0.1


def test_unmatched_patches_are_not_found() -> None:
    source = grey(texture())
    patches, at = sought(source, 50)
    flat = np.full_like(source, 128)
    nowhere = np.full((len(at), 2), np.nan)
    for target, start, own in (
        (flat, at + 0.5, patches),
        (source, at + 0.5, np.full_like(patches, 128)),
        (source, at + 0.5 + 2 * SIZE, patches),
        (source, nowhere, patches),
    ):
        _, missed, likeness = find(own, target, start)
        assert np.isinf(missed).all()
        assert (likeness == -1).all()
    # The start is farther away than `max_move`.
    xy, missed, _ = find(patches, source, at + 1.5, max_move=0.5)
    assert (np.abs(xy - at - 1.5).max(axis=1) <= 0.5)[np.isfinite(missed)].all()
    assert np.isinf(missed).mean() > 0.9


def test_mismatched_arrays_are_refused() -> None:
    source = grey(texture())
    patches, at = sought(source, 3)
    start = at + 0.5
    for wrong in (
        {"index": np.array([0, 1, 3])},
        {"index": np.array([0, -1, 2])},
        {"index": np.array([0, 1])},
        {"middle": np.zeros((2, 2), np.float32)},
        {"change": np.tile(UPRIGHT, (2, 1, 1))},
    ):
        with pytest.raises(ValueError, match=r"fit|index"):
            find(patches, source, start, **wrong)
    with pytest.raises(ValueError, match="size"):
        find(patches, source[:0], start)
    with pytest.raises(ValueError, match="squares"):
        find(patches[:, 1:], source, start)
    with pytest.raises(ValueError, match="fit"):
        find(np.ascontiguousarray(patches[:, 1:, 1:]), source, start)

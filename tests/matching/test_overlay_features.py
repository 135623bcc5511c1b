"""Features on overlays, such as logos and displays, are removed."""

from __future__ import annotations

import numpy as np
import pycolmap
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from colmap_av1.matching.features.overlays import without_overlays
from colmap_av1.matching.features.sift import Features

SIZE = (320, 240)


def camera(size: tuple[int, int] = SIZE) -> pycolmap.Camera:
    params = [300.0, size[0] / 2, size[1] / 2]
    return pycolmap.Camera(
        camera_id=1, model="SIMPLE_PINHOLE", width=size[0], height=size[1], params=params
    )


def unit(rng: np.random.Generator, count: int) -> NDArray[np.float32]:
    """Random descriptors, all different."""
    drawn = rng.normal(size=(count, 128))
    return np.asarray(drawn / np.linalg.norm(drawn, axis=1, keepdims=True), np.float32)


def views(
    num_images: int, step: float, num_over: int, seed: int
) -> tuple[dict[int, Features], NDArray[np.bool_]]:
    """Features of a scene that moves by `step` pixels per image, and of an overlay."""
    rng = np.random.default_rng(seed)
    scene, over = rng.uniform((0, 0), SIZE, (300, 2)), rng.uniform((0, 0), (80, 32), (num_over, 2))
    descriptors = unit(rng, 300 + num_over)
    found = {}
    for k in range(num_images):
        moved = np.mod(scene + np.array([step * k, 0]), SIZE)
        xy = np.concatenate([moved, over + rng.uniform(-0.4, 0.4, over.shape)])
        found[3 * k] = Features(np.abs(xy).astype(np.float32), descriptors)
    return found, np.arange(300 + num_over) >= 300


@given(
    num_images=st.integers(2, 12),
    step=st.floats(6.3, 20.0),
    num_over=st.integers(1, 60),
    seed=st.integers(0, 1000),
)
def test_overlay_features_are_removed(
    num_images: int, step: float, num_over: int, seed: int
) -> None:
    features, is_over = views(num_images, step, num_over, seed)
    found = without_overlays(features, [camera()] * (3 * num_images))
    assert found.keys() == features.keys()
    for image, own in found.items():
        whole = features[image]
        kept = (whole.xy[:, None] == own.xy[None]).all(axis=2).any(axis=1)
        assert not kept[is_over].any()
        # Scene features are removed only in the cells of the overlay, with few exceptions.
        over = set(map(tuple, whole.xy[is_over].astype(int) // 16))
        gone = set(map(tuple, whole.xy[~kept].astype(int) // 16))
        assert len(gone - over) <= 0.1 * 300
        assert len(own.xy) == len(own.descriptors) == np.count_nonzero(kept)


def test_nothing_is_removed_if_everything_stays_or_moves() -> None:
    for step, num_over in ((0.0, 40), (0.1, 0), (15.0, 0)):
        features, _ = views(8, step, num_over, seed=1)
        found = without_overlays(features, [camera()] * 24)
        assert all(found[image] is features[image] for image in features)


def test_a_camera_that_stands_still_for_a_while_keeps_its_features() -> None:
    moving, is_over = views(12, 15.0, 40, seed=3)
    # The camera stands still in the first four images.
    features = {k: moving[0] if k < 12 else own for k, own in moving.items()}
    found = without_overlays(features, [camera()] * 36)
    for image, own in found.items():
        kept = (features[image].xy[:, None] == own.xy[None]).all(axis=2).any(axis=1)
        assert not kept[is_over].any()
        assert kept[~is_over].mean() > 0.8


def test_images_of_other_sizes_are_not_compared() -> None:
    features, _ = views(4, 15.0, 40, seed=2)
    cameras = [camera((320 + image, 240)) for image in range(12)]
    found = without_overlays(features, cameras)
    assert all(found[image] is features[image] for image in features)
    nothing = Features(np.empty((0, 2), np.float32), np.empty((0, 128), np.float32))
    assert without_overlays({}, []) == {}
    assert without_overlays({0: nothing, 1: nothing}, [camera()] * 2)[0] is nothing

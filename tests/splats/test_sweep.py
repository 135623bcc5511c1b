"""The plane sweep adds points where there are no tracks: correct depths, nothing occluded."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from colmap_av1 import _core
from colmap_av1.geometry.masks import make_mask
from colmap_av1.geometry.model_points import ModelPoints
from colmap_av1.geometry.posed_camera import PosedCamera
from colmap_av1.splats.sweep import Sweep

WIDTH, HEIGHT, FOCAL = 320, 240, 300.0
CAMERA = pycolmap.Camera(
    camera_id=1, model="PINHOLE", width=WIDTH, height=HEIGHT, params=[FOCAL, FOCAL, 160, 120]
)
NUM_VIEWS, STEP = 9, 0.27
# A square in front of a wall: depths, centre and half width; the right of the wall is untextured.
NEAR, FAR, CENTRE, HALF, PLAIN_FROM = 3.0, 10.0, 1.08, 0.4, 4.0
# Columns of the square that its mask leaves uncovered.
EDGE = 14
PIXELS_PER_UNIT = {NEAR: 250.0, FAR: 50.0}


def texture(seed: int) -> np.ndarray:
    rough = np.random.default_rng(seed).integers(0, 256, (400, 400, 3), dtype=np.uint8)
    return cv2.resize(rough, (1600, 1600), interpolation=cv2.INTER_CUBIC)


def show(x_camera: float) -> np.ndarray:
    """Render the image of a camera at (x, 0, 0) that looks along z."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    ray = np.stack([(x - 160) / FOCAL, (y - 120) / FOCAL], axis=-1)
    shown = {}
    for depth, seed in ((NEAR, 1), (FAR, 2)):
        at = ray * depth + (x_camera, 0)
        place = (800 + at * PIXELS_PER_UNIT[depth] - 0.5).astype(np.float32)
        shown[depth] = at, cv2.remap(texture(seed), place, None, cv2.INTER_LINEAR)
    on_wall, picture = shown[FAR]
    picture[on_wall[..., 0] > PLAIN_FROM] = 128
    on_square, near = shown[NEAR]
    return np.where((np.abs(on_square - (CENTRE, 0)) < HALF).all(axis=-1)[..., None], near, picture)


VIEWS = [
    PosedCamera(CAMERA, np.column_stack([np.eye(3), [-STEP * i, 0.0, 0.0]]))
    for i in range(NUM_VIEWS)
]
PICTURES = [show(STEP * i) for i in range(NUM_VIEWS)]
ONE_VIDEO = np.zeros(NUM_VIEWS, np.int32)


def on_wall(*, through: bool = False) -> ModelPoints:
    """Tracks of the textured wall in every image that shows them.

    With `through`, the square does not occlude them.
    """
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(-6, 8, 0.2), np.arange(-5, 5, 0.2)))
    xyz = np.column_stack([x, y, np.full(len(x), FAR)])
    seen = []
    for image, view in enumerate(VIEWS):
        index, xy, _ = view.project(xyz)
        at_square = view.centre + (xyz[index] - view.centre) * (NEAR / FAR)
        free = through | (np.abs(at_square[:, :2] - (CENTRE, 0)) >= HALF + 0.02).any(axis=1)
        free &= xyz[index, 0] < PLAIN_FROM
        seen += [(i, image, at) for i, at in zip(index[free], xy[free], strict=True)]
    seen.sort(key=lambda one: one[:2])
    point, image, xy = (np.array(column) for column in zip(*seen, strict=True))
    counts = np.bincount(point, minlength=len(xyz))
    offsets = np.concatenate([[0], np.cumsum(counts)])
    rgb = np.zeros((len(xyz), 3), np.uint8)
    return ModelPoints(xyz, rgb, np.full(len(xyz), 0.1), offsets, image, xy)


def sweep(
    points: ModelPoints, pictures=None, views=VIEWS, image_set=ONE_VIDEO, num_threads=2
) -> ModelPoints:
    with Sweep(points, views, image_set, num_threads=num_threads) as found:
        for image, picture in enumerate(PICTURES) if pictures is None else pictures:
            found.add(image, picture)
        return found.result()


def test_sweep_finds_an_object_without_tracks() -> None:
    found = sweep(on_wall())
    assert len(found.xyz) > 100
    # On the square only, and not on the untextured wall.
    assert (np.abs(found.xyz[:, :2] - (CENTRE, 0)) < HALF + 0.03).all()
    assert np.abs(found.xyz[:, 2] / NEAR - 1).max() < 0.03
    assert np.diff(found.offsets).min() >= 3
    owner = np.repeat(np.arange(len(found.xyz)), np.diff(found.offsets))
    at = [VIEWS[i].project(found.xyz[[k]])[1][0] for i, k in zip(found.image, owner, strict=True)]
    apart = np.linalg.norm(found.xy - np.array(at), axis=1)
    assert np.quantile(apart, 0.9) < 0.3
    mean = np.bincount(owner, weights=apart) / np.diff(found.offsets)
    np.testing.assert_allclose(found.error, mean, atol=1e-9)
    # Sorted by point, then by image.
    assert (np.diff(owner * NUM_VIEWS + found.image) > 0).all()


def test_result_does_not_depend_on_the_number_of_threads() -> None:
    one = sweep(on_wall(), num_threads=1)
    two = sweep(on_wall())
    for a, b in zip(vars(one).values(), vars(two).values(), strict=True):
        np.testing.assert_array_equal(a, b)


def test_new_points_do_not_occlude_tracks() -> None:
    # The sweep uses every other image; the tracks of the images between see through the square.
    points, hidden = on_wall(), on_wall(through=True)
    mixed = [hidden if i % 2 else points for i in range(NUM_VIEWS)]
    rows = [
        (k, i, xy)
        for i, own in enumerate(mixed)
        for k, xy in zip(
            np.repeat(np.arange(len(own.xyz)), np.diff(own.offsets))[own.image == i],
            own.xy[own.image == i],
            strict=True,
        )
    ]
    rows.sort(key=lambda one: one[:2])
    point, image, xy = (np.array(column) for column in zip(*rows, strict=True))
    offsets = np.concatenate([[0], np.cumsum(np.bincount(point, minlength=len(points.xyz)))])
    assert len(sweep(replace(points, offsets=offsets, image=image, xy=xy)).xyz) == 0


def test_images_of_different_videos_are_not_compared() -> None:
    assert len(sweep(on_wall(), image_set=np.arange(NUM_VIEWS, dtype=np.int32)).xyz) == 0


def test_nothing_is_found_on_masks() -> None:
    kept = np.zeros((HEIGHT, WIDTH), np.bool_)
    views = [replace(view, mask=make_mask(kept)) for view in VIEWS]
    assert len(sweep(on_wall(), views=views).xyz) == 0


def test_nothing_is_found_next_to_masks() -> None:
    """The masks cover the square except for an edge."""
    views = []
    for number, view in enumerate(VIEWS):
        low, high = (
            int(FOCAL * (CENTRE + side - STEP * number) / NEAR + WIDTH / 2)
            for side in (-HALF, HALF)
        )
        kept = np.ones((HEIGHT, WIDTH), np.bool_)
        kept[:, max(low, 0) : max(high - EDGE, 0)] = False
        views.append(replace(view, mask=make_mask(kept)))
    on_square = np.abs(sweep(on_wall()).xyz[:, 2] - NEAR) < 0.5
    assert on_square.sum() > 20
    masked = sweep(on_wall(), views=views)
    assert not (np.abs(masked.xyz[:, 2] - NEAR) < 0.5).any()


@pytest.mark.parametrize("left", [[], [0], [0, 1], [0, 1, 2, 7], range(5)])
def test_missing_pictures_are_not_used(left: list[int]) -> None:
    found = sweep(on_wall(), [(i, PICTURES[i]) for i in left])
    assert set(found.image.tolist()) <= set(left)
    assert (len(found.xyz) > 0) == (len(left) > 2)


def test_no_points_or_a_single_image_give_no_points() -> None:
    assert len(sweep(ModelPoints.empty()).xyz) == 0
    one = sweep(ModelPoints.empty(), [(0, PICTURES[0])], VIEWS[:1], ONE_VIDEO[:1])
    assert len(one.xyz) == 0


def patch(picture: np.ndarray, x: float, y: float) -> np.ndarray:
    place = np.stack(np.meshgrid(x + np.arange(-4, 4), y + np.arange(-4, 4)), axis=-1)
    return cv2.remap(picture.astype(np.float32), place.astype(np.float32), None, cv2.INTER_LINEAR)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_correlations_match_numpy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    one, two = rng.integers(0, 256, (2, 20, 24), dtype=np.uint8)
    # Multiples of 1/32 are exact in OpenCV's table of interpolation weights.
    at_one = (rng.integers(5 * 32, 15 * 32, (3, 2)) / 32).astype(np.float32)
    at_two = (rng.integers(5 * 32, 15 * 32, (3, 4, 2)) / 32).astype(np.float32)
    found = _core.correlate_patches(one, at_one, two, at_two, min_deviation=0.0)
    expected = [
        [np.corrcoef(patch(one, *a).ravel(), patch(two, *b).ravel())[0, 1] for b in row]
        for a, row in zip(at_one, at_two, strict=True)
    ]
    np.testing.assert_allclose(found, expected, atol=1e-4)


def test_patches_outside_the_image_or_without_texture_do_not_correlate() -> None:
    picture = np.random.default_rng(0).integers(0, 256, (20, 24), dtype=np.uint8)
    middle = np.array([[12, 10]], np.float32)

    def of(at: tuple[float, float], shown: np.ndarray = picture, deviation: float = 5.0) -> float:
        place = np.array([[at]], np.float32)
        found = _core.correlate_patches(picture, middle, shown, place, min_deviation=deviation)
        return float(found[0, 0])

    assert of((12, 10)) == pytest.approx(1.0, abs=1e-5)
    beyond = [(3.9, 10), (12, 3.9), (20.1, 10), (12, 16.1), (np.nan, 10), (1e30, 10), (-np.inf, 0)]
    assert [of(at) for at in beyond] == [-1.0] * len(beyond)
    assert of((12, 10), np.full_like(picture, 9)) == -1.0
    assert of((12, 10), deviation=1e3) == -1.0


def test_mismatched_arrays_are_refused() -> None:
    picture, at = np.zeros((20, 24), np.uint8), np.zeros((3, 2), np.float32)
    with pytest.raises(ValueError, match="lengths"):
        _core.correlate_patches(
            picture, at, picture, np.zeros((2, 1, 2), np.float32), min_deviation=0.0
        )

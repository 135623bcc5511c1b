"""Expected errors of camera centres agree with those after bundle adjustment."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap
import pytest

from colmap_av1.evaluate import pose_errors
from colmap_av1.geometry.colmap_model import ModelImage, read_model, write_model
from colmap_av1.geometry.model_points import ModelPoints
from colmap_av1.geometry.posed_model import PosedModel, posed_model
from colmap_av1.geometry.uncertainty import centre_uncertainty, expected_error

NUM_IMAGES = 10
SIGMA = 0.5


def scene(rng: np.random.Generator, camera: pycolmap.Camera, num_points: int = 80) -> PosedModel:
    """A camera that moves to the side; six images see each point, with errors of `SIGMA`."""
    xyz = rng.uniform([-3, -2, 6], [6, 2, 12], (num_points, 3))
    first = rng.integers(0, NUM_IMAGES - 5, num_points)
    image = (first[:, None] + np.arange(6)).ravel()
    poses = np.tile(np.eye(3, 4), (NUM_IMAGES, 1, 1))
    along = np.arange(NUM_IMAGES)
    poses[:, :, 3] = np.column_stack([-0.3 * along, 0.02 * along**2, 0.2 * np.sin(along)])
    local = np.repeat(xyz, 6, axis=0) + poses[image, :, 3]
    xy = np.asarray(camera.img_from_cam(local)) + rng.normal(0, SIGMA, (len(image), 2))
    points = ModelPoints(
        xyz,
        np.zeros((num_points, 3), np.uint8),
        np.zeros(num_points),
        np.arange(0, 6 * num_points + 1, 6),
        image,
        xy,
    )
    images = [ModelImage(k + 1, f"{k}.png", 1, pose) for k, pose in enumerate(poses)]
    return PosedModel({1: camera}, images, points)


def adjusted(model: PosedModel, folder: Path) -> PosedModel:
    """The model after bundle adjustment of poses and points."""
    write_model(folder, model.cameras, model.images, model.points)
    reconstruction = read_model(folder)
    fixed = {"refine_focal_length": False, "refine_extra_params": False, "print_summary": False}
    pycolmap.bundle_adjustment(reconstruction, pycolmap.BundleAdjustmentOptions(**fixed))
    return posed_model(reconstruction, with_points=True)


@pytest.mark.parametrize("name", ["SIMPLE_PINHOLE", "OPENCV_FISHEYE"])
def test_uncertainty_is_the_error_after_adjustment(name: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    camera = pycolmap.Camera.create_from_model_name(1, name, 500, 640, 480)
    expected, actual = [], []
    for _ in range(20):
        made = scene(rng, camera)
        truth = np.array([image.cam_from_world for image in made.images])
        found = adjusted(made, tmp_path)
        errors = pose_errors(np.array([i.cam_from_world for i in found.images]), truth)
        assert errors is not None
        actual.append(errors.ate / errors.extent)
        expected.append(np.sqrt(np.mean(centre_uncertainty(found) ** 2)))
    rms = np.sqrt(np.mean(np.square(actual)))
    # The adjustment also lowers the errors of the observations, by a few per cent.
    assert np.mean(expected) == pytest.approx(rms, rel=0.25)


def test_error_is_estimated_from_some_of_the_points(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 500, 640, 480)
    made = scene(np.random.default_rng(2), camera, 1000)
    whole = expected_error(made)
    assert whole == pytest.approx(np.sqrt(np.mean(centre_uncertainty(made) ** 2)))
    monkeypatch.setattr("colmap_av1.geometry.uncertainty._MAX_OBSERVATIONS", 3000)
    some = expected_error(made)
    assert some != whole
    assert some == pytest.approx(whole, rel=0.3)


def test_parts_without_common_points_are_uncertain() -> None:
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 500, 640, 480)
    made = scene(np.random.default_rng(3), camera, 4000)
    first = np.minimum.reduceat(made.points.image, made.points.offsets[:-1])
    half = NUM_IMAGES // 2
    own = np.repeat(first, 6) == first[0]
    is_before = made.points.image < half
    kept = (is_before & np.repeat(first < 2, 6)) | (~is_before & np.repeat(first >= 3, 6))
    assert not kept[own & ~is_before].any() or not kept[own & is_before].any()
    points, _ = made.points.keep_observations(kept)
    assert expected_error(made) < 0.001
    assert expected_error(replace(made, points=points)) > 0.1


def test_error_is_unknown_where_it_is_not_defined() -> None:
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 500, 640, 480)
    made = scene(np.random.default_rng(4), camera)
    assert expected_error(replace(made, points=ModelPoints.empty())) is None
    assert expected_error(replace(made, images=made.images[:2], points=ModelPoints.empty())) is None
    behind = replace(made.points, xyz=made.points.xyz * [1, 1, -1])
    assert expected_error(replace(made, points=behind)) is None
    turning = [replace(image, cam_from_world=np.eye(3, 4)) for image in made.images]
    assert expected_error(replace(made, images=turning)) is None


def test_image_with_too_few_points_is_uncertain() -> None:
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 500, 640, 480)
    made = scene(np.random.default_rng(1), camera)
    whole = centre_uncertainty(made)
    kept = (made.points.image < NUM_IMAGES - 1) | (np.arange(len(made.points.image)) % 18 == 5)
    points, _ = made.points.keep_observations(kept)
    few = centre_uncertainty(replace(made, points=points))
    assert few.argmax() == NUM_IMAGES - 1
    assert few[-1] > 1.5 * whole[-1]
    none, _ = made.points.keep_observations(made.points.image < NUM_IMAGES - 1)
    unknown = centre_uncertainty(replace(made, points=none))
    assert unknown.argmax() == NUM_IMAGES - 1
    assert unknown[-1] > 5 * few[-1]

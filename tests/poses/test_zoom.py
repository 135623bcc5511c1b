"""A video whose focal length changes gets a camera for each image, and so does one on request."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from dense_scene import NUM_IMAGES, OPTIONS, SCENE, Truth
from sequences import model_poses

from colmap_av1.cli.reports import reconstruct_rows
from colmap_av1.errors import OptionError
from colmap_av1.evaluate.metrics.poses import pose_errors
from colmap_av1.geometry.colmap_model import read_model
from colmap_av1.geometry.posed_model import posed_model
from colmap_av1.map import map_database
from colmap_av1.match import match
from colmap_av1.options import (
    CameraOptions,
    ImageOptions,
    MapperOptions,
    MatchOptions,
    ReconstructOptions,
)
from colmap_av1.poses.zoom import with_own_cameras
from colmap_av1.reconstruct import ReconstructReport, reconstruct
from colmap_av1.video.decoding import decode_frames

ZOOM = 1.2
EVERY_THIRD = MatchOptions(images=ImageOptions(every=3))


def zooming(encode: Callable[..., Path], output: Path) -> Path:
    """The rendered clip with a steady zoom."""
    frames = [picture for _, picture in decode_frames(SCENE)]
    height, width = frames[0].shape[:2]
    centre = np.array([width - 1, height - 1]) / 2
    for i, zoom in enumerate(np.linspace(1, ZOOM, len(frames))):
        crop = np.column_stack([zoom * np.eye(2), (1 - zoom) * centre])
        frames[i] = cv2.warpAffine(frames[i], crop, (width, height), flags=cv2.INTER_CUBIC)
    return encode(np.stack(frames), output)


def with_camera(camera: CameraOptions) -> ReconstructOptions:
    return replace(OPTIONS, match=replace(OPTIONS.match, camera=camera))


def test_a_zoom_is_found(encode: Callable[..., Path], truth: Truth, tmp_path: Path) -> None:
    """With one camera the path would be off by thirty times as much."""
    options = ReconstructOptions(match=EVERY_THIRD)
    report = reconstruct(zooming(encode, tmp_path / "zoom.mp4"), tmp_path / "out", options=options)
    model = read_model(report.output / "sparse" / "0")
    errors = pose_errors(model_poses(model, 60), truth.cam_from_world)
    assert errors.num_poses == 20
    assert errors.ate < 0.001 * errors.extent
    assert len(model.cameras) == model.num_reg_images()
    for image in model.images.values():
        zoom = 1 + (ZOOM - 1) * int(image.name[-10:-4]) / 59
        expected = zoom * truth.camera.focal_length_x
        assert image.camera.focal_length_x == pytest.approx(expected, rel=0.01)
        assert image.camera.model_name == "PINHOLE"
    shortest, longest = report.focal_lengths
    assert longest / shortest == pytest.approx(ZOOM, rel=0.02)
    assert dict(reconstruct_rows(report))["focal lengths"] == f"{shortest:.2f} to {longest:.2f} px"


def test_a_zoom_is_found_by_match(
    encode: Callable[..., Path], truth: Truth, tmp_path: Path
) -> None:
    database, images = tmp_path / "zoom.db", tmp_path / "images"
    video = zooming(encode, tmp_path / "zoom.mp4")
    match(database, video, image_path=images, options=EVERY_THIRD)
    model = read_model(map_database(database, images, tmp_path / "models").model)
    errors = pose_errors(model_poses(model, 60), truth.cam_from_world)
    assert errors.num_poses == 20
    assert errors.ate < 0.003 * errors.extent
    assert len(model.cameras) == model.num_reg_images()


def test_a_point_behind_a_camera_is_no_zoom(made: ReconstructReport, tmp_path: Path) -> None:
    """COLMAP drops its observation, so the trial has fewer than the model."""
    model = posed_model(read_model(made.output / "sparse" / "0"), with_points=True)
    first = model.images[model.points.image[0]]
    xyz = model.points.xyz.copy()
    xyz[0] = first.cam_from_world[:, :3].T @ ([0.0, 0.0, -1.0] - first.cam_from_world[:, 3])
    behind = replace(model, points=replace(model.points, xyz=xyz))
    run = SimpleNamespace(options=OPTIONS, stages=tmp_path)
    found = with_own_cameras(run, behind)
    assert found.model.cameras.keys() == model.cameras.keys()


def test_a_camera_for_each_image_on_request(truth: Truth, tmp_path: Path) -> None:
    options = with_camera(CameraOptions(single_camera=False))
    report = reconstruct(SCENE, tmp_path / "out", options=options)
    model = read_model(report.output / "sparse" / "0")
    errors = pose_errors(model_poses(model, 60), truth.cam_from_world)
    assert errors.num_poses == len(model.cameras) == NUM_IMAGES
    assert errors.ate < 0.01 * errors.extent
    assert report.focal_lengths == pytest.approx([truth.camera.focal_length_x] * 2, rel=0.03)


def test_given_intrinsics_stay(tmp_path: Path) -> None:
    camera = CameraOptions("PINHOLE", "520,520,320,180", single_camera=False)
    report = reconstruct(SCENE, tmp_path / "out", options=with_camera(camera))
    model = read_model(report.output / "sparse" / "0")
    assert len(model.cameras) == NUM_IMAGES
    assert {tuple(camera.params) for camera in model.cameras.values()} == {(520, 520, 320, 180)}


def test_without_an_adjustment_nothing_estimates_the_cameras() -> None:
    match = MatchOptions(camera=CameraOptions(single_camera=False))
    with pytest.raises(OptionError, match="--adjust 0"):
        ReconstructOptions(match=match, mapping=MapperOptions(adjust=False))

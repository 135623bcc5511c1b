"""A video that zooms gets a camera for each image, and so does any video on request."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from dense_scene import OPTIONS, SCENE, Truth
from sequences import model_poses

from colmap_av1.cli.reports import reconstruct_rows
from colmap_av1.errors import OptionError
from colmap_av1.evaluate.metrics.poses import pose_errors
from colmap_av1.geometry.colmap_model import ModelImage, read_model
from colmap_av1.geometry.model_points import ModelPoints
from colmap_av1.geometry.posed_model import PosedModel
from colmap_av1.map import map_database
from colmap_av1.match import match
from colmap_av1.options import (
    CameraOptions,
    ImageOptions,
    MatchOptions,
    PoseOptions,
    ReconstructOptions,
)
from colmap_av1.poses.zoom import with_own_cameras
from colmap_av1.reconstruct import reconstruct
from colmap_av1.util.run_context import RunContext
from colmap_av1.video.decoding import decode_frames

ZOOM = 1.2
NUM_POINTS = 300
EVERY_FOURTH = MatchOptions(images=ImageOptions(every=4))


@pytest.fixture(scope="module")
def zooming(encode: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The rendered clip at half size with a steady zoom."""
    frames = [picture for _, picture in decode_frames(SCENE)]
    height, width = frames[0].shape[:2]
    centre = np.array([width - 1, height - 1]) / 2
    for i, zoom in enumerate(np.linspace(1, ZOOM, len(frames))):
        crop = np.column_stack([zoom * np.eye(2), (1 - zoom) * centre])
        zoomed = cv2.warpAffine(frames[i], crop, (width, height), flags=cv2.INTER_CUBIC)
        frames[i] = cv2.resize(zoomed, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
    return encode(np.stack(frames), tmp_path_factory.mktemp("zooming") / "zoom.mp4")


def with_camera(camera: CameraOptions) -> ReconstructOptions:
    return replace(OPTIONS, match=MatchOptions(images=ImageOptions(every=5), camera=camera))


def test_reconstruct_detects_a_zoom(zooming: Path, truth: Truth, tmp_path: Path) -> None:
    """With a single camera the error of the path would be thirty times as large."""
    options = ReconstructOptions(match=EVERY_FOURTH)
    report = reconstruct(zooming, tmp_path / "out", options=options)
    model = read_model(report.output / "sparse" / "0")
    errors = pose_errors(model_poses(model, 60), truth.cam_from_world)
    assert errors.num_poses == 15
    assert errors.ate < 0.001 * errors.extent
    assert len(model.cameras) == model.num_reg_images()
    for image in model.images.values():
        zoom = 1 + (ZOOM - 1) * int(image.name[-10:-4]) / 59
        expected = zoom * truth.camera.focal_length_x / 2
        assert image.camera.focal_length_x == pytest.approx(expected, rel=0.01)
        assert image.camera.model_name == "PINHOLE"
    shortest, longest = report.focal_lengths
    assert longest / shortest == pytest.approx(ZOOM, rel=0.02)
    assert dict(reconstruct_rows(report))["focal lengths"] == f"{shortest:.2f} to {longest:.2f} px"


def test_match_detects_a_zoom(zooming: Path, truth: Truth, tmp_path: Path) -> None:
    database, images = tmp_path / "zoom.db", tmp_path / "images"
    match(database, zooming, image_path=images, options=EVERY_FOURTH)
    model = read_model(map_database(database, images, tmp_path / "models").model)
    errors = pose_errors(model_poses(model, 60), truth.cam_from_world)
    assert errors.num_poses == 15
    assert errors.ate < 0.003 * errors.extent
    assert len(model.cameras) == model.num_reg_images()


def model_of(truth: Truth, frames: range) -> PosedModel:
    """Exact poses, and points in front of all images with 0.3 px of noise."""
    rng = np.random.default_rng(0)
    poses = truth.cam_from_world[frames.start : frames.stop : frames.step]
    images = [ModelImage(i + 1, f"{i}.png", truth.camera.camera_id, p) for i, p in enumerate(poses)]
    middle = poses[len(poses) // 2]
    local = rng.uniform([-1, -0.5, 3], [1, 0.5, 5], (NUM_POINTS, 3))
    xyz = (local - middle[:, 3]) @ middle[:, :3]
    seen = [xyz @ pose[:, :3].T + pose[:, 3] for pose in poses]
    xy = np.stack([truth.camera.img_from_cam(own) for own in seen], axis=1)
    xy += rng.normal(0, 0.3, xy.shape)
    points = ModelPoints(
        xyz=xyz,
        rgb=np.zeros((NUM_POINTS, 3), np.uint8),
        error=np.zeros(NUM_POINTS),
        offsets=np.arange(NUM_POINTS + 1, dtype=np.int64) * len(images),
        image=np.tile(np.arange(len(images)), NUM_POINTS),
        xy=xy.reshape(-1, 2),
    )
    return PosedModel({truth.camera.camera_id: truth.camera}, images, points)


def test_point_behind_a_camera_is_not_taken_for_a_zoom(truth: Truth, tmp_path: Path) -> None:
    """COLMAP drops its observation, so the trial has fewer observations than the model."""
    model = model_of(truth, range(0, 60, 5))
    first = model.images[0]
    xyz = model.points.xyz.copy()
    xyz[0] = first.cam_from_world[:, :3].T @ ([0.0, 0.0, -1.0] - first.cam_from_world[:, 3])
    behind = replace(model, points=replace(model.points, xyz=xyz))
    run = SimpleNamespace(options=OPTIONS, stages=tmp_path, context=RunContext())
    found = with_own_cameras(run, behind)
    assert found.model.cameras.keys() == model.cameras.keys()


def test_each_image_gets_a_camera_on_request(truth: Truth, tmp_path: Path) -> None:
    options = with_camera(CameraOptions(single_camera=False))
    report = reconstruct(SCENE, tmp_path / "out", options=options)
    model = read_model(report.output / "sparse" / "0")
    errors = pose_errors(model_poses(model, 60), truth.cam_from_world)
    assert errors.num_poses == len(model.cameras) == 12
    assert errors.ate < 0.01 * errors.extent
    assert report.focal_lengths == pytest.approx([truth.camera.focal_length_x] * 2, rel=0.03)


def test_given_intrinsics_are_kept(tmp_path: Path) -> None:
    camera = CameraOptions("PINHOLE", "520,520,320,180", single_camera=False)
    report = reconstruct(SCENE, tmp_path / "out", options=with_camera(camera))
    model = read_model(report.output / "sparse" / "0")
    assert len(model.cameras) == 12
    assert {tuple(camera.params) for camera in model.cameras.values()} == {(520, 520, 320, 180)}


def test_cameras_per_image_need_the_adjustment() -> None:
    match = MatchOptions(camera=CameraOptions(single_camera=False))
    with pytest.raises(OptionError, match="--adjust 0"):
        ReconstructOptions(match=match, poses=PoseOptions(adjust=False))

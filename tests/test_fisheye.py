"""All stages with a rendered fisheye clip whose poses are known exactly."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from benchmarks import room
from conftest import Encode
from synthetic_scene import alignment_error
from trainers import RENDERED, Trainer

from colmap_av1 import (
    CameraOptions,
    DensifyOptions,
    DensityOptions,
    ImageOptions,
    MapOptions,
    MatchOptions,
    PlaceOptions,
    PoseOptions,
    ReconstructOptions,
    TriangulateOptions,
    densify,
    map_database,
    match,
    reconstruct,
)
from colmap_av1.geometry.colmap_model import camera_centres, posed_images, read_model
from colmap_av1.reconstruct import ReconstructReport
from colmap_av1.video.decoding import decode_frames

WIDTH, HEIGHT, FOCAL, NUM_FRAMES = 320, 240, 155.0, 20
MODEL = "OPENCV_FISHEYE"
MATCHING = MatchOptions(
    camera=CameraOptions(camera_model=MODEL), density=DensityOptions(preset="sparse")
)
OPTIONS = ReconstructOptions(
    match=MATCHING,
    poses=PoseOptions(pose_tracks_per_image=400),
    triangulate=TriangulateOptions(points="survey"),
    image_type="png",
)


@dataclass(frozen=True)
class Clip:
    """A clip of a lens with a field of view of 118 degrees, and the exact poses."""

    video: Path
    cam_from_world: np.ndarray


@pytest.fixture(scope="module")
def clip(encode: Encode, tmp_path_factory: pytest.TempPathFactory) -> Clip:
    camera = pycolmap.Camera(
        model=MODEL,
        width=WIDTH,
        height=HEIGHT,
        params=[FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, 0.01, -0.004, 0, 0],
    )
    t = np.arange(NUM_FRAMES) / 12
    centre = np.column_stack([1.2 * t - 1.5, 0.3 * np.sin(2 * t) - 2, 0.1 * np.sin(3 * t) + 1.5])
    ahead = np.column_stack([0.5 * t + 0.4 * np.sin(1.7 * t), np.full(len(t), 4.0), 1.2 + 0.1 * t])
    poses = room.look(centre, ahead)
    rays, textures = room.rays_of(camera, 1), room.make_textures()
    frames = [room.render(rays, np.repeat(p[None], HEIGHT, 0), textures) for p in poses]
    folder = tmp_path_factory.mktemp("fisheye")
    return Clip(encode(np.array(frames), folder / "fisheye.mp4"), poses)


def error(model: Path, clip: Clip) -> float:
    """RMS error of the camera centres in metres, on a path of 1.9 m.

    Fails if a frame is not registered.
    """
    images = posed_images(read_model(model))
    assert len(images) == NUM_FRAMES
    frames = [int(name[6:12]) for name in images]
    found = camera_centres(np.array([image.cam_from_world for image in images.values()]))
    return alignment_error(found, camera_centres(clip.cam_from_world[frames]))


@pytest.fixture(scope="module")
def made(clip: Clip, tmp_path_factory: pytest.TempPathFactory) -> ReconstructReport:
    return reconstruct(clip.video, tmp_path_factory.mktemp("made") / "out", options=OPTIONS)


def test_undistorted_model_is_accurate(clip: Clip, made: ReconstructReport) -> None:
    model = read_model(made.output / "sparse" / "0")
    assert [camera.model_name for camera in model.cameras.values()] == ["PINHOLE"]
    assert error(made.output / "sparse" / "0", clip) < 0.01
    assert made.mean_error < 0.5


@pytest.fixture(scope="module")
def original(
    clip: Clip, made: ReconstructReport, tmp_path_factory: pytest.TempPathFactory
) -> ReconstructReport:
    """The same reconstruction without undistortion, resumed after the adjustment."""
    output = tmp_path_factory.mktemp("original") / "out"
    shutil.copytree(made.output, output)
    return reconstruct(clip.video, output, options=replace(OPTIONS, undistort=False))


def test_without_undistortion_pictures_are_those_of_the_video(
    clip: Clip, original: ReconstructReport
) -> None:
    """Only the stage that writes the model runs again."""
    assert not {"tracks", "matches", "poses", "adjustment"} - {*original.resumed}
    assert "model" not in original.resumed
    for frame, picture in decode_frames(clip.video):
        written = cv2.imread(str(original.output / "images" / f"frame_{frame:06d}.png"))
        np.testing.assert_array_equal(written, picture)


def test_points_project_with_the_distortion_model(
    clip: Clip, made: ReconstructReport, original: ReconstructReport
) -> None:
    """This includes points outside the undistorted pictures."""
    (pinhole,) = read_model(made.output / "sparse" / "0").cameras.values()
    model = read_model(original.output / "sparse" / "0")
    (camera,) = model.cameras.values()
    assert camera.model_name == MODEL
    assert original.focal_lengths[0] == pytest.approx(FOCAL, rel=0.02)
    assert error(original.output / "sparse" / "0", clip) < 0.01
    num_outside = 0
    for point in model.points3D.values():
        errors = []
        for element in point.track.elements:
            image = model.images[element.image_id]
            xy = image.points2D[element.point2D_idx].xy
            in_camera = image.cam_from_world() * point.xyz
            errors.append(np.linalg.norm(camera.img_from_cam(in_camera) - xy))
            x, y = pinhole.img_from_cam(in_camera)
            num_outside += not (0 <= x < WIDTH and 0 <= y < HEIGHT)
        assert np.mean(errors) == pytest.approx(point.error, abs=1e-6)
        assert np.mean(errors) <= OPTIONS.triangulate.max_reprojection_error
    assert num_outside > 0.05 * original.num_observations


@pytest.mark.parametrize("trainer", RENDERED)
def test_trainers_read_the_distorted_model(trainer: Trainer, original: ReconstructReport) -> None:
    data = trainer(original.output)
    (camera,) = read_model(data.model).cameras.values()
    assert camera.model_name in RENDERED[trainer]
    assert all(picture.is_file() for picture in data.pictures.values())


def test_marks_of_a_scale_are_positions_in_the_original_pictures(
    clip: Clip, original: ReconstructReport, tmp_path: Path
) -> None:
    """Two points have a given distance, and each is marked in its first and last image."""
    model = read_model(original.output / "sparse" / "0")
    by_length = sorted(model.points3D.values(), key=lambda point: -point.track.length())[:50]
    one = by_length[0]
    two = max(by_length, key=lambda point: float(np.linalg.norm(point.xyz - one.xyz)))

    def mark(point: pycolmap.Point3D) -> str:
        elements = {model.images[e.image_id].name: e for e in point.track.elements}
        marks = []
        for name in (min(elements), max(elements)):
            element = elements[name]
            x, y = model.images[element.image_id].points2D[element.point2D_idx].xy
            marks.append(f"{name}:{x:.3f}:{y:.3f}")
        return "+".join(marks)

    output = tmp_path / "out"
    shutil.copytree(original.output, output)
    place = PlaceOptions(align="none", scale=f"2={mark(one)},{mark(two)}")
    options = replace(OPTIONS, undistort=False, place=place)
    placed = reconstruct(clip.video, output, options=options)
    distance = float(np.linalg.norm(one.xyz - two.xyz))
    assert distance * placed.place.scale == pytest.approx(2, rel=0.05)


def test_camera_model_is_kept_by_match_map_and_densify(clip: Clip, tmp_path: Path) -> None:
    database, images = tmp_path / "a.db", tmp_path / "images"
    matched = match(database, clip.video, image_path=images, options=MATCHING)
    assert matched.focal_length == pytest.approx(FOCAL, rel=0.05)
    mapped = map_database(database, images, tmp_path / "model", options=MapOptions(mapper="global"))
    (camera,) = read_model(mapped.model).cameras.values()
    assert camera.model_name == MODEL
    assert camera.mean_focal_length() == pytest.approx(FOCAL, rel=0.02)
    assert error(mapped.model, clip) < 0.01
    options = DensifyOptions(
        match=MatchOptions(images=ImageOptions()), triangulate=TriangulateOptions(points="survey")
    )
    dense = densify(
        mapped.model, clip.video, tmp_path / "dense", image_path=images, options=options
    )
    (camera,) = read_model(dense.output).cameras.values()
    assert camera.model_name == MODEL
    assert dense.num_points > 3 * dense.num_model_points
    assert dense.mean_error < 0.5
    made = read_model(dense.output)
    stored = [point.error for point in made.points3D.values()]
    made.update_point_3d_errors()
    true = [point.error for point in made.points3D.values()]
    assert np.allclose(stored, true, atol=1e-3)
    assert dense.mean_error == pytest.approx(np.mean(true), abs=1e-3)

"""A rendered fisheye clip through every stage, with exact poses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from benchmarks import room
from conftest import Encode
from synthetic_scene import alignment_error

from colmap_av1 import (
    CameraOptions,
    DensifyOptions,
    DensityOptions,
    ImageOptions,
    MapOptions,
    MapperOptions,
    MatchOptions,
    ReconstructOptions,
    TriangulateOptions,
    densify,
    map_database,
    match,
    reconstruct,
)
from colmap_av1.geometry.colmap_model import camera_centres, posed_images, read_model

WIDTH, HEIGHT, FOCAL, NUM_FRAMES = 320, 240, 155.0, 20
MODEL = "OPENCV_FISHEYE"
MATCHING = MatchOptions(
    camera=CameraOptions(camera_model=MODEL), density=DensityOptions(preset="sparse")
)


@dataclass(frozen=True)
class Clip:
    """A clip of a lens that sees 118 degrees across, and its exact poses."""

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
    """RMS distance of the camera centres in metres, of a path of 1.9 m; all frames have a pose."""
    images = posed_images(read_model(model))
    assert len(images) == NUM_FRAMES
    frames = [int(name[6:12]) for name in images]
    found = camera_centres(np.array([image.cam_from_world for image in images.values()]))
    return alignment_error(found, camera_centres(clip.cam_from_world[frames]))


def test_intrinsics_are_found(clip: Clip, tmp_path: Path) -> None:
    """And the model is undistorted for trainers."""
    options = ReconstructOptions(
        match=MATCHING,
        mapping=MapperOptions(pose_tracks_per_image=400),
        triangulate=TriangulateOptions(points="survey"),
    )
    report = reconstruct(clip.video, tmp_path / "out", options=options)
    model = read_model(report.output / "sparse" / "0")
    assert [camera.model_name for camera in model.cameras.values()] == ["PINHOLE"]
    assert error(report.output / "sparse" / "0", clip) < 0.01
    assert report.mean_error < 0.5


def test_camera_stays_what_it_is(clip: Clip, tmp_path: Path) -> None:
    """In the database, the mapper's model, and that with dense points."""
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

"""Point clouds for splatting of the rendered clip, compared with its exact surfaces."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import render_scene
from dense_scene import OPTIONS, SCENE, Truth

from colmap_av1.densify import densify
from colmap_av1.geometry.colmap_model import (
    ModelImage,
    camera_centres,
    point_positions,
    write_model,
)
from colmap_av1.geometry.coverage import coverage_of_model
from colmap_av1.geometry.model_points import ModelPoints
from colmap_av1.options import DensifyOptions, ImageOptions, MatchOptions, TriangulateOptions
from colmap_av1.reconstruct import ReconstructReport, reconstruct
from colmap_av1.video.decoding import decode_frames

FRAMES = range(0, 60, 2)
SPLATS = DensifyOptions(match=MatchOptions(images=ImageOptions(first_number=0)))


@pytest.fixture(scope="module")
def true_model(truth: Truth, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model of the exact poses, without points and without image files."""
    folder = tmp_path_factory.mktemp("true")
    write_poses(folder, truth, truth.camera)
    return folder


def write_poses(folder: Path, truth: Truth, camera: pycolmap.Camera) -> None:
    images = [
        ModelImage(i + 1, f"{frame:04d}.png", 7, truth.cam_from_world[frame])
        for i, frame in enumerate(FRAMES)
    ]
    write_model(folder, {7: camera}, images, ModelPoints.empty())


@pytest.fixture(scope="module")
def dense(true_model: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("dense") / "model"
    report = densify(true_model, SCENE, output, options=SPLATS)
    assert report.coverage > 0.99
    assert report.model_coverage == 0.0
    assert report.coverage == coverage_of_model(pycolmap.Reconstruction(output))
    return output


def errors(model: pycolmap.Reconstruction) -> np.ndarray:
    return np.array([model.points3D[i].error for i in sorted(model.points3D)])


def test_points_lie_on_the_surfaces(dense: Path) -> None:
    """Errors are relative to the distance, for observed points and for those that fill holes."""
    model = pycolmap.Reconstruction(dense)
    xyz = point_positions(model)
    centres = np.array([model.images[i].projection_center() for i in sorted(model.images)])
    away = np.linalg.norm(xyz[:, None] - centres[None, ::5], axis=2).min(axis=1)
    off = np.abs(render_scene.surface_distance(render_scene.build_scene(), xyz)) / away
    is_seen = errors(model) >= 0
    assert is_seen.sum() > 10_000
    assert 20 < (~is_seen).sum() < 0.03 * len(xyz)
    assert np.median(off[is_seen]) < 0.005
    assert np.quantile(off[is_seen], 0.95) < 0.1
    # Filled points have no measured depth: few points, and even fewer with large errors.
    assert np.median(off[~is_seen]) < 0.05
    assert (off[~is_seen] > 0.1).sum() < 0.003 * len(xyz)


def test_no_point_floats_in_front_of_the_nearest_surface(dense: Path, truth: Truth) -> None:
    """Tested inside and around the images, with a tolerance for depth noise."""
    xyz = point_positions(pycolmap.Reconstruction(dense))
    fx, fy, cx, cy = truth.camera.params
    for frame in FRAMES:
        pose = truth.cam_from_world[frame]
        x, y, z = pose[:, :3] @ xyz.T + pose[:, 3:]
        seen = (z > 0) & (np.abs(x / z) * fx < cx) & (np.abs(y / z) * fy < cy)
        assert z[seen].min() > 0.97 * truth.depth[frame].min()
    centres = camera_centres(truth.cam_from_world)
    nearest = render_scene.surface_distance(render_scene.build_scene(), centres)
    for centre, least in zip(centres, np.abs(nearest), strict=True):
        assert np.linalg.norm(xyz - centre, axis=1).min() > 0.97 * least


def test_colours_and_observations_match_the_pictures(dense: Path) -> None:
    model = pycolmap.Reconstruction(dense)
    pictures = {i: picture for i, picture in decode_frames(SCENE) if i in (0, 30)}
    for frame, picture in pictures.items():
        image = next(i for i in model.images.values() if i.name == f"{frame:04d}.png")
        points = [model.points3D[p.point3D_id] for p in image.points2D]
        xy = np.array([p.xy for p in image.points2D])
        assert ((xy >= 0) & (xy < (640, 360))).all()
        colours = np.array([p.color for p in points], int)
        column, row = xy.astype(int).T
        off = np.abs(colours - picture[row, column, ::-1].astype(int)).max(axis=1)
        filled = np.array([p.error < 0 for p in points])
        assert np.median(off) < 12
        assert filled.any()
        assert np.median(off[filled]) < 12
    assert min(p.track.length() for p in model.points3D.values()) >= 1


def test_images_may_be_smaller_than_the_video(truth: Truth, tmp_path: Path) -> None:
    """Few tracks have 25 observations, so that most points are found in the pictures."""
    half = pycolmap.Camera(truth.camera.todict())
    half.rescale(0.5)
    (tmp_path / "true").mkdir()
    write_poses(tmp_path / "true", truth, half)
    long_tracks = replace(SPLATS, triangulate=TriangulateOptions(min_observations=25))
    report = densify(tmp_path / "true", SCENE, tmp_path / "dense", options=long_tracks)
    assert report.coverage > 0.99
    xyz = point_positions(pycolmap.Reconstruction(tmp_path / "dense"))
    centres = camera_centres(truth.cam_from_world)
    away = np.linalg.norm(xyz[:, None] - centres[None, ::10], axis=2).min(axis=1)
    off = np.abs(render_scene.surface_distance(render_scene.build_scene(), xyz)) / away
    assert np.median(off) < 0.005
    assert np.quantile(off, 0.95) < 0.05


def test_max_points_limits_the_cloud(true_model: Path, tmp_path: Path) -> None:
    bounded = replace(SPLATS, triangulate=TriangulateOptions(max_points=3000))
    report = densify(true_model, SCENE, tmp_path / "few", options=bounded)
    assert 2900 < report.num_points <= 3000
    assert report.coverage > 0.9


def test_reconstruct_changes_survey_points_to_splats(
    made: ReconstructReport, tmp_path: Path
) -> None:
    """A resumed run only computes the points again, and can return to survey points."""
    output = tmp_path / "scene"
    shutil.copytree(made.output, output)
    options = replace(OPTIONS, triangulate=TriangulateOptions())
    report = reconstruct(SCENE, output, options=options)
    assert "adjustment" in report.resumed
    assert "model" not in report.resumed
    assert report.coverage > 0.99 > made.coverage
    assert report.num_points < made.num_points
    model = pycolmap.Reconstruction(output / "sparse" / "0")
    assert model.num_points3D() == report.num_points
    assert report.num_observations == sum(p.track.length() for p in model.points3D.values())
    known = errors(model)
    assert report.mean_error == pytest.approx(known[known >= 0].mean())
    again = reconstruct(SCENE, output, options=OPTIONS)
    assert again.num_points == made.num_points
    path = Path("sparse", "0", "points3D.bin")
    assert (output / path).read_bytes() == (made.output / path).read_bytes()

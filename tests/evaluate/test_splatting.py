from __future__ import annotations

import math
import os
import sys
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from conftest import PROJECT

from colmap_av1.errors import EvaluationError, ModelError
from colmap_av1.evaluate.metrics.renderings import RenderingMetrics
from colmap_av1.evaluate.training import trainers
from colmap_av1.evaluate.training.splatting import (
    Milestone,
    quality_after,
    share_of_time,
    split_images,
    write_scene,
)
from colmap_av1.evaluate.training.trainers import Training, train, write_split
from colmap_av1.geometry.colmap_model import ModelImage, write_model
from colmap_av1.geometry.model_points import ModelPoints

# A Python with torch, gsplat and pytorch-msssim, which are too large to be always installed.
TORCH_PYTHON = os.environ.get("COLMAP_AV1_TORCH_PYTHON")
SIZE = 32, 24
FOCAL = 24.0


def texture(xyz: np.ndarray) -> np.ndarray:
    """Colours [n, 3], 0 to 1, of points on the plane z = 4."""
    x, y = xyz[..., 0], xyz[..., 1]
    waves = [np.sin(2 * x + y), np.cos(1.5 * x - 2 * y), np.sin(x) * np.cos(y)]
    return 0.5 + 0.4 * np.stack(waves, -1)


def photograph(centre: np.ndarray) -> np.ndarray:
    columns, rows = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    rays = np.stack([(columns - SIZE[0] / 2) / FOCAL, (rows - SIZE[1] / 2) / FOCAL], -1)
    seen = centre[:2] + rays * (4 - centre[2])
    return (texture(seen)[..., ::-1] * 255).round().astype(np.uint8)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Folders of a model with eight cameras in front of a plane, and of its images."""
    folder = tmp_path_factory.mktemp("scene")
    model, image_path = folder / "model", folder / "images"
    model.mkdir()
    image_path.mkdir()
    camera = pycolmap.Camera(
        *(),
        model="PINHOLE",
        width=SIZE[0],
        height=SIZE[1],
        params=[FOCAL, FOCAL, SIZE[0] / 2, SIZE[1] / 2],
        camera_id=1,
    )
    images = []
    for i in range(8):
        centre = np.array([0.2 * i - 0.7, 0.1 * (i % 3), 0.0])
        name = f"frame_{i:06d}.png"
        cv2.imwrite(str(image_path / name), photograph(centre))
        images.append(ModelImage(i + 1, name, 1, np.column_stack([np.eye(3), -centre])))
    rng = np.random.default_rng(0)
    xyz = np.column_stack([rng.uniform(-3, 3, 80), rng.uniform(-2, 2, 80), np.full(80, 4.0)])
    points = ModelPoints(
        xyz=xyz,
        rgb=(texture(xyz) * 255).astype(np.uint8),
        error=np.zeros(80),
        offsets=np.zeros(81, dtype=np.int64),
        image=np.empty(0, dtype=np.int64),
        xy=np.empty((0, 2)),
    )
    write_model(model, {1: camera}, images, points)
    return model, image_path


def milestone(iteration: int, seconds: float, psnr: float) -> Milestone:
    values = np.array([psnr - 1, psnr + 1])
    return Milestone(iteration, seconds, 9, RenderingMetrics(*[values] * 5, None, "no weights"))


def test_images_are_split_evenly() -> None:
    assert split_images(["c", "a", "b"]) == (["a", "c"], ["b"])


def test_share_of_time_to_the_same_quality() -> None:
    baseline = [milestone(1, 10, 20), milestone(2, 40, 25)]
    assert share_of_time(baseline, baseline) == 1
    quick = [milestone(1, 10, 24), milestone(2, 20, 26), milestone(3, 30, 27)]
    assert share_of_time(quick, baseline) == 15 / 40
    assert share_of_time([milestone(1, 8, 25)], baseline) == 0.2
    assert share_of_time([milestone(1, 8, 24.9)], baseline) is None
    # VMAF has the same values here.
    assert share_of_time(quick, baseline, "vmaf") == 15 / 40
    assert share_of_time([milestone(1, math.nan, 26)], baseline) is None
    assert share_of_time(quick, [milestone(1, math.nan, 25)]) is None


def test_quality_after_seconds() -> None:
    milestones = [milestone(1, 10, 20), milestone(2, 40, 26)]
    assert quality_after(milestones, 9.9) is None
    found = [quality_after(milestones, seconds) for seconds in (10, 25, 40, 99)]
    assert found == [20, 23, 26, 26]
    assert quality_after([milestone(1, math.nan, 20)], 10) is None
    assert quality_after([], 10) is None


def test_written_scene_matches_the_model(scene: tuple[Path, Path], tmp_path: Path) -> None:
    write_scene(*scene, tmp_path / "scene.npz")
    arrays = np.load(tmp_path / "scene.npz")
    assert arrays["files"].tolist() == [str(scene[1] / f"frame_{i:06d}.png") for i in range(8)]
    assert arrays["is_test"].tolist() == [False, True] * 4
    np.testing.assert_array_equal(arrays["K"][3], [[24, 0, 16], [0, 24, 12], [0, 0, 1]])
    np.testing.assert_allclose(arrays["cam_from_world"][2, :, 3], [0.3, -0.2, 0, 1], atol=1e-6)
    distances = np.linalg.norm(arrays["points"] - arrays["points"][0], axis=1)
    assert arrays["spacing"][0] == pytest.approx(np.sort(distances)[1:4].mean(), rel=1e-5)
    np.testing.assert_allclose(arrays["colors"], texture(arrays["points"]), atol=1 / 255)


def test_distorted_cameras_are_refused(scene: tuple[Path, Path], tmp_path: Path) -> None:
    model = pycolmap.Reconstruction(scene[0])
    camera = model.cameras[1]
    camera.model, camera.params = pycolmap.CameraModelId.SIMPLE_RADIAL, [24, 16, 12, 0.1]
    model.write(tmp_path)
    with pytest.raises(ModelError, match="undistort"):
        write_scene(tmp_path, scene[1], tmp_path / "scene.npz")


def train_with_gsplat(scene: tuple[Path, Path], folder: Path, *milestones: int) -> Training:
    split = write_split(*scene, folder / "split")
    *stops, iterations = milestones
    folder = folder / "training"
    return train("gsplat", split, folder, name="av1", iterations=iterations, milestones=stops)


def test_missing_packages_and_gpu_are_reported(
    scene: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    missing = "torch"
    if TORCH_PYTHON is not None:
        monkeypatch.setattr(sys, "executable", TORCH_PYTHON)
        missing = "CUDA"
    with pytest.raises(EvaluationError, match=rf"{missing}.*log\.txt"):
        train_with_gsplat(scene, tmp_path, 1)


@pytest.mark.slow
@pytest.mark.skipif(TORCH_PYTHON is None, reason="COLMAP_AV1_TORCH_PYTHON is not set")
def test_training_on_cpu(
    scene: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Tests everything except gsplat's rasterizer, which needs a GPU."""
    script = tmp_path / "program.py"
    aid = PROJECT / "tests" / "support" / "splatting_on_cpu.py"
    script.write_text(
        f"import runpy, sys\nsys.argv.insert(1, {str(trainers._PROGRAM)!r})\n"
        f"runpy.run_path({str(aid)!r}, run_name='__main__')\n"
    )
    monkeypatch.setattr(trainers, "_PROGRAM", script)
    monkeypatch.setattr(sys, "executable", TORCH_PYTHON)
    training = train_with_gsplat(scene, tmp_path, 1, 1400)
    first, last = training.states
    assert (first.iteration, last.iteration) == (1, 1400)
    assert first.num_gaussians == 80 < last.num_gaussians
    assert 0 < first.seconds < last.seconds == training.seconds
    # The test images are not used for training.
    assert last.metrics.psnr_y.mean() > first.metrics.psnr_y.mean() + 6
    assert len(last.metrics.psnr_y) == len(training.renders) == 4

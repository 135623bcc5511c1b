"""3D Gaussians trained on half of a model's images and evaluated on the other half."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
import pycolmap
import scipy.spatial
from numpy.typing import NDArray

from colmap_av1.errors import EvaluationError, ModelError, OptionError
from colmap_av1.evaluate.metrics.renderings import RenderingMetrics, rendering_metrics
from colmap_av1.geometry.cameras import is_undistorted
from colmap_av1.geometry.colmap_model import read_model
from colmap_av1.util.processes import bound

_PROGRAM = Path(__file__).with_name("train_gaussians.py")
# Of other points, whose mean distance is the first size of a point's Gaussian.
_NUM_NEIGHBOURS = 3


@dataclass(frozen=True)
class Milestone:
    """The state of a training.

    Attributes:
        iteration: iterations done.
        seconds: time spent training until then, rendering of test images not counted; NaN where
            the trainer does not tell.
        num_gaussians: Gaussians; None likewise.
        metrics: of the renderings of the test images.
    """

    iteration: int
    seconds: float
    num_gaussians: int | None
    metrics: RenderingMetrics

    def mean(self, quality: str) -> float:
        """Mean over the images of one of the `RenderingMetrics`."""
        return float(getattr(self.metrics, quality).mean())


def split_images(names: Sequence[str]) -> tuple[list[str], list[str]]:
    """The images to train on and those to test on: even and odd ones, in the order of names."""
    ordered = sorted(names)
    return ordered[::2], ordered[1::2]


def train_gaussians(
    model: Path,
    image_path: Path,
    output: Path,
    *,
    iterations: int = 30_000,
    milestones: Sequence[int] = (),
    seed: int = 0,
    progress: Callable[[int], None] | None = None,
    python: str = sys.executable,
    program: Path = _PROGRAM,
) -> list[Milestone]:
    """Train 3D Gaussians by the published recipe, with gsplat on a GPU.

    The recipe is that of B. Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field
    Rendering" (2023); with fewer than its 30,000 iterations, Gaussians are added in the first
    half of them.

    Args:
        model: folder of a COLMAP model with PINHOLE cameras, or others without distortion.
        image_path: folder of its images.
        output: folder that gets the renderings of the test images, in a folder for each
            milestone, named by the iteration.
        iterations: how many.
        milestones: iterations after which the test images are rendered; the last one always is.
        seed: of the order of the images.
        progress: called with the number of iterations done so far.
        python: the interpreter that has torch and gsplat.
        program: what it runs.

    Raises:
        ModelError: the model cannot be read, its cameras have distortion, or it has fewer than
            two images or five points.
        OptionError: an option has a value that cannot work.
        EvaluationError: packages or the GPU are missing, or the training failed.
    """
    if iterations < 1 or any(not 1 <= m <= iterations for m in milestones):
        raise OptionError(
            f"iterations is {iterations}, milestones are {list(milestones)}: give 1 "
            "or more, and milestones up to that"
        )
    stops = sorted({*milestones, iterations})
    output.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        scene = Path(folder) / "scene.npz"
        test_files = write_scene(model, image_path, scene)
        numbers = [str(n) for n in (iterations, seed, *stops)]
        command = [python, str(program), str(scene), str(output), *numbers]
        states = _run(command, Path(folder) / "log.txt", progress)
    done = []
    for state in states:
        rendered = [output / str(state["iteration"]) / f"{f.stem}.png" for f in test_files]
        metrics = rendering_metrics(rendered, test_files)
        done.append(
            Milestone(state["iteration"], state["seconds"], state["num_gaussians"], metrics)
        )
    return done


def share_of_time(
    milestones: Sequence[Milestone], baseline: Sequence[Milestone], quality: str = "psnr_y"
) -> float | None:
    """Time until the baseline's final quality is reached, as a share of the baseline's time.

    Between milestones it counts as rising evenly. None where it is never reached, or a time is not
    known.

    Args:
        milestones: of a training, in order.
        baseline: of the training whose end it is held against.
        quality: which of `RenderingMetrics`, its mean over the images.
    """
    if any(math.isnan(milestone.seconds) for milestone in (*milestones, baseline[-1])):
        return None
    goal = baseline[-1].mean(quality)
    before: tuple[float, float] | None = None
    for milestone in milestones:
        now = milestone.seconds, milestone.mean(quality)
        if now[1] >= goal:
            seconds = now[0]
            if before is not None:
                rise = (goal - before[1]) / (now[1] - before[1])
                seconds = before[0] + rise * (now[0] - before[0])
            return seconds / baseline[-1].seconds
        before = now
    return None


def quality_after(
    milestones: Sequence[Milestone], seconds: float, quality: str = "psnr_y"
) -> float | None:
    """Quality after so many seconds of training, as `share_of_time` has it between milestones.

    What was complete by then counts as it ended. None before the first milestone, or where a time
    is not known.
    """
    times = [milestone.seconds for milestone in milestones]
    if not times or any(math.isnan(time) for time in times) or seconds < times[0]:
        return None
    return float(np.interp(seconds, times, [m.mean(quality) for m in milestones]))


def write_scene(model: Path, image_path: Path, path: Path) -> list[Path]:
    """Write cameras and points of a model as plain arrays, readable without pycolmap.

    The file holds, for n images and m points: `files` [n], `is_test` bool [n], `cam_from_world`
    float32 [n, 4, 4], `K` float32 [n, 3, 3]; `points` float32 [m, 3], `colors` float32 [m, 3]
    from 0 to 1, `spacing` float32 [m], the mean distance to the three nearest other points.

    Args:
        model: folder of the model.
        image_path: folder of its images.
        path: the .npz file.

    Returns:
        The files of the test images.

    Raises:
        ModelError: as `train_gaussians` says.
    """
    reconstruction = read_model(model)
    images = sorted(reconstruction.images.values(), key=lambda image: str(image.name))
    images = [image for image in images if image.has_pose]
    if len(images) < 2 or len(reconstruction.points3D) <= _NUM_NEIGHBOURS + 1:
        raise ModelError(
            f"{model}: {len(images)} images and {len(reconstruction.points3D)} points: 3D "
            "Gaussians need two images and five points"
        )
    test = set(split_images([image.name for image in images])[1])
    poses = np.tile(np.eye(4, dtype=np.float32), (len(images), 1, 1))
    poses[:, :3] = [image.cam_from_world().matrix() for image in images]
    points = reconstruction.points3D.values()
    xyz = np.array([point.xyz for point in points])
    files = [image_path / image.name for image in images]
    np.savez(
        path,
        files=np.array([str(file) for file in files]),
        is_test=np.array([image.name in test for image in images]),
        cam_from_world=poses,
        K=np.array([_intrinsics(model, image.camera) for image in images], dtype=np.float32),
        points=xyz.astype(np.float32),
        colors=np.array([point.color for point in points], dtype=np.float32) / 255,
        spacing=_spacing(xyz),
    )
    return [file for file, image in zip(files, images, strict=True) if image.name in test]


def _intrinsics(model: Path, camera: pycolmap.Camera) -> NDArray[np.float64]:
    if not is_undistorted(camera):
        raise ModelError(
            f"{model}: camera {camera.camera_id} is {camera.model_name}: undistort the images first"
        )
    return np.asarray(camera.calibration_matrix())


def _spacing(xyz: NDArray[np.float64]) -> NDArray[np.float32]:
    """Mean distance of each point to the nearest others."""
    distance, _ = scipy.spatial.KDTree(xyz).query(xyz, k=_NUM_NEIGHBOURS + 1)
    return np.asarray(distance[:, 1:].mean(axis=1), dtype=np.float32)


def _run(
    command: list[str], log: Path, progress: Callable[[int], None] | None
) -> list[dict[str, Any]]:
    """Run the program, and return the milestones that it reports."""
    states = []
    with (
        log.open("w+", encoding="utf-8", errors="replace") as errors,
        subprocess.Popen(
            bound(command), stdout=subprocess.PIPE, stderr=errors, text=True
        ) as process,
    ):
        try:
            output: IO[str] = process.stdout  # type: ignore[assignment]
            for line in output:
                state = json.loads(line)
                if state.pop("milestone"):
                    states.append(state)
                if progress is not None:
                    progress(state["iteration"])
        except BaseException:
            process.terminate()
            raise
        if process.wait() != 0:
            errors.seek(0)
            said = errors.read().strip().splitlines()
            raise EvaluationError(said[-1] if said else f"{command[1]} ended without a word")
    return states

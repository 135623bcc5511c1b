"""The scene that 3D Gaussians are trained on with gsplat, and the milestones of a training."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
import scipy.spatial
from numpy.typing import NDArray

from colmap_av1.errors import ModelError
from colmap_av1.evaluate.metrics.renderings import RenderingMetrics
from colmap_av1.geometry.cameras import is_undistorted
from colmap_av1.geometry.colmap_model import point_colours, point_positions, read_model
from colmap_av1.util.arrays import Floats

# The mean distance to this many nearest points is the initial size of a point's Gaussian.
_NUM_NEIGHBOURS = 3


@dataclass(frozen=True)
class Milestone:
    """State of a training after some iterations.

    Attributes:
        iteration: number of iterations done.
        seconds: training time until then, without rendering test images; NaN if the trainer does
            not report it.
        num_gaussians: number of Gaussians; None if the trainer does not report it.
        metrics: metrics of the renderings of the test images.
    """

    iteration: int
    seconds: float
    num_gaussians: int | None
    metrics: RenderingMetrics

    def mean(self, quality: str) -> float:
        """Mean over the images of one field of `RenderingMetrics`."""
        return float(getattr(self.metrics, quality).mean())


def split_images(names: Sequence[str]) -> tuple[list[str], list[str]]:
    """Training and test images: the even and odd ones in the order of their names."""
    ordered = sorted(names)
    return ordered[::2], ordered[1::2]


def share_of_time(
    milestones: Sequence[Milestone], baseline: Sequence[Milestone], quality: str = "psnr_y"
) -> float | None:
    """Time until the baseline's final quality is reached, as a share of the baseline's time.

    Quality is interpolated linearly between milestones.

    Args:
        milestones: milestones of a training, in order.
        baseline: milestones of the training to compare with.
        quality: field of `RenderingMetrics`, of which the mean over the images counts.

    Returns:
        The share; None if the quality is never reached or a time is unknown.
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
    """Quality after a training time, interpolated linearly between milestones.

    A training that had finished by then counts with its final quality. None before the first
    milestone, or if a time is unknown.
    """
    times = [milestone.seconds for milestone in milestones]
    if not times or any(math.isnan(time) for time in times) or seconds < times[0]:
        return None
    return float(np.interp(seconds, times, [m.mean(quality) for m in milestones]))


def write_scene(model: Path, image_path: Path, path: Path) -> None:
    """Write cameras and points of a model as plain arrays, for the program without pycolmap.

    The file contains, for n images and m points: `files` [n], `is_test` bool [n], `cam_from_world`
    float32 [n, 4, 4], `K` float32 [n, 3, 3]; `points` float32 [m, 3], `colors` float32 [m, 3]
    from 0 to 1, `spacing` float32 [m], the mean distance to the three nearest other points.

    Args:
        model: folder of the model.
        image_path: folder of its images.
        path: the .npz file.

    Raises:
        ModelError: the model cannot be read, its cameras have distortion, or it has fewer than
            two images or five points.
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
    xyz = point_positions(reconstruction)
    np.savez(
        path,
        files=np.array([str(image_path / image.name) for image in images]),
        is_test=np.array([image.name in test for image in images]),
        cam_from_world=poses,
        K=np.array([_intrinsics(model, image.camera) for image in images], dtype=np.float32),
        points=xyz.astype(np.float32),
        colors=point_colours(reconstruction).astype(np.float32) / 255,
        spacing=_spacing(xyz),
    )


def _intrinsics(model: Path, camera: pycolmap.Camera) -> Floats:
    if not is_undistorted(camera):
        raise ModelError(
            f"{model}: camera {camera.camera_id} is {camera.model_name}: undistort the images first"
        )
    return np.asarray(camera.calibration_matrix())


def _spacing(xyz: Floats) -> NDArray[np.float32]:
    """Mean distance of each point to its nearest neighbours."""
    distance, _ = scipy.spatial.KDTree(xyz).query(xyz, k=_NUM_NEIGHBOURS + 1)
    return np.asarray(distance[:, 1:].mean(axis=1), dtype=np.float32)

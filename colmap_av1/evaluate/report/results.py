"""What `compare` measures."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_av1.check.model_figures import ModelFigures
from colmap_av1.evaluate.metrics.clouds import CloudDistances
from colmap_av1.evaluate.metrics.poses import PoseErrors
from colmap_av1.evaluate.training.trainers import Training


@dataclass(frozen=True)
class Column:
    """Results and costs of one front-end.

    Attributes:
        name: the front-end, with " + all tracks" where all tracks are on the poses of its model.
        error: why figures are missing; empty where none are.
        seconds: wall time of each stage.
        cpu_seconds: CPU time of the front-end ("matching") and of what makes the model ("mapping").
        peak_memory: largest resident memory of any stage in bytes; None where unknown.
        num_models: models that the mapper made; the one with the most images is measured.
        model_path: its folder; None where there is none.
        model: its figures.
        track_lengths: points by the number of images that see them.
        cloud: distances to the reference's cloud; None where there is none, or it is this one.
        poses: errors of the poses against the reference's; None likewise.
        training: 3D Gaussians trained on the model; None where nothing was.
        training_error: why not, where something was to be.
    """

    name: str
    error: str = ""
    seconds: dict[str, float] = dataclasses.field(default_factory=dict)
    cpu_seconds: dict[str, float] = dataclasses.field(default_factory=dict)
    peak_memory: int | None = None
    num_models: int = 0
    model_path: Path | None = None
    model: ModelFigures | None = None
    track_lengths: dict[int, int] = dataclasses.field(default_factory=dict)
    cloud: CloudDistances | None = None
    poses: PoseErrors | None = None
    training: Training | None = None
    training_error: str = ""


@dataclass(frozen=True)
class Cloud:
    """The points and cameras of a column.

    Attributes:
        points: float64 [n, 3].
        colours: uint8 [n, 3], red first.
        observable: bool [n] points of observable depth, see `has_observable_depth`.
        cam_from_world: float64 [num_images, 3, 4], NaN for images without a pose.
        focal_length: of the first camera, in pixels.
        is_aligned: these are the reference's coordinates, not its own.
    """

    points: NDArray[np.float64]
    colours: NDArray[np.uint8]
    observable: NDArray[np.bool_]
    cam_from_world: NDArray[np.float64]
    focal_length: float
    is_aligned: bool


@dataclass(frozen=True)
class CompareReport:
    """What `compare` measured.

    Attributes:
        output: the folder with `report.html` and `results.json`.
        video: the video.
        num_frames: its shown frames.
        num_images: images that every front-end was given.
        size: (width, height) of the images.
        fixed_intrinsics: the mapper kept the given intrinsics.
        forward_motion: the mapper could start with images behind each other.
        cloud_reference: whose cloud the distances are measured to; empty where to none.
        pose_reference: whose poses the errors are measured against; empty where against none.
        is_truth: that is a given truth, in its unit, not the model of a front-end.
        columns: the front-ends.
        warnings: what the user should know.
    """

    output: Path
    video: Path
    num_frames: int
    num_images: int
    size: tuple[int, int]
    fixed_intrinsics: bool
    forward_motion: bool
    cloud_reference: str
    pose_reference: str
    is_truth: bool
    columns: tuple[Column, ...]
    warnings: tuple[str, ...]

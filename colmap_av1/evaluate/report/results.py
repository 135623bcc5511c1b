"""The results of `compare`."""

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
from colmap_av1.util.arrays import Bools, Floats

# The front-ends that others are compared with, the preferred one first. Without a given reference,
# the model of the first is the pseudo truth.
BASELINES = ("sift-exhaustive", "sift-sequential")
# End of the name of a column with all tracks.
ALL_TRACKS = " + all tracks"


@dataclass(frozen=True)
class Column:
    """Results and costs of one front-end.

    Attributes:
        name: name of the front-end, with " + all tracks" if all tracks were triangulated on the
            poses of its model.
        error: why results are missing; empty if there was no error.
        warnings: warnings about the results.
        seconds: wall time of each stage.
        cpu_seconds: CPU time of the stages "conversion", if the video was converted, "matching",
            "mapping" and "all tracks".
        peak_memory: largest resident memory of any stage in bytes; None if unknown.
        num_models: number of models from the mapper; the one with the most images is measured.
        model_path: folder of this model; None without a model.
        model: figures of the model.
        track_lengths: number of points by the number of images that observe them.
        cloud: distances to the reference cloud; None without one, or if this is the reference.
        poses: errors against the reference poses; None without them, or if these are the reference.
        training: result of training 3D Gaussians on the model; None without training.
        training_error: why a requested training is missing.
    """

    name: str
    error: str = ""
    warnings: tuple[str, ...] = ()
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
        focal_length: focal length of the first camera in pixels.
        is_aligned: whether the coordinates are those of the reference, not the model's own.
    """

    points: Floats
    colours: NDArray[np.uint8]
    observable: Bools
    cam_from_world: Floats
    focal_length: float
    is_aligned: bool


@dataclass(frozen=True)
class CompareReport:
    """Result of `compare`.

    Attributes:
        output: the folder with `report.html` and `results.json`.
        video: the video.
        num_frames: number of shown frames of the video.
        num_images: number of images that every front-end got.
        size: (width, height) of the images in pixels.
        fixed_intrinsics: whether the mapper kept the given intrinsics.
        forward_motion: whether the mapper could initialize with pairs of forward motion.
        cloud_reference: path or front-end of the reference cloud; empty without one.
        pose_reference: path or front-end of the reference poses; empty without them.
        is_truth: whether the reference is given ground truth, not the model of a front-end.
        columns: results of the front-ends.
        warnings: warnings for the user.
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

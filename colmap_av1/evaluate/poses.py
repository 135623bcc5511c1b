"""Errors of estimated poses after similarity alignment to true ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from colmap_av1.evaluate.sequence import frame_number


@dataclass(frozen=True)
class PoseErrors:
    """How far estimated poses are from the truth.

    Attributes:
        num_poses: frames whose pose is both estimated and known.
        ate: absolute trajectory error: RMS distance of the aligned camera centres, in the
            truth's unit.
        max_centre: the largest of these distances.
        extent: diagonal of the box around the true centres, in the truth's unit.
        rotation: median angle between estimated and true camera orientations, in degrees, under
            the one turn of the world that fits the orientations best.
        max_rotation: the largest of these angles.
    """

    num_poses: int
    ate: float
    max_centre: float
    extent: float
    rotation: float
    max_rotation: float


def pose_errors(
    cam_from_world: NDArray[np.float64], truth: NDArray[np.float64]
) -> PoseErrors | None:
    """Compare poses with the truth after the similarity that fits their centres best (Umeyama).

    Args:
        cam_from_world: float64 [num_frames, 3, 4] estimated poses, NaN where there is none.
        truth: float64 [num_frames, 3, 4] true poses, NaN where unknown.

    Returns:
        The errors, over the frames that have both; None where fewer than three have or where
        their centres determine no similarity.

    Raises:
        ValueError: the two differ in their number of frames.
    """
    if cam_from_world.shape != truth.shape:
        raise ValueError(f"{len(cam_from_world)} estimated poses, {len(truth)} true ones")
    both = np.isfinite(cam_from_world).all((1, 2)) & np.isfinite(truth).all((1, 2))
    if both.sum() < 3:
        return None
    estimated, truth = cam_from_world[both], truth[both]
    centres, true_centres = camera_centres(estimated), camera_centres(truth)
    similarity = pycolmap.estimate_sim3d(centres, true_centres)
    if similarity is None:
        return None
    turn = np.asarray(similarity.rotation.matrix())
    aligned = similarity.scale * centres @ turn.T + np.asarray(similarity.translation)
    distance = np.linalg.norm(aligned - true_centres, axis=1)
    angle = _rotation_errors(estimated[:, :, :3], truth[:, :, :3])
    return PoseErrors(
        num_poses=int(both.sum()),
        ate=float(np.sqrt(np.mean(distance**2))),
        max_centre=float(distance.max()),
        extent=float(np.linalg.norm(np.ptp(true_centres, axis=0))),
        rotation=float(np.median(angle)),
        max_rotation=float(angle.max()),
    )


def camera_centres(cam_from_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """Float64 [n, 3] centres in the world of poses [n, 3, 4]."""
    rotation, translation = cam_from_world[:, :, :3], cam_from_world[:, :, 3]
    return np.asarray(-np.einsum("nij,ni->nj", rotation, translation), dtype=np.float64)


def model_poses(model: Any, num_frames: int) -> NDArray[np.float64]:
    """Poses of a model's registered images, by frame.

    Args:
        model: pycolmap.Reconstruction whose image names hold the frame's number from 0.
        num_frames: number of frames of the video.

    Returns:
        float64 [num_frames, 3, 4] cam_from_world, NaN for frames without a registered image.

    Raises:
        ImageError: an image's name holds no frame number.
    """
    cam_from_world = np.full((num_frames, 3, 4), np.nan)
    for image in model.images.values():
        if image.has_pose:
            cam_from_world[frame_number(image.name)] = image.cam_from_world().matrix()
    return cam_from_world


def _rotation_errors(
    estimated: NDArray[np.float64], truth: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Angles in degrees between orientations [n, 3, 3] under the turn of the world that fits best.

    Not under the turn that fits the centres: these lie nearly on a line where a car drives, and
    leave the turn about it open.
    """
    turn = Rotation.from_matrix(truth.transpose(0, 2, 1) @ estimated).mean()
    between = Rotation.from_matrix(estimated) * turn.inv() * Rotation.from_matrix(truth).inv()
    return np.asarray(np.degrees(between.magnitude()), dtype=np.float64)

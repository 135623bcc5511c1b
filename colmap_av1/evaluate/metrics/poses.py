"""Poses of models and of ground truth, and their errors after similarity alignment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap
from scipy.spatial.transform import Rotation

from colmap_av1.errors import ImageError
from colmap_av1.geometry.alignment import transform_poses
from colmap_av1.geometry.colmap_model import camera_centres, posed_images
from colmap_av1.images.names import last_number
from colmap_av1.util.arrays import Bools, Floats
from colmap_av1.util.texts import read_lines

# Largest error of an inlier of the robust alignment, in the unit of the ground truth.
_ROBUST_ERROR = 1.0
_WHAT_TO_GIVE = "give lines of 'name tx ty tz qx qy qz qw', or the folder of a COLMAP model"


@dataclass(frozen=True)
class PoseErrors:
    """Errors of estimated poses against the ground truth.

    Attributes:
        num_poses: number of frames whose pose is both estimated and known.
        ate: absolute trajectory error: RMS distance of the aligned camera centres, in the unit of
            the ground truth.
        max_centre: the largest of these distances.
        extent: diagonal of the bounding box of the true centres, in the unit of the ground truth.
        rotation: median angle between estimated and true camera orientations, in degrees, after
            the rotation of the world that aligns the orientations best.
        max_rotation: the largest of these angles.
        relative_translation: relative pose error: RMS difference of estimated and true translation
            between consecutive poses, in the unit of the ground truth.
        relative_rotation: RMS angle between estimated and true rotation between consecutive poses,
            in degrees.
        robust_median: median distance of camera centres after robust alignment, in the unit of the
            ground truth: similarity by RANSAC with samples of three and a threshold of 1, as in
            arXiv 2605.14629. Poses that are far off do not affect this alignment.
        robust_rms: RMS distance after the same alignment.
    """

    num_poses: int
    ate: float
    max_centre: float
    extent: float
    rotation: float
    max_rotation: float
    relative_translation: float
    relative_rotation: float
    robust_median: float
    robust_rms: float


def fit_similarity(cam_from_world: Floats, truth: Floats) -> pycolmap.Sim3d | None:
    """The similarity that best aligns camera centres with those of other poses (Umeyama 1991).

    Args:
        cam_from_world: float64 [n, 3, 4] poses, NaN where unknown.
        truth: float64 [n, 3, 4] reference poses, NaN where unknown.

    Returns:
        The similarity from the first to the second; None if fewer than three poses are in both or
        their centres do not determine a similarity.

    Raises:
        ValueError: the two differ in their number of poses.
    """
    both = _in_both(cam_from_world, truth)
    if both.sum() < 3:
        return None
    centres, true_centres = camera_centres(cam_from_world[both]), camera_centres(truth[both])
    shift, true_shift = _shift_off_origin(centres), _shift_off_origin(true_centres)
    found = pycolmap.estimate_sim3d(centres + shift, true_centres + true_shift)
    if found is None:
        return None
    return pycolmap.Sim3d(found.scale, found.rotation, found * shift - true_shift)


def pose_errors(cam_from_world: Floats, truth: Floats) -> PoseErrors | None:
    """Compare poses with ground truth after similarity alignment of their centres.

    Args:
        cam_from_world: float64 [num_frames, 3, 4] estimated poses, NaN where unknown.
        truth: float64 [num_frames, 3, 4] true poses, NaN where unknown.

    Returns:
        The errors over the frames with both poses; None if there are fewer than three or their
        centres do not determine a similarity.

    Raises:
        ValueError: the two differ in their number of frames.
    """
    similarity = fit_similarity(cam_from_world, truth)
    if similarity is None:
        return None
    both = _in_both(cam_from_world, truth)
    aligned = transform_poses(similarity, cam_from_world[both])
    true_centres = camera_centres(truth[both])
    distance = np.linalg.norm(camera_centres(aligned) - true_centres, axis=1)
    angle = _rotation_errors(cam_from_world[both][:, :, :3], truth[both][:, :, :3])
    relative = _relative_errors(aligned, truth[both])
    robust = _robust_distances(camera_centres(cam_from_world[both]), true_centres)
    return PoseErrors(
        num_poses=int(both.sum()),
        ate=float(np.sqrt(np.mean(distance**2))),
        max_centre=float(distance.max()),
        extent=float(np.linalg.norm(np.ptp(true_centres, axis=0))),
        rotation=float(np.median(angle)),
        max_rotation=float(angle.max()),
        relative_translation=relative[0],
        relative_rotation=relative[1],
        robust_median=float(np.median(robust)),
        robust_rms=float(np.sqrt(np.mean(robust**2))),
    )


def _robust_distances(centres: Floats, true_centres: Floats) -> Floats:
    """Distances [n] of centres after robust similarity alignment; NaN if it fails."""
    centres = centres + _shift_off_origin(centres)
    true_centres = true_centres + _shift_off_origin(true_centres)
    options = pycolmap.RANSACOptions(max_error=_ROBUST_ERROR, random_seed=0)
    # pycolmap's type stubs state another type than this dictionary.
    found: Any = pycolmap.estimate_sim3d_robust(centres, true_centres, options)
    if found is None:
        return np.full(len(centres), np.nan)
    moved = found["tgt_from_src"] * centres
    return np.asarray(np.linalg.norm(moved - true_centres, axis=1))


def _shift_off_origin(points: Floats) -> Floats:
    """A shift [3] of points [n, 3] after which no plane through the origin contains them all.

    COLMAP finds no similarity of points in such a plane, as the ground truth of a car often is. All
    points on a line are in such a plane in any case.
    """
    mean = points.mean(axis=0)
    _, sizes, axes = np.linalg.svd(points - mean, full_matrices=False)
    return np.asarray(sizes[0] * axes[-1] - mean)


def image_poses(model: pycolmap.Reconstruction, names: Sequence[str]) -> Floats:
    """Poses of named images of a model.

    Args:
        model: pycolmap.Reconstruction.
        names: names of the images.

    Returns:
        float64 [n, 3, 4] cam_from_world, NaN for images that are not registered.
    """
    found = posed_images(model)
    cam_from_world = np.full((len(names), 3, 4), np.nan)
    for i, name in enumerate(names):
        if name in found:
            cam_from_world[i] = found[name].cam_from_world
    return cam_from_world


def frame_number(name: str) -> int:
    """The frame number in a file name: its last group of digits.

    Raises:
        ImageError: the name has no number.
    """
    number = last_number(name)
    if number is None:
        raise ImageError(f"image '{name}': its name has no frame number: rename it")
    return number


def read_poses(path: Path, num_frames: int) -> Floats:
    """Read true poses from lines of `name tx ty tz qx qy qz qw`.

    They are camera-to-world poses, with x right, y down, z forward. The number in a name is the
    frame index, from 0.

    Args:
        path: the file.
        num_frames: number of frames of the video.

    Returns:
        float64 [num_frames, 3, 4] cam_from_world, NaN for frames without a line.

    Raises:
        ImageError: the file cannot be read, or refers to a frame twice or to one that the video
            lacks.
    """
    cam_from_world = np.full((num_frames, 3, 4), np.nan)
    try:
        lines = read_lines(path)
    except UnicodeDecodeError as error:
        raise ImageError(f"{path}: is not a text file: {_WHAT_TO_GIVE}") from error
    except OSError as error:
        raise ImageError(f"{path}: {error.strerror}: {_WHAT_TO_GIVE}") from error
    for line in lines:
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        frame = frame_number(words[0])
        if frame >= num_frames:
            raise ImageError(
                f"{path}: '{words[0]}' is not one of the {num_frames} frames: give the ground "
                "truth of this video"
            )
        if np.isfinite(cam_from_world[frame]).all():
            raise ImageError(f"{path}: frame {frame} occurs twice: {_WHAT_TO_GIVE}")
        try:
            x, y, z, *quaternion = map(float, words[1:])
            rotation = Rotation.from_quat(quaternion).as_matrix().T
        except ValueError as error:
            raise ImageError(f"{path}: '{line[:80]}' is not a pose: {_WHAT_TO_GIVE}") from error
        cam_from_world[frame] = np.c_[rotation, -rotation @ [x, y, z]]
    return cam_from_world


def _in_both(a: Floats, b: Floats) -> Bools:
    if a.shape != b.shape:
        raise ValueError(f"got {len(a)} estimated and {len(b)} true poses: give as many of both")
    return np.asarray(np.isfinite(a).all((1, 2)) & np.isfinite(b).all((1, 2)))


def _relative_errors(aligned: Floats, truth: Floats) -> tuple[float, float]:
    """RMS errors of translation and rotation (degrees) between consecutive poses."""
    translation, turn = zip(*map(_motions, (aligned, truth)), strict=True)
    distance = np.linalg.norm(translation[0] - translation[1], axis=1)
    angle = np.degrees((turn[0] * turn[1].inv()).magnitude())
    return float(np.sqrt(np.mean(distance**2))), float(np.sqrt(np.mean(angle**2)))


def _motions(cam_from_world: Floats) -> tuple[Floats, Rotation]:
    """Translation, in the first camera's axes, and rotation between consecutive poses."""
    rotation, step = cam_from_world[:, :, :3], np.diff(camera_centres(cam_from_world), axis=0)
    turn = Rotation.from_matrix(rotation[1:] @ rotation[:-1].transpose(0, 2, 1))
    return np.einsum("nij,nj->ni", rotation[:-1], step), turn


def _rotation_errors(estimated: Floats, truth: Floats) -> Floats:
    """Angles in degrees between orientations [n, 3, 3] after the best rotation of the world.

    The rotation that aligns the centres is not suitable: on a nearly straight path the centres do
    not determine the rotation about it.
    """
    turn = Rotation.from_matrix(truth.transpose(0, 2, 1) @ estimated).mean()
    between = Rotation.from_matrix(estimated) * turn.inv() * Rotation.from_matrix(truth).inv()
    return np.asarray(np.degrees(between.magnitude()), dtype=np.float64)

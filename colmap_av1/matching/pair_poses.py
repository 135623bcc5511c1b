"""The pose that COLMAP's mapper gives a pair, and what contradicts it: matches or a known pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import pycolmap

from colmap_av1.matching.epipolar import essential_of_poses, sampson_error
from colmap_av1.matching.matched_images import MatchedImages
from colmap_av1.matching.two_view_geometry import FLAT_CONFIGS, TwoViewGeometry
from colmap_av1.util.arrays import Floats

# About this many inliers decide as well as all of them.
_NUM_SOME = 64
# A rotation is wrong if it differs from a known one by more than this share of the triangulation
# angle.
_WRONG = 0.25
# A homography allows a pose if this share of the points is in front of both cameras.
_FRONT_SHARE = 0.95
# The pose of the homography is wrong if its triangulation angle and its error both exceed those of
# the essential matrix by these factors. If the parallax of nearby images is below the mapper's
# noise limit of 4 px, the angle is two to ten times as large and the error of most matches two to
# twenty times. If the pose is right, the angles differ by less than a third.
_ANGLE_FACTOR = 1.5
_ERROR_FACTOR = 1.5
# The error of a pose is this quantile of its matches' errors.
_ERROR_QUANTILE = 0.9


@dataclass(frozen=True)
class PairInliers:
    """Inliers of a pair.

    Attributes:
        cameras: the cameras of the first and the second image.
        x: float64 [2, n] of each image, normalised undistorted coordinates.
    """

    cameras: tuple[pycolmap.Camera, pycolmap.Camera]
    x: tuple[Floats, Floats]

    @property
    def rays(self) -> list[Floats]:
        """Unit vectors to the inliers, float64 [3, n] of each image."""
        rays = [np.vstack([own, np.ones(own.shape[1])]) for own in self.x]
        return [own / np.linalg.norm(own, axis=0) for own in rays]


def some_inliers(
    matched: MatchedImages,
    cameras: Sequence[pycolmap.Camera],
    pair: Sequence[int],
    geometry: TwoViewGeometry,
) -> PairInliers:
    """Some of the inliers of a pair, with a ray in front of both cameras."""
    step = max(1, len(geometry.inlier_matches) // _NUM_SOME)
    a, b = (
        np.asarray(cameras[image].cam_from_img(matched.keypoints[image].xy[chosen].astype(float)))
        for image, chosen in zip(pair, geometry.inlier_matches[::step].T, strict=True)
    )
    # Some pixels of a wide lens have no such ray.
    is_known = np.isfinite(a + b).all(axis=1)
    return PairInliers((cameras[pair[0]], cameras[pair[1]]), (a[is_known].T, b[is_known].T))


def pair_pose(geometry: TwoViewGeometry, inliers: PairInliers) -> Floats | None:
    """The pose of a pair from its two-view geometry, float64 [3, 4]; None if it has no matrix."""
    if geometry.qvec is not None and geometry.tvec is not None:
        rotation = pycolmap.Rotation3d(np.roll(geometry.qvec, -1)).matrix()
        return np.column_stack([rotation, geometry.tvec])
    if geometry.config in FLAT_CONFIGS and geometry.H is not None:
        return _pose_of_homography(geometry.H, inliers)
    E = geometry.E
    if E is None and geometry.F is not None:
        a, b = (camera.calibration_matrix() for camera in inliers.cameras)
        E = b.T @ geometry.F @ a
    return None if E is None else _pose_of_essential(E, inliers)


def _pose_of_homography(H: Floats, inliers: PairInliers) -> Floats:
    """Decompose a homography into a pose as COLMAP's mapper does, float64 [3, 4]."""
    matrices = [camera.calibration_matrix() for camera in inliers.cameras]
    found = pycolmap.pose_from_homography_matrix(H, *matrices, *(own.T for own in inliers.rays))
    return np.asarray(found["cam2_from_cam1"].matrix())


def rotations_of_homography(geometry: TwoViewGeometry, inliers: PairInliers) -> list[Floats]:
    """The rotations, float64 [3, 3], that the homography of a flat pair allows.

    With two of them, nearly all points are in front of both cameras: the mapper may choose either.
    """
    if geometry.config not in FLAT_CONFIGS or geometry.H is None:
        return []
    a, b = (camera.calibration_matrix() for camera in inliers.cameras)
    H = np.linalg.inv(b) @ geometry.H @ a
    _, rotations, _, normals = cv2.decomposeHomographyMat(H, np.eye(3))
    # Each rotation comes twice, with opposite normals.
    return [
        np.asarray(rotation)
        for rotation, normal in zip(rotations, normals, strict=True)
        if np.mean(normal.ravel() @ inliers.rays[0] > 0.0) >= _FRONT_SHARE
    ]


def angle_if_wrong(
    rotations: Sequence[Floats], known: Floats, rays: Sequence[Floats]
) -> float | None:
    """Largest triangulation angle of the rotations that contradict the known one.

    Args:
        rotations: float64 [3, 3] possible rotations to the second camera.
        known: float64 [3, 3] the known rotation.
        rays: float64 [3, n] unit vectors to the matches of both images.

    Returns:
        The angle in degrees; None if no rotation contradicts the known one.
    """
    angles = [(triangulation_angle(rotation, rays), rotation) for rotation in rotations]
    return max(
        (angle for angle, own in angles if is_wrong_rotation(own, known, angle)),
        default=None,
    )


def _pose_of_essential(E: Floats, inliers: PairInliers) -> Floats:
    """Decompose an essential matrix into the pose with the most points in front of both cameras.

    Returns float64 [3, 4].
    """
    a, b = (np.ascontiguousarray(own.T) for own in inliers.x)
    _, rotation, translation, _ = cv2.recoverPose(E, a, b, np.eye(3))
    return np.column_stack([rotation, translation])


def triangulation_angle(rotation: Floats, rays: Sequence[Floats]) -> float:
    """Median triangulation angle of matches in degrees, given the rotation to the second camera."""
    cosine = ((rotation @ rays[0]) * rays[1]).sum(axis=0)
    return float(np.degrees(np.median(np.arccos(np.clip(cosine, -1.0, 1.0)))))


def is_wrong_rotation(rotation: Floats, known: Floats, angle: float) -> bool:
    """Whether a rotation contradicts the known one, given the triangulation angle in degrees."""
    cosine = (np.trace(rotation @ known.T) - 1.0) / 2.0
    return bool(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))) > _WRONG * angle)


def angle_if_contradicted(geometry: TwoViewGeometry, inliers: PairInliers) -> float | None:
    """Triangulation angle of the homography's pose, if the matches contradict it.

    Args:
        geometry: the geometry of the pair.
        inliers: some of its inliers.

    Returns:
        The angle in degrees; None if the matches agree with the pose, or if the pair is not flat or
        lacks an essential matrix.
    """
    of_pair = geometry.E
    if geometry.config not in FLAT_CONFIGS or of_pair is None or geometry.H is None:
        return None
    pose = _pose_of_homography(geometry.H, inliers)
    angle = triangulation_angle(pose[:, :3], inliers.rays)
    rotation = _pose_of_essential(of_pair, inliers)[:, :3]
    if angle < _ANGLE_FACTOR * triangulation_angle(rotation, inliers.rays):
        return None
    of_pose = essential_of_poses(np.eye(3, 4), pose)
    is_wrong = _error(of_pose, inliers.x) > _ERROR_FACTOR * _error(of_pair, inliers.x)
    return angle if is_wrong else None


def _error(E: Floats, x: Sequence[Floats]) -> float:
    """A high quantile of the Sampson errors, in focal lengths."""
    return float(np.quantile(sampson_error(E, x[0], x[1]), _ERROR_QUANTILE))

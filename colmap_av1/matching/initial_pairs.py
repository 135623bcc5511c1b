"""Demote pairs whose pose would mislead COLMAP's incremental mapper."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_av1.matching.image_matches import MatchedImages
from colmap_av1.matching.mapper_limits import (
    FORWARD_MOTION_OPTIONS,
    INITIAL_MAX_FORWARD_MOTION,
    INITIAL_MIN_ANGLE,
    INITIAL_MIN_INLIERS,
)
from colmap_av1.matching.two_view_geometry import FLAT_CONFIGS, TwoViewGeometry
from colmap_av1.matching.two_view_models import essential_of_poses, sampson_error
from colmap_av1.util.progress import Clock
from colmap_av1.util.spread import evenly_spread

_Floats = NDArray[np.float64]

# If no pair meets the mapper's limits for an initial pair, it halves the number of inliers, then
# the angle.
_MIN_INLIERS = INITIAL_MIN_INLIERS // 2
# The mapper estimates poses anew: it certainly accepts a pair that exceeds its limits by the first
# factor, and may accept one with the second share of the angle.
_MARGIN, _WIDE_SHARE = 1.1, 0.75
# Neighbours, which keep their inliers to connect the images, are at most this many images apart.
NEIGHBOURS = 2
# About this many inliers decide as well as all of them.
_NUM_SOME = 64
# A rotation is wrong if it differs from a known one by more than this share of the triangulation
# angle.
_WRONG = 0.25
# The pose of the homography is wrong if its triangulation angle and its error both exceed those of
# the essential matrix by these factors. If the parallax of nearby images is below the mapper's
# noise limit of 4 px, the angle is two to ten times as large and the error of most matches two to
# twenty times. If the pose is right, the angles differ by less than a third.
_ANGLE_FACTOR = 1.5
_ERROR_FACTOR = 1.5
# The error of a pose is this quantile of its matches' errors.
_ERROR_QUANTILE = 0.9


def demote_bad_initial_pairs(
    matched: MatchedImages,
    cameras: Sequence[pycolmap.Camera],
    clock: Clock,
    known: Sequence[Sequence[_Floats | None]] = (),
) -> tuple[MatchedImages, bool]:
    """Limit the inliers of pairs with a wrong pose from which the mapper might start.

    COLMAP's mapper takes a pair's pose from its homography if that explains most of the matches
    (`EstimateTwoViewGeometryPose`). If the matches or known poses contradict the pose, a model that
    begins with the pair fails after a few images, and the mapper still writes it first. A demoted
    pair keeps enough inliers to connect its images; tracks continue through the pairs between.
    Pairs keep all inliers if the mapper finds a good pair before it lowers its limits to theirs.

    If no pair meets its first limits, it tries hundreds of pairs with few inliers. RANSAC may give
    any of them a wrong pose with a large angle, or intrinsics may diverge. With known poses, these
    pairs are demoted, too, except neighbours, which connect the images.

    If a pair with a known pose meets the mapper's first limits, it needs no options for forward
    motion: somebody who walks through a room moves forward most of the time, but not always.

    Args:
        matched: the images. The pose of the homography is tested only for pairs with an essential
            matrix, which needs known focal lengths.
        cameras: the camera of each image.
        clock: gets the stage "verification".
        known: for each model with known poses, float64 [3, 4] cam_from_world of each image, None if
            it is not in the model. The relative pose of images in different models is not known.

    Returns:
        The images with fewer inliers, without forward motion if the mapper needs no options for it,
        and whether a pair certainly meets the mapper's first limits.
    """
    with clock.measure("verification"):
        wrong = dict[int, float]()
        few = list[int]()
        has_start = False
        for k, (pair, geometry) in enumerate(
            zip(matched.pairs.tolist(), matched.geometries, strict=True)
        ):
            count = len(geometry.inlier_matches)
            if count < _MIN_INLIERS:
                continue
            some = _some_inliers(matched, cameras, pair, geometry)
            pose = _pose(geometry, some)
            if pose is None:
                continue
            angle = _triangulation_angle(pose[:, :3], some.rays)
            flat_angle = _contradicted_angle(geometry, some)
            rotation = _known_rotation(known, pair)
            if flat_angle is not None:
                wrong[k] = flat_angle
            elif rotation is not None and _angle_between(pose[:, :3], rotation) > _WRONG * angle:
                wrong[k] = angle
            elif count >= _MARGIN * INITIAL_MIN_INLIERS:
                is_aside = abs(pose[2, 3]) < INITIAL_MAX_FORWARD_MOTION
                has_start |= is_aside and angle >= _MARGIN * INITIAL_MIN_ANGLE
            if count < _MARGIN * INITIAL_MIN_INLIERS and abs(pair[1] - pair[0]) > NEIGHBOURS:
                few.append(k)
        least = INITIAL_MIN_ANGLE if has_start else INITIAL_MIN_ANGLE / 2
        if matched.forward_motion:
            least = min(least, FORWARD_MOTION_OPTIONS["init_min_tri_angle"])
        geometries = list(matched.geometries)
        bad = {k for k, angle in wrong.items() if angle >= _WIDE_SHARE * least}
        if known and not has_start:
            bad.update(few)
        for k in bad:
            geometries[k] = demoted(geometries[k])
        forward = matched.forward_motion and not (known and has_start)
    return replace(matched, geometries=geometries, forward_motion=forward), has_start


def demoted(geometry: TwoViewGeometry) -> TwoViewGeometry:
    """Keep some of the inliers, evenly spread, too few for an initial pair."""
    count = len(geometry.inlier_matches)
    if count < _MIN_INLIERS:
        return geometry
    chosen = evenly_spread(count, _MIN_INLIERS - 1, rounded=True)
    return replace(geometry, inlier_matches=geometry.inlier_matches[chosen])


def _known_rotation(
    models: Sequence[Sequence[_Floats | None]], pair: Sequence[int]
) -> _Floats | None:
    """The rotation from the first camera of a pair to the second; None if not known."""
    for cam_from_world in models:
        first, second = (cam_from_world[image] for image in pair)
        if first is not None and second is not None:
            return np.asarray(second[:, :3] @ first[:, :3].T)
    return None


@dataclass(frozen=True)
class _PairInliers:
    """Inliers of a pair.

    Attributes:
        cameras: the cameras of the first and the second image.
        x: float64 [2, n] of each image, normalised undistorted coordinates.
    """

    cameras: tuple[pycolmap.Camera, pycolmap.Camera]
    x: tuple[_Floats, _Floats]

    @property
    def rays(self) -> list[_Floats]:
        """Unit vectors to the inliers, float64 [3, n] of each image."""
        rays = [np.vstack([own, np.ones(own.shape[1])]) for own in self.x]
        return [own / np.linalg.norm(own, axis=0) for own in rays]


def _some_inliers(
    matched: MatchedImages,
    cameras: Sequence[pycolmap.Camera],
    pair: Sequence[int],
    geometry: TwoViewGeometry,
) -> _PairInliers:
    """Some of the inliers of a pair, with a ray in front of both cameras."""
    step = max(1, len(geometry.inlier_matches) // _NUM_SOME)
    a, b = (
        np.asarray(cameras[image].cam_from_img(matched.keypoints[image].xy[chosen].astype(float)))
        for image, chosen in zip(pair, geometry.inlier_matches[::step].T, strict=True)
    )
    # Some pixels of a wide lens have no such ray.
    is_known = np.isfinite(a + b).all(axis=1)
    return _PairInliers((cameras[pair[0]], cameras[pair[1]]), (a[is_known].T, b[is_known].T))


def _pose(geometry: TwoViewGeometry, inliers: _PairInliers) -> _Floats | None:
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


def _pose_of_homography(H: _Floats, inliers: _PairInliers) -> _Floats:
    """Decompose a homography into a pose as COLMAP's mapper does, float64 [3, 4]."""
    matrices = [camera.calibration_matrix() for camera in inliers.cameras]
    found = pycolmap.pose_from_homography_matrix(H, *matrices, *(own.T for own in inliers.rays))
    return np.asarray(found["cam2_from_cam1"].matrix())


def _pose_of_essential(E: _Floats, inliers: _PairInliers) -> _Floats:
    """Decompose an essential matrix into the pose with the most points in front of both cameras.

    Returns float64 [3, 4].
    """
    a, b = (np.ascontiguousarray(own.T) for own in inliers.x)
    _, rotation, translation, _ = cv2.recoverPose(E, a, b, np.eye(3))
    return np.column_stack([rotation, translation])


def _triangulation_angle(rotation: _Floats, rays: Sequence[_Floats]) -> float:
    """Median triangulation angle of matches in degrees, given the rotation to the second camera."""
    cosine = ((rotation @ rays[0]) * rays[1]).sum(axis=0)
    return float(np.degrees(np.median(np.arccos(np.clip(cosine, -1.0, 1.0)))))


def _angle_between(rotation: _Floats, other: _Floats) -> float:
    """The angle between two rotations in degrees."""
    cosine = (np.trace(rotation @ other.T) - 1.0) / 2.0
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _contradicted_angle(geometry: TwoViewGeometry, inliers: _PairInliers) -> float | None:
    """Triangulation angle of the homography's pose in degrees, if the matches contradict it."""
    of_pair = geometry.E
    if geometry.config not in FLAT_CONFIGS or of_pair is None or geometry.H is None:
        return None
    pose = _pose_of_homography(geometry.H, inliers)
    angle = _triangulation_angle(pose[:, :3], inliers.rays)
    rotation = _pose_of_essential(of_pair, inliers)[:, :3]
    if angle < _ANGLE_FACTOR * _triangulation_angle(rotation, inliers.rays):
        return None
    of_pose = essential_of_poses(np.eye(3, 4), pose)
    is_wrong = _error(of_pose, inliers.x) > _ERROR_FACTOR * _error(of_pair, inliers.x)
    return angle if is_wrong else None


def _error(E: _Floats, x: Sequence[_Floats]) -> float:
    """A high quantile of the Sampson errors, in focal lengths."""
    return float(np.quantile(sampson_error(E, x[0], x[1]), _ERROR_QUANTILE))

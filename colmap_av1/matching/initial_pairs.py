"""Pairs that COLMAP's incremental mapper would start from with a pose that is not theirs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_av1.matching.image_matches import MatchedImages
from colmap_av1.matching.mapper_limits import INITIAL_MIN_ANGLE, INITIAL_MIN_INLIERS
from colmap_av1.matching.two_view_geometry import FLAT_CONFIGS, TwoViewGeometry
from colmap_av1.matching.two_view_models import epipolar_terms, essential_of_poses
from colmap_av1.util.progress import Clock

_Floats = NDArray[np.float64]

# The mapper asks half as much of its first pair where no pair has all that it asks for: first half
# the inliers, then half the angle.
_START = INITIAL_MIN_INLIERS // 2
_ANGLE = INITIAL_MIN_ANGLE / 2
# Where the parallax of near views is within what the mapper takes for noise, 4 px, the pose of the
# homography has two to ten times the angle that the essential matrix tells, and two to twenty
# times the errors that most matches keep to. Where it is right, the angles agree to a third.
_MUCH_WIDER = 1.5
_MUCH_WORSE = 1.5
_SHARE = 0.9


def bar_false_starts(
    matched: MatchedImages, cameras: Sequence[pycolmap.Camera], *, clock: Clock
) -> MatchedImages:
    """Leave pairs whose homography tells a wrong pose fewer matches than a first pair needs.

    COLMAP's mapper takes a pair's pose from its homography wherever that explains most of the
    matches (`EstimateTwoViewGeometryPose`). Where the matches themselves deny this pose, a model
    that begins with it fails after a few images, and the mapper writes it all the same, first. The
    pair keeps what it needs to link its images; tracks go through the pairs between.

    Args:
        matched: the images. Pairs without an essential matrix, as no focal length is known, cannot
            be told and stay.
        cameras: the camera of each image.
        clock: gets the stage "verification".
    """
    geometries = list(matched.geometries)
    with clock.measure("verification"):
        for k, (pair, geometry) in enumerate(zip(matched.pairs.tolist(), geometries, strict=True)):
            if _may_start(geometry):
                # They tell as much as all do.
                few = _thinned(geometry)
                if _denied(few, *_inliers(matched, cameras, pair, few)):
                    geometries[k] = few
    return replace(matched, geometries=geometries)


def _may_start(geometry: TwoViewGeometry) -> bool:
    return (
        geometry.config in FLAT_CONFIGS
        and geometry.E is not None
        and geometry.H is not None
        and len(geometry.inlier_matches) >= _START
    )


def _inliers(
    matched: MatchedImages,
    cameras: Sequence[pycolmap.Camera],
    pair: Sequence[int],
    geometry: TwoViewGeometry,
) -> tuple[list[_Floats], list[_Floats]]:
    """The inliers in both images, normalised coordinates [2, n], and the calibration matrices."""
    points, matrices = [], []
    for image, chosen in zip(pair, geometry.inlier_matches.T, strict=True):
        xy = matched.keypoints[image].xy[chosen].astype(np.float64)
        points.append(np.asarray(cameras[image].cam_from_img(xy), dtype=np.float64))
        matrices.append(np.asarray(cameras[image].calibration_matrix()))
    # Some pixels of a wide lens have no ray in front of the camera.
    known = np.isfinite(points[0] + points[1]).all(axis=1)
    return [x[known].T for x in points], matrices


def _denied(geometry: TwoViewGeometry, x: list[_Floats], matrices: list[_Floats]) -> bool:
    """Whether the matches say that the pose of the homography is not that of the pair."""
    rays = [np.vstack([own, np.ones(own.shape[1])]) for own in x]
    rays = [own / np.linalg.norm(own, axis=0) for own in rays]
    found = pycolmap.pose_from_homography_matrix(geometry.H, *matrices, *(own.T for own in rays))
    pose = np.asarray(found["cam2_from_cam1"].matrix())
    angle = _angle(pose[:, :3], rays)
    if angle < _ANGLE:
        return False
    of_pair = geometry.E
    assert of_pair is not None
    a, b = (np.ascontiguousarray(own.T) for own in x)
    rotation = cv2.recoverPose(of_pair, a, b, np.eye(3))[1]
    if angle < _MUCH_WIDER * _angle(rotation, rays):
        return False
    of_pose = essential_of_poses(np.eye(3, 4), pose)
    return _error(of_pose, x) > _MUCH_WORSE * _error(of_pair, x)


def _angle(rotation: _Floats, rays: Sequence[_Floats]) -> float:
    """Triangulation angle of the matches in degrees, by the rotation to the second camera."""
    cosine = ((rotation @ rays[0]) * rays[1]).sum(axis=0)
    return float(np.degrees(np.median(np.arccos(np.clip(cosine, -1.0, 1.0)))))


def _error(E: _Floats, x: Sequence[_Floats]) -> float:
    """Sampson error that most of the matches keep to, in focal lengths."""
    algebraic, gradient = epipolar_terms(E, x[0], x[1])
    error = np.abs(algebraic) / np.sqrt(np.maximum(gradient, np.finfo(np.float64).tiny))
    return float(np.quantile(error, _SHARE))


def _thinned(geometry: TwoViewGeometry) -> TwoViewGeometry:
    """The geometry with some of its inliers, spread over all of them."""
    count = len(geometry.inlier_matches)
    chosen = np.linspace(0, count - 1, _START - 1).round().astype(np.intp)
    return replace(geometry, inlier_matches=geometry.inlier_matches[chosen])

"""Demote pairs that would make a bad initial pair for COLMAP's incremental mapper."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_av1.matching.image_matches import MatchedImages
from colmap_av1.matching.initial_adjustment import (
    KnownPoses,
    PairInliers,
    bad_initial_pairs,
    inliers_of,
    pose_of_essential,
    pose_of_homography,
    triangulation_angle,
)
from colmap_av1.matching.mapper_limits import INITIAL_MIN_INLIERS
from colmap_av1.matching.two_view_geometry import FLAT_CONFIGS, TwoViewGeometry
from colmap_av1.matching.two_view_models import essential_of_poses, sampson_error
from colmap_av1.util.progress import Clock
from colmap_av1.util.spread import evenly_spread

_Floats = NDArray[np.float64]

# If no pair meets the mapper's limits for an initial pair, it halves the number of inliers.
_MIN_INLIERS = INITIAL_MIN_INLIERS // 2
# The pose of the homography is wrong if its triangulation angle and its error both exceed those of
# the essential matrix by these factors. If the parallax of nearby images is below the mapper's
# noise limit of 4 px, the angle is two to ten times as large and the error of most matches two to
# twenty times. If the pose is right, the angles differ by less than a third.
_ANGLE_FACTOR = 1.5
_ERROR_FACTOR = 1.5
# The error of a pose is this quantile of its matches' errors.
_ERROR_QUANTILE = 0.9

_NO_POSES = KnownPoses()


def demote_bad_initial_pairs(
    matched: MatchedImages,
    cameras: Sequence[pycolmap.Camera],
    clock: Clock,
    known: KnownPoses = _NO_POSES,
) -> MatchedImages:
    """Limit the inliers of pairs that would make a bad initial pair.

    COLMAP's mapper takes a pair's pose from its homography if that explains most of the matches
    (`EstimateTwoViewGeometryPose`). If the matches contradict this pose, or if bundle adjustment of
    the pair alone makes the intrinsics diverge, a model that begins with the pair fails after a few
    images, and the mapper still writes it first. A demoted pair keeps enough inliers to connect its
    images; tracks continue through the pairs between. Pairs keep all inliers if the mapper finds a
    good pair before it lowers its limits to theirs.

    Args:
        matched: the images. The pose of the homography is tested only for pairs with an essential
            matrix, which needs known focal lengths.
        cameras: the camera of each image.
        clock: gets the stage "verification".
        known: known poses, if any. Pairs whose own pose disagrees with these are demoted, too.
    """
    geometries = list(matched.geometries)
    with clock.measure("verification"):
        misleading = known.misleading_pairs(matched, cameras)
        for k, (pair, geometry) in enumerate(zip(matched.pairs.tolist(), geometries, strict=True)):
            if _may_start(geometry):
                # Some of the inliers decide as well as all of them.
                few = _demoted(geometry)
                angle = _contradicted_angle(few, inliers_of(matched, cameras, pair, few))
                if angle is not None:
                    misleading[k] = angle
        for k in bad_initial_pairs(matched, cameras, known, misleading):
            geometries[k] = _demoted(geometries[k])
    return replace(matched, geometries=geometries)


def _may_start(geometry: TwoViewGeometry) -> bool:
    return (
        geometry.config in FLAT_CONFIGS
        and geometry.E is not None
        and geometry.H is not None
        and len(geometry.inlier_matches) >= _MIN_INLIERS
    )


def _contradicted_angle(geometry: TwoViewGeometry, inliers: PairInliers) -> float | None:
    """Triangulation angle of the homography's pose in degrees, if the matches contradict it."""
    of_pair = geometry.E
    assert of_pair is not None
    assert geometry.H is not None
    pose = pose_of_homography(geometry.H, inliers)
    angle = triangulation_angle(pose[:, :3], inliers.rays)
    rotation = pose_of_essential(of_pair, inliers)[:, :3]
    if angle < _ANGLE_FACTOR * triangulation_angle(rotation, inliers.rays):
        return None
    of_pose = essential_of_poses(np.eye(3, 4), pose)
    is_wrong = _error(of_pose, inliers.x) > _ERROR_FACTOR * _error(of_pair, inliers.x)
    return angle if is_wrong else None


def _error(E: _Floats, x: Sequence[_Floats]) -> float:
    """A high quantile of the Sampson errors, in focal lengths."""
    return float(np.quantile(sampson_error(E, x[0], x[1]), _ERROR_QUANTILE))


def _demoted(geometry: TwoViewGeometry) -> TwoViewGeometry:
    """Keep some of the inliers, evenly spread, too few for an initial pair."""
    count = len(geometry.inlier_matches)
    chosen = evenly_spread(count, _MIN_INLIERS - 1, rounded=True)
    return replace(geometry, inlier_matches=geometry.inlier_matches[chosen])

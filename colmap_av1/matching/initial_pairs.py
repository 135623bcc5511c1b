"""Pairs that would make a bad initial pair for COLMAP's incremental mapper."""

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
    inliers_of,
    pose_of_essential,
    pose_of_homography,
    runaway_starts,
    triangulation_angle,
)
from colmap_av1.matching.mapper_limits import INITIAL_MIN_ANGLE, INITIAL_MIN_INLIERS
from colmap_av1.matching.two_view_geometry import FLAT_CONFIGS, TwoViewGeometry
from colmap_av1.matching.two_view_models import essential_of_poses, sampson_error
from colmap_av1.util.progress import Clock
from colmap_av1.util.spread import evenly_spread

_Floats = NDArray[np.float64]

# If no pair meets the mapper's limits for an initial pair, it halves them: first the inliers, then
# the angle.
_START = INITIAL_MIN_INLIERS // 2
_ANGLE = INITIAL_MIN_ANGLE / 2
# If the parallax of near views is below the mapper's noise limit of 4 px, the pose of the
# homography has two to ten times the angle of the essential matrix's, and two to twenty times the
# error of most matches. If it is right, the angles agree to a third.
_MUCH_WIDER = 1.5
_MUCH_WORSE = 1.5
_SHARE = 0.9


def demote_bad_initial_pairs(
    matched: MatchedImages,
    cameras: Sequence[pycolmap.Camera],
    clock: Clock,
    poses: Sequence[_Floats | None] = (),
) -> MatchedImages:
    """Limit the inliers of pairs that would make a bad initial pair.

    COLMAP's mapper takes a pair's pose from its homography if that explains most of the matches
    (`EstimateTwoViewGeometryPose`). If the matches contradict this pose, or the adjustment of the
    pair alone moves its camera far off, a model that begins with the pair fails after a few images,
    and the mapper still writes it first. A demoted pair keeps enough inliers to connect its images;
    tracks continue through the pairs between.

    Args:
        matched: the images. Pairs without an essential matrix, as no focal length is known, are not
            tested for the pose of the homography.
        cameras: the camera of each image.
        clock: gets the stage "verification".
        poses: float64 [3, 4] cam_from_world of each image, of those where it is known; empty: none
            is. A pair whose matches give another pose is demoted, too.
    """
    geometries = list(matched.geometries)
    with clock.measure("verification"):
        for k, (pair, geometry) in enumerate(zip(matched.pairs.tolist(), geometries, strict=True)):
            if _may_start(geometry):
                # The few inliers decide as well as all.
                few = _thinned(geometry)
                if _is_contradicted(few, inliers_of(matched, cameras, pair, few)):
                    geometries[k] = few
        known = KnownPoses(poses)
        for k in known.misleading_pairs(replace(matched, geometries=geometries), cameras):
            geometries[k] = _thinned(geometries[k])
        for k in runaway_starts(replace(matched, geometries=geometries), cameras, known):
            geometries[k] = _thinned(geometries[k])
    return replace(matched, geometries=geometries)


def _may_start(geometry: TwoViewGeometry) -> bool:
    return (
        geometry.config in FLAT_CONFIGS
        and geometry.E is not None
        and geometry.H is not None
        and len(geometry.inlier_matches) >= _START
    )


def _is_contradicted(geometry: TwoViewGeometry, inliers: PairInliers) -> bool:
    """Whether the matches contradict the pose of the homography."""
    of_pair = geometry.E
    assert of_pair is not None
    assert geometry.H is not None
    pose = pose_of_homography(geometry.H, inliers)
    angle = triangulation_angle(pose[:, :3], inliers.rays)
    if angle < _ANGLE:
        return False
    rotation = pose_of_essential(of_pair, inliers)[:, :3]
    if angle < _MUCH_WIDER * triangulation_angle(rotation, inliers.rays):
        return False
    of_pose = essential_of_poses(np.eye(3, 4), pose)
    return _error(of_pose, inliers.x) > _MUCH_WORSE * _error(of_pair, inliers.x)


def _error(E: _Floats, x: Sequence[_Floats]) -> float:
    """Sampson error that most matches are below, in focal lengths."""
    return float(np.quantile(sampson_error(E, x[0], x[1]), _SHARE))


def _thinned(geometry: TwoViewGeometry) -> TwoViewGeometry:
    """The geometry with some of its inliers, spread over all of them."""
    count = len(geometry.inlier_matches)
    chosen = evenly_spread(count, _START - 1, rounded=True)
    return replace(geometry, inlier_matches=geometry.inlier_matches[chosen])

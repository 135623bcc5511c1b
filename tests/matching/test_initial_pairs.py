from __future__ import annotations

from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from synthetic_scene import HEIGHT, WIDTH
from view_pairs import (
    ANGLE,
    CAMERA,
    PAIR,
    TURN,
    TURNED,
    separate_pairs,
    turned_views,
    two_views,
    verified,
)

from colmap_av1.geometry.cameras import make_camera
from colmap_av1.matching.initial_pairs import PreparedStart, prepare_start
from colmap_av1.matching.mapper_limits import (
    DEFAULT_LIMITS,
    FORWARD_MOTION,
    INITIAL_MIN_ANGLE,
    INITIAL_MIN_INLIERS,
    SMALL_ANGLES,
    InitialLimits,
)
from colmap_av1.matching.matched_images import MatchedImages
from colmap_av1.matching.pairs import ImageKeypoints
from colmap_av1.matching.two_view_geometry import TwoViewConfig, TwoViewGeometry
from colmap_av1.matching.verify import verify_pairs
from colmap_av1.options import CameraOptions
from colmap_av1.util.progress import Clock

TOWARDS = np.column_stack([np.eye(3), [-0.16, 0.02, -0.16]])


def demoted(keypoints: list[ImageKeypoints], geometry: TwoViewGeometry) -> TwoViewGeometry:
    matched = MatchedImages(keypoints, PAIR, [geometry.inlier_matches], [geometry], False)
    return prepare_start(matched, [CAMERA] * 2, Clock()).matched.geometries[0]


def angle_of_mapper(keypoints: list[ImageKeypoints], matches: NDArray[np.uint32]) -> float:
    """The triangulation angle that COLMAP's mapper computes for a pair, in degrees."""
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.min_num_trials = 30
    options.ransac.max_error = 4.0
    options.ransac.random_seed = 0
    views = [w for k in keypoints for w in (CAMERA, k.xy.astype(float))]
    found = pycolmap.estimate_two_view_geometry(*views, matches, options)
    assert pycolmap.estimate_two_view_geometry_pose(*views, found)
    return float(np.degrees(found.tri_angle))


def test_pairs_with_an_overestimated_angle_are_demoted() -> None:
    """The mapper would overestimate the angle of these pairs by 40 % or more."""
    rng = np.random.default_rng(0)
    for _ in range(10):
        keypoints, matches = two_views(1.2, rng)
        geometry = verified(keypoints, matches)
        assert geometry.config == TwoViewConfig.PLANAR_OR_PANORAMIC
        assert angle_of_mapper(keypoints, geometry.inlier_matches) > 1.4 * ANGLE
        found = demoted(keypoints, geometry)
        own, kept = (set(map(tuple, g.inlier_matches.tolist())) for g in (geometry, found))
        assert kept < own
        assert len(kept) == len(found.inlier_matches) == INITIAL_MIN_INLIERS // 2 - 1
        rest = replace(found, inlier_matches=geometry.inlier_matches)
        assert vars(rest) == vars(geometry)


def test_planar_pair_with_a_correct_pose_is_kept() -> None:
    """The pose from the homography is correct here."""
    rng = np.random.default_rng(1)
    for _ in range(10):
        keypoints, matches = two_views(0.0, rng, angle=14.0)
        geometry = verified(keypoints, matches)
        assert geometry.config == TwoViewConfig.PLANAR_OR_PANORAMIC
        assert 10 < angle_of_mapper(keypoints, geometry.inlier_matches) < 18
        assert demoted(keypoints, geometry) is geometry


@pytest.mark.parametrize("count", [0, 15, 49])
def test_pairs_with_too_few_inliers_are_unchanged(count: int) -> None:
    keypoints, matches = two_views(1.2, np.random.default_rng(2), count)
    geometry = verified(keypoints, matches)
    assert demoted(keypoints, geometry) is geometry


def test_planar_pair_with_unknown_focal_length_is_kept() -> None:
    keypoints, matches = two_views(1.2, np.random.default_rng(3))
    unknown = make_camera(CameraOptions(), WIDTH, HEIGHT)
    geometry = verify_pairs(keypoints, PAIR, [matches], unknown)[0]
    assert geometry.config == TwoViewConfig.PLANAR_OR_PANORAMIC
    assert demoted(keypoints, geometry) is geometry


@pytest.mark.parametrize(
    ("turned", "forward_motion", "is_kept"),
    [(0.0, False, True), (0.0, True, True), (10.0, False, False), (10.0, True, False)],
)
def test_pair_with_a_wrong_pose_is_demoted(
    turned: float, forward_motion: bool, is_kept: bool
) -> None:
    rng = np.random.default_rng(3)
    keypoints, matches = turned_views(0.5, 0.3, 300, rng)
    geometry = verified(keypoints, matches)
    matched = MatchedImages(keypoints, PAIR, [matches], [geometry], forward_motion)
    wrong = Rotation.from_euler("y", turned + 20, degrees=True).as_matrix()
    poses = [np.eye(3, 4), np.column_stack([wrong, [0, 0, 1] - wrong[:, 2]])]
    found = prepare_start(matched, [CAMERA] * 2, Clock(), [poses])
    count = len(found.matched.geometries[0].inlier_matches)
    assert (count == len(geometry.inlier_matches)) == is_kept == found.is_certain
    assert count >= 40
    assert is_kept or count < INITIAL_MIN_INLIERS / 2
    # The mapper needs options for forward motion only if it has no pair to start from.
    assert (found.limits == FORWARD_MOTION) == (forward_motion and not is_kept)


@pytest.mark.parametrize(
    ("angle", "limits", "is_certain"),
    [
        (30.0, DEFAULT_LIMITS, True),
        (12.0, SMALL_ANGLES, True),
        (6.0, SMALL_ANGLES, True),
        (3.0, DEFAULT_LIMITS, False),
    ],
)
def test_limits_depend_on_the_largest_angle(
    angle: float, limits: InitialLimits, is_certain: bool
) -> None:
    keypoints, matches = two_views(4.0, np.random.default_rng(0), 400, angle)
    geometry = verified(keypoints, matches)
    turn = Rotation.from_euler("y", -angle / 2, degrees=True).as_matrix()
    poses = [np.eye(3, 4), np.column_stack([turn, turn @ [-np.radians(angle), 0, 0]])]
    matched = MatchedImages(keypoints, PAIR, [geometry.inlier_matches], [geometry], False)
    found = prepare_start(matched, [CAMERA] * 2, Clock(), [poses])
    assert found.limits == limits
    assert found.is_certain == is_certain
    assert found.matched.geometries[0] is geometry


def test_wrong_pair_below_the_angle_of_a_good_pair_is_kept() -> None:
    """The mapper starts with the good pair before it lowers its limits to the wrong one."""
    rng = np.random.default_rng(3)
    wide, narrow = turned_views(0.5, 0.3, 300, rng), two_views(4.0, rng, 300, 10.0)
    keypoints = [k for views in (wide, narrow) for k in views[0]]
    geometries = [verified(*views) for views in (wide, narrow)]
    pairs = np.array([[0, 1], [2, 3]], dtype=np.int32)
    of_wide = [np.eye(3, 4), TURNED]
    of_narrow = [np.eye(3, 4), np.hstack([TURN, [[0], [0], [0]]])]
    poses = [*of_wide, *of_narrow]
    for chosen, is_kept in (([0, 1], True), ([1], False)):
        matched = MatchedImages(
            keypoints,
            pairs[chosen],
            [geometries[k].inlier_matches for k in chosen],
            [geometries[k] for k in chosen],
            False,
        )
        found = prepare_start(matched, [CAMERA] * 4, Clock(), [poses])
        assert (found.matched.geometries[-1] is geometries[1]) == is_kept == found.is_certain


def test_pair_with_few_inliers_is_demoted_if_no_pair_has_a_large_angle() -> None:
    """RANSAC may give it a wrong pose when the mapper lowers its limits."""
    rng = np.random.default_rng(0)
    pairs = np.array([[0, 1], [2, 9], [3, 4]], dtype=np.int32)
    nothing = np.empty((0, 2), np.float32)
    keypoints = [ImageKeypoints(nothing, np.arange(0)) for i in range(10)]
    poses = [np.eye(3, 4) for _ in range(10)]
    geometries = []
    for (i, j), count, angle in zip(pairs.tolist(), (400, 80, 80), (12.0, 7.0, 7.0), strict=True):
        views, matches = two_views(4.0, rng, count, angle)
        keypoints[i], keypoints[j] = views
        turn = Rotation.from_euler("y", -angle / 2, degrees=True).as_matrix()
        poses[j] = np.column_stack([turn, turn @ [-np.radians(angle), 0, 0]])
        geometries.append(verified(views, matches))
    matched = MatchedImages(
        keypoints, pairs, [g.inlier_matches for g in geometries], geometries, False
    )
    found = prepare_start(matched, [CAMERA] * 10, Clock(), [poses])
    kept = [len(geometry.inlier_matches) for geometry in found.matched.geometries]
    given = [len(geometry.inlier_matches) for geometry in geometries]
    assert kept == [given[0], INITIAL_MIN_INLIERS // 4 - 1, given[2]]


def prepared(
    views: list[tuple[list[ImageKeypoints], NDArray[np.uint32]]],
    poses: list[NDArray[np.float64] | None],
    models: list[int] | None = None,
) -> PreparedStart:
    """Prepare separate pairs of images, see `separate_pairs`."""
    matched, known = separate_pairs(views, poses, models)
    return prepare_start(matched, [CAMERA] * len(matched.keypoints), Clock(), known)


def num_inliers(
    views: list[tuple[list[ImageKeypoints], NDArray[np.uint32]]],
    poses: list[NDArray[np.float64] | None],
    models: list[int] | None = None,
) -> list[int]:
    """Number of inliers that each of these pairs keeps."""
    matched = prepared(views, poses, models).matched
    return [len(geometry.inlier_matches) for geometry in matched.geometries]


def test_a_good_pair_is_left_if_all_pairs_have_small_angles() -> None:
    """These could all be demoted for a mapper without options, which begins to accept them at 8."""
    angle = 7.0
    turn = Rotation.from_euler("y", -angle / 2, degrees=True).as_matrix()
    pose = np.column_stack([turn, turn @ [-1, 0, 0]])
    views = [two_views(0.5, np.random.default_rng(3), 300, angle)] * 4
    assert num_inliers(views, [pose] * 4) == [300] * 4


def towards_a_wall(rng: np.random.Generator) -> tuple[list[ImageKeypoints], NDArray[np.uint32]]:
    """Two views of a wall, for which the mapper finds a wrong pose."""
    x = rng.uniform((-0.4, -0.3), (0.4, 0.3), (600, 2))
    wall = np.c_[x, np.ones(600)] / (1 + 1.5 * x[:, :1])
    keypoints = [
        ImageKeypoints(
            (CAMERA.img_from_cam(points) + rng.normal(0, 0.1, (600, 2))).astype(np.float32),
            np.arange(600),
        )
        for frame, points in enumerate((wall, wall + TOWARDS[:, 3]))
    ]
    return keypoints, np.repeat(np.arange(600, dtype=np.uint32)[:, None], 2, axis=1)


def test_pair_of_unknown_pose_is_demoted_if_the_mapper_would_try_it_first() -> None:
    """An image outside the joint estimate belongs to no model that is known to grow."""
    rng = np.random.default_rng(3)
    views = [turned_views(0.5, 0.3, count, rng) for count in (300, 600)]
    assert num_inliers(views, [TURNED, None]) == [300, INITIAL_MIN_INLIERS // 2 - 1]
    assert num_inliers(views, [TURNED, TURNED]) == [300, 600]


def test_pair_whose_intrinsics_diverge_is_demoted() -> None:
    """Points in a small part of the picture do not determine the focal length."""
    rng = np.random.default_rng(3)
    views = [turned_views(*shape, rng) for shape in ((0.5, 0.3, 300), (0.1, 0.02, 600))]
    assert num_inliers(views, [TURNED, TURNED]) == [300, INITIAL_MIN_INLIERS // 2 - 1]


@pytest.mark.parametrize(("num_diverging", "diverge"), [(0, False), (1, False), (12, True)])
def test_intrinsics_that_diverge_with_many_pairs_are_to_be_kept(
    num_diverging: int, diverge: bool
) -> None:
    rng = np.random.default_rng(3)
    shapes = [(0.5, 0.3, 300), *[(0.1, 0.02, 600)] * num_diverging]
    views = [turned_views(*shape, rng) for shape in shapes]
    assert prepared(views, [TURNED] * len(views)).intrinsics_diverge == diverge


def test_pair_whose_intrinsics_diverge_is_demoted_in_a_further_model() -> None:
    """The mapper begins again, after it has registered the images of the first model."""
    rng = np.random.default_rng(3)
    good, diverging = turned_views(0.5, 0.3, 300, rng), turned_views(0.1, 0.02, 250, rng)
    views, models = [*[good] * 20, good, diverging], [*[0] * 20, 1, 1]
    kept = num_inliers(views, [TURNED] * len(views), models)
    assert kept == [*[300] * 21, INITIAL_MIN_INLIERS // 2 - 1]


@pytest.mark.parametrize(
    ("models", "count"),
    [([0, 0], INITIAL_MIN_INLIERS // 2 - 1), ([0, 1], INITIAL_MIN_INLIERS // 4 - 1)],
)
def test_pair_with_two_possible_poses_is_demoted(models: list[int], count: int) -> None:
    """The mapper takes the motion towards a wall for a turn, with twice the angle.

    A pair of a further model is demoted below the lowest limit.
    """
    rng = np.random.default_rng(3)
    views = [turned_views(0.5, 0.3, 300, rng), towards_a_wall(rng)]
    assert angle_of_mapper(*views[1]) > INITIAL_MIN_ANGLE
    assert num_inliers(views, [TURNED, TOWARDS], models) == [300, count]

"""The pairs, cameras and fixed intrinsics with which COLMAP's mapper starts a large model."""

from __future__ import annotations

import copy
import sqlite3
from collections.abc import Collection
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap
import pytest
from image_sets import tracks_from
from numpy.typing import NDArray
from synthetic_scene import FOCAL, HEIGHT, WIDTH, make_scene, match_scene
from view_pairs import CAMERA, TURNED, separate_pairs, turned_views, two_views

from colmap_av1.database.reading import image_ids_from_pair_id
from colmap_av1.errors import ModelError
from colmap_av1.geometry.cameras import make_camera
from colmap_av1.matching.depth import DepthEvidence
from colmap_av1.matching.links.report import LinkReport
from colmap_av1.matching.mapper_limits import (
    DEFAULT_LIMITS,
    FORWARD_MOTION,
    INITIAL_MIN_INLIERS,
    SMALL_ANGLES,
    InitialLimits,
)
from colmap_av1.matching.match_images import ImageMatches
from colmap_av1.matching.matched_images import MatchedImages
from colmap_av1.options import CameraOptions, MapOptions
from colmap_av1.poses import mapper_trials
from colmap_av1.poses.joint_matches import JointEstimate, JointMatches
from colmap_av1.poses.mapper_start import MapperStart, choose_mapper_start
from colmap_av1.util.progress import Clock

ASSUMED = make_camera(CameraOptions(), WIDTH, HEIGHT)
# The number of inliers that `turned_views` get, and that demoted pairs keep.
GIVEN, FEW = [300, 280, 260], INITIAL_MIN_INLIERS // 2 - 1
NUM_DIVERGING = 6


class Trial(NamedTuple):
    """A run of the mapper.

    Attributes:
        refines: whether it refines the intrinsics.
        is_known: whether the focal lengths in the database count as known.
        limits: limits of the initial pair that it is given.
    """

    refines: bool
    is_known: bool
    limits: dict[str, float]


@dataclass
class Mapper:
    """COLMAP's mapper, which starts a small model with some pairs.

    It begins with the pair that has the most inliers, or with none if all have too few.

    Attributes:
        refined: the pairs with which it fails if it refines the intrinsics.
        fixed: the pairs with which it fails if it keeps them.
        stops: it stops with an error.
        trials: its runs so far.
    """

    refined: Collection[int] = ()
    fixed: Collection[int] = ()
    stops: bool = False
    trials: list[Trial] = field(default_factory=list)

    def starts_well(self, counts: list[int], *, refines: bool) -> bool:
        """Whether it starts a large model from pairs with these numbers of inliers."""
        first = max(range(len(counts)), key=counts.__getitem__)
        bad = self.refined if refines else self.fixed
        return counts[first] >= INITIAL_MIN_INLIERS and first not in bad

    def start(
        self,
        database: Path,
        options: MapOptions,
        num_images: int,
        *,
        log: Path,
        initial_pair: dict[str, float],
    ) -> list[str] | None:
        """See `start_mapper`."""
        with closing(sqlite3.connect(database)) as connection:
            rows = list(connection.execute("SELECT pair_id, rows FROM two_view_geometries"))
            known = [k for (k,) in connection.execute("SELECT prior_focal_length FROM cameras")]
        refines = bool(options.refine_intrinsics)
        self.trials.append(Trial(refines, all(known), initial_pair))
        if self.stops:
            raise ModelError("the mapper stopped with status 3")
        counts = [count for _, count in sorted(rows)]
        if self.starts_well(counts, refines=refines):
            return None
        if max(counts) < INITIAL_MIN_INLIERS:
            return []
        pair_id = max(rows, key=lambda row: (row[1], -row[0]))[0]
        return [f"{number - 1:03}.png" for number in image_ids_from_pair_id(pair_id)]


@pytest.fixture
def mapper(monkeypatch: pytest.MonkeyPatch) -> Mapper:
    """The mapper that trials run."""
    own = Mapper()
    monkeypatch.setattr(mapper_trials, "start_mapper", own.start)
    return own


def matches_of(
    *,
    joint: bool = False,
    diverge: bool = False,
    angle: float | None = None,
    models: list[int] | None = None,
    camera: pycolmap.Camera = CAMERA,
    forward_motion: bool = False,
    has_depth: bool = True,
) -> ImageMatches:
    """Matches of three good pairs.

    Args:
        joint: the poses of all images are known.
        diverge: the intrinsics diverge with further pairs, of points in a small part of images.
        angle: triangulation angle of the good pairs; None for one that is large enough for the
            mapper's default options.
        models: the model of each pair.
        camera: the camera of all images.
        forward_motion: the camera moves along its axis.
        has_depth: the matches determine depth.
    """
    rng = np.random.default_rng(3)
    if angle is None:
        good, pose = [turned_views(0.5, 0.3, count, rng) for count in GIVEN], TURNED
    else:
        turn = pycolmap.Rotation3d(np.array([0, -np.radians(angle / 2), 0])).matrix()
        pose = np.column_stack([turn, turn @ [-np.radians(angle), 0, 0]])
        good = [two_views(4.0, rng, count, angle) for count in GIVEN]
    num_diverging = NUM_DIVERGING if diverge else 0
    diverging = [turned_views(0.05, 0.005, 600, rng) for _ in range(num_diverging)]
    poses: list[Any] = [*[pose] * len(good), *[TURNED] * num_diverging]
    matched, known = separate_pairs([*good, *diverging], poses, models)
    return found_matches(
        replace(matched, forward_motion=forward_motion),
        camera,
        known if joint else None,
        has_depth=has_depth,
    )


def found_matches(
    matched: MatchedImages,
    camera: pycolmap.Camera,
    known: list[list[NDArray[np.float64] | None]] | None,
    *,
    has_depth: bool = True,
) -> ImageMatches:
    """Matches with a camera, and with the poses in each model; None for no joint estimate."""
    found: dict[str, Any] = {
        "cameras": [camera] * len(matched.keypoints),
        "focal_length": None,
        "matched": matched,
        "links": LinkReport(),
        "link_tracks": tracks_from([]),
        "track_lengths": matched.track_lengths,
        "depth": DepthEvidence(40, 40 if has_depth else 0, camera.has_prior_focal_length),
        "warnings": (),
    }
    if known is None:
        return ImageMatches(**found)
    estimate = JointEstimate((len(matched.keypoints),), None, None, None, (FOCAL, FOCAL))
    return JointMatches(**found, estimate=estimate, poses=known)


def chosen(found: ImageMatches, *, keep_cameras: bool = False) -> MapperStart:
    names = [f"{number:03}.png" for number in range(len(found.cameras))]
    return choose_mapper_start(found, names, Clock(), keep_cameras=keep_cameras)


def counts_of(start: MapperStart) -> list[int]:
    return [len(geometry.inlier_matches) for geometry in start.matched.geometries]


def test_pairs_of_a_start_that_was_tried_are_kept_without_a_trial(mapper: Mapper) -> None:
    found = matches_of(joint=True)
    start = chosen(found)
    assert not mapper.trials
    assert counts_of(start) == GIVEN
    assert start.cameras == found.cameras
    assert start.limits == DEFAULT_LIMITS
    assert not start.fixed_intrinsics
    assert not start.warnings


@pytest.mark.parametrize(("joint", "models"), [(False, None), (True, [0, 0, 1])])
def test_mapper_is_tried_if_it_may_begin_with_another_pair(
    joint: bool, models: list[int] | None, mapper: Mapper
) -> None:
    """It may without known poses, and with several models."""
    mapper.refined = {0}
    start = chosen(matches_of(joint=joint, models=models))
    assert counts_of(start) == [FEW, *GIVEN[1:]]
    assert mapper.trials == [Trial(refines=True, is_known=True, limits={})] * 2
    assert not start.fixed_intrinsics
    assert not start.warnings


def test_pairs_are_kept_if_no_start_succeeds(mapper: Mapper) -> None:
    mapper.refined = {0, 1, 2}
    assert counts_of(chosen(matches_of())) == GIVEN
    assert len(mapper.trials) == len(GIVEN) + 1


def test_mapper_is_not_tried_without_depth(mapper: Mapper) -> None:
    mapper.refined = {0}
    assert counts_of(chosen(matches_of(has_depth=False))) == GIVEN
    assert not mapper.trials


def test_mapper_that_stops_in_a_trial_is_reported(mapper: Mapper) -> None:
    mapper.stops = True
    start = chosen(matches_of())
    assert len(start.warnings) == len(mapper.trials) == 1
    assert "mapper failed" in start.warnings[0]
    assert counts_of(start) == GIVEN


@pytest.mark.parametrize(("camera", "is_kept"), [(CAMERA, True), (ASSUMED, False)])
def test_known_intrinsics_are_kept_with_forward_motion(
    camera: pycolmap.Camera, is_kept: bool, mapper: Mapper
) -> None:
    found = matches_of(camera=camera, forward_motion=True)
    start = chosen(found)
    assert start.fixed_intrinsics == is_kept
    assert start.cameras == found.cameras
    assert start.limits == FORWARD_MOTION
    # The mapper may crash in a trial if a focal length is not known.
    assert mapper.trials == [Trial(not is_kept, is_known=True, limits=FORWARD_MOTION.options)]
    assert not start.warnings


@pytest.mark.parametrize(
    ("refined", "fixed", "counts"),
    [
        ((), (), GIVEN),
        # The pairs are good for both.
        ((0,), (1,), [FEW, FEW, 260]),
        # No pair is good for the default options.
        ((0, 1, 2), (0,), [FEW, 280, 260]),
        # The only good pair for the printed options is bad for the default ones.
        ((0,), (1, 2), GIVEN),
        ((0, 1, 2), (0, 1, 2), GIVEN),
    ],
)
def test_mapper_with_default_options_starts_well_unless_the_printed_ones_need_other_pairs(
    refined: tuple[int, ...], fixed: tuple[int, ...], counts: list[int], mapper: Mapper
) -> None:
    """The printed options keep the intrinsics if they diverge, and the default ones refine them."""
    mapper.refined, mapper.fixed = refined, fixed
    found = matches_of(joint=True, diverge=True)
    start = chosen(found)
    assert counts_of(start) == [*counts, *[FEW] * NUM_DIVERGING]
    assert start.fixed_intrinsics
    assert start.cameras == found.cameras
    assert not start.warnings
    # The default options are tried first.
    refines = [trial.refines for trial in mapper.trials]
    assert refines == sorted(refines, reverse=True)
    assert {trial.is_known for trial in mapper.trials} == {True}


@pytest.mark.parametrize(
    ("angle", "printed", "default"),
    [(None, DEFAULT_LIMITS, {}), (7.0, SMALL_ANGLES, vars(DEFAULT_LIMITS.relaxed[1]))],
)
def test_default_options_are_tried_with_the_limits_of_the_mapper(
    angle: float | None, printed: InitialLimits, default: dict[str, float], mapper: Mapper
) -> None:
    """It lowers them if no pair meets them with certainty."""
    start = chosen(matches_of(joint=True, diverge=True, angle=angle))
    assert start.limits == printed
    assert mapper.trials == [
        Trial(refines=True, is_known=True, limits=default),
        Trial(refines=False, is_known=True, limits=printed.options),
    ]


def test_intrinsics_of_a_database_are_refined_even_if_they_diverge(mapper: Mapper) -> None:
    start = chosen(matches_of(joint=True, diverge=True), keep_cameras=True)
    assert not start.fixed_intrinsics
    assert not mapper.trials


def test_assumed_focal_length_is_refined_if_a_large_model_then_grows(mapper: Mapper) -> None:
    mapper.refined = {0}
    found = matches_of(joint=True, camera=ASSUMED)
    start = chosen(found)
    assert counts_of(start) == [FEW, *GIVEN[1:]]
    assert mapper.trials == [Trial(refines=True, is_known=False, limits={})] * 2
    assert start.cameras == found.cameras
    assert not start.fixed_intrinsics
    assert not start.warnings


@pytest.mark.parametrize(("fixed", "counts"), [((1,), GIVEN), ((0,), [FEW, *GIVEN[1:]])])
def test_assumed_focal_length_is_kept_if_no_large_model_grows(
    fixed: tuple[int, ...], counts: list[int], mapper: Mapper
) -> None:
    """The mapper keeps it only if it counts as known."""
    mapper.refined, mapper.fixed = {0, 1, 2}, fixed
    start = chosen(matches_of(joint=True, camera=ASSUMED))
    assert counts_of(start) == counts
    assert start.fixed_intrinsics
    assert {camera.focal_length for camera in start.cameras} == {ASSUMED.focal_length}
    assert all(camera.has_prior_focal_length for camera in start.cameras)
    assert not ASSUMED.has_prior_focal_length
    (warning,) = start.warnings
    assert "--camera_params" in warning
    refining, keeping = (
        [trial for trial in mapper.trials if trial.refines == refines] for refines in (True, False)
    )
    assert mapper.trials == [*refining, *keeping]
    assert not any(trial.is_known for trial in refining)
    assert all(trial.is_known for trial in keeping)


def test_assumed_focal_length_is_kept_if_the_mapper_stops(mapper: Mapper) -> None:
    mapper.stops = True
    start = chosen(matches_of(joint=True, camera=ASSUMED))
    assert start.fixed_intrinsics
    assert all(camera.has_prior_focal_length for camera in start.cameras)
    assert [trial.refines for trial in mapper.trials] == [True, False]


@pytest.mark.parametrize(("focal_length", "is_kept"), [(0.8 * FOCAL, False), (10 * FOCAL, True)])
def test_mapper_of_colmap_decides_whether_an_assumed_focal_length_is_kept(
    focal_length: float, is_kept: bool
) -> None:
    """It finds the true one from a value that is nearly right, but no model from a wrong one."""
    scene = make_scene()
    camera = copy.copy(ASSUMED)
    camera.focal_length = focal_length
    poses = [
        np.column_stack([rotation, -rotation @ center])
        for rotation, center in zip(scene.rotation, scene.center, strict=True)
    ]
    start = chosen(found_matches(match_scene(scene, camera), camera, [[*poses]]))
    assert start.fixed_intrinsics == is_kept
    assert bool(start.warnings) == is_kept
    assert all(own.has_prior_focal_length == is_kept for own in start.cameras)


@pytest.mark.parametrize(("joint", "keep_cameras"), [(False, False), (False, True), (True, True)])
def test_assumed_focal_length_is_refined_without_poses_and_in_a_database(
    joint: bool, keep_cameras: bool, mapper: Mapper
) -> None:
    """No joint estimate shows that the images do not determine it, or the camera is given."""
    mapper.refined = {0, 1, 2}
    found = matches_of(joint=joint, camera=ASSUMED)
    start = chosen(found, keep_cameras=keep_cameras)
    assert not start.fixed_intrinsics
    assert start.cameras == found.cameras
    assert {trial.refines for trial in mapper.trials} == {True}
    assert not start.warnings


def test_cameras_of_images_that_are_not_registered_do_not_count(mapper: Mapper) -> None:
    """The focal length of a photo without matches is assumed."""
    found = matches_of(joint=True)
    assert found.matched.pairs.max() < len(found.cameras) - 1
    found.cameras[-1] = ASSUMED
    start = chosen(found)
    assert not mapper.trials
    assert not start.fixed_intrinsics
    assert not start.warnings

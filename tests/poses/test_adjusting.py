"""Bundle adjustment on a selection of the observations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pycolmap
import pytest
from dense_scene import OPTIONS, Truth
from hypothesis import given
from hypothesis import strategies as st
from image_sets import images, tracks_from
from scipy.spatial.transform import Rotation

from colmap_av1 import CameraOptions, MatchOptions, ReconstructOptions
from colmap_av1.evaluate.metrics.poses import pose_errors
from colmap_av1.geometry.colmap_model import ModelImage, read_model
from colmap_av1.geometry.model_points import ModelPoints
from colmap_av1.geometry.posed_model import (
    PosedModel,
    posed_model,
    read_posed_model,
    reprojection_errors,
    write_posed_model,
)
from colmap_av1.geometry.track_points import tracks_of_points
from colmap_av1.images.image_set import ImageSet
from colmap_av1.poses import adjusting
from colmap_av1.poses.adjusting import (
    adjust_posed,
    focal_length_errors,
    used_observations,
)
from colmap_av1.poses.adjustment_stage import adjustment_stage
from colmap_av1.poses.estimate_tracks import EstimateTracks
from colmap_av1.poses.posed_images import PosesResult
from colmap_av1.poses.resection_stage import resection_stage
from colmap_av1.poses.run import Run
from colmap_av1.poses.second_distortion import with_second_distortion
from colmap_av1.reconstruct import ReconstructReport
from colmap_av1.util.run_context import RunContext
from colmap_av1.util.stages import Kept


def points_seen_in(views: list[list[int]]) -> ModelPoints:
    """One point for each list of images that see it."""
    lengths = [len(own) for own in views]
    return ModelPoints(
        np.zeros((len(views), 3)),
        np.zeros((len(views), 3), np.uint8),
        np.zeros(len(views)),
        np.cumsum([0, *lengths]),
        np.array([image for own in views for image in own], np.int64),
        np.zeros((sum(lengths), 2)),
    )


@given(
    st.lists(st.tuples(st.integers(0, 30), st.integers(2, 60)), min_size=1, max_size=80),
    st.integers(1, 30),
)
def test_thinning_keeps_a_minimum_per_point_and_image(
    stretches: list[tuple[int, int]], mean: int
) -> None:
    points = points_seen_in([list(range(first, first + count)) for first, count in stretches])
    num_images = int(points.image.max()) + 1
    used = used_observations(points, num_images, mean)
    lengths = np.diff(points.offsets)
    kept = np.add.reduceat(used, points.offsets[:-1])
    assert (kept >= np.minimum(lengths, 8)).all()
    before, after = (
        np.bincount(points.image[own], minlength=num_images) for own in (used | True, used)
    )
    assert (after[before <= mean] == before[before <= mean]).all()
    if len(used) <= mean * num_images:
        assert used.all()


def test_observations_are_thinned_evenly_over_images() -> None:
    points = points_seen_in([list(range(200))] * 1000)
    used = used_observations(points, 200, 250)
    in_images = np.bincount(points.image[used])
    assert in_images.mean() == pytest.approx(250, rel=0.05)
    assert in_images.min() > 200
    assert in_images.max() < 300


def test_points_with_one_observation_are_dropped() -> None:
    points = points_seen_in([[0, 1, 2], [0, 1], [2, 3, 4]])
    left, index = points.keep_observations(np.array([1, 1, 0, 1, 0, 1, 1, 1], np.bool_))
    assert index.tolist() == [0, 2]
    assert left.offsets.tolist() == [0, 2, 5]
    assert left.image.tolist() == [0, 1, 2, 3, 4]


def posed_scene(camera: pycolmap.Camera, turn: float) -> PosedModel:
    """Exact observations of random points by a camera that turns by some degrees per image."""
    rng = np.random.default_rng(0)
    xyz = rng.uniform(-1, 1, (4000, 3)) * [8, 3, 40]
    images, seen = [], list[tuple[int, int, float, float]]()
    for i in range(12):
        rotation = Rotation.from_euler("y", turn * i, degrees=True).as_matrix()
        pose = np.column_stack([rotation, rotation @ [0.1 * i, 0, -0.3 * i]])
        images.append(ModelImage(i + 1, f"{i:02}.png", 1, pose))
        x = xyz @ pose[:, :3].T + pose[:, 3]
        xy = camera.img_from_cam(np.where(x[:, 2:] > 1, x, np.nan))
        there = np.flatnonzero(((xy > 0) & (xy < [640, 480])).all(axis=1))
        seen += [(k, i, *xy[k]) for k in there.tolist()]
    rows = np.array(sorted(seen))
    counts = np.bincount(rows[:, 0].astype(int), minlength=len(xyz))
    points = ModelPoints(
        xyz,
        np.zeros((len(xyz), 3), np.uint8),
        np.zeros(len(xyz)),
        np.cumsum([0, *counts]),
        rows[:, 1].astype(np.int64),
        rows[:, 2:],
    )
    several = points.keep_observations(np.repeat(counts >= 3, counts))[0]
    return PosedModel({1: camera}, images, several)


def test_focal_length_is_observable_with_turns_but_not_on_a_straight_path() -> None:
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 500.0, 640, 480)
    errors = {turn: focal_length_errors(posed_scene(camera, turn))[1] for turn in (0.0, 6.0)}
    assert errors[6.0] < 0.005
    # Infinite in exact arithmetic; rounding may make it finite.
    assert errors[0.0] > 0.1


def named(model: PosedModel, image_set: ImageSet) -> list[ModelImage]:
    """The images of a model with the names of the images of a set."""
    return [
        replace(image, name=name)
        for image, name in zip(model.images, image_set.images.names, strict=True)
    ]


def run_in(folder: Path) -> Run:
    """A run with stages in a folder, and no inputs, which only other stages use."""
    inputs: Any = None
    return Run(inputs, (), (), folder, folder, ReconstructOptions(), RunContext())


@pytest.mark.parametrize(
    ("turn", "is_assumed", "is_kept"), [(2.0, True, False), (0.0, True, True), (0.0, False, False)]
)
def test_assumed_focal_length_is_kept_if_the_images_do_not_determine_another(
    turn: float, is_assumed: bool, is_kept: bool, tmp_path: Path
) -> None:
    """They do if the camera turns. A focal length that was not assumed cannot stay assumed."""
    lens, assumed = (
        pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", focal_length, 640, 480)
        for focal_length in (500.0, 576.0)
    )
    exact, image_set = posed_scene(lens, turn), images(12)
    frames = np.arange(12, dtype=np.int32)
    motion = tracks_of_points(exact.points, frames, 12, (640, 480))
    posed = named(exact, image_set)
    write_posed_model(tmp_path / "poses.npz", PosedModel({1: assumed}, posed))
    adjusted = adjustment_stage(
        run_in(tmp_path),
        EstimateTracks(motion, tracks_from([], 12), has_picture_positions=False),
        image_set,
        Kept(PosesResult("poses.npz", 12), digest="", resumed=False),
        is_assumed=is_assumed,
    ).result
    assert adjusted.keeps_assumed_focal_length == is_kept
    if turn:
        found = read_posed_model(tmp_path / adjusted.poses)
        assert found.cameras[1].focal_length == pytest.approx(500, rel=0.005)


def test_points_of_links_follow_those_of_motion(tmp_path: Path) -> None:
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 500.0, 640, 480)
    exact, image_set = posed_scene(camera, 2.0), images(12)
    every = tracks_of_points(exact.points, np.arange(12, dtype=np.int32), 12, (640, 480))
    is_link = np.arange(every.num_tracks) % 3 == 0
    motion, links = every.keep_tracks(~is_link), every.keep_tracks(is_link)
    write_posed_model(tmp_path / "poses.npz", replace(exact, images=named(exact, image_set)))
    adjusted = adjustment_stage(
        run_in(tmp_path),
        EstimateTracks(motion, links, has_picture_positions=False),
        image_set,
        Kept(PosesResult("poses.npz", 12), digest="", resumed=False),
    ).result
    assert min(adjusted.num_motion_points, adjusted.num_link_points) > 100
    points = read_posed_model(tmp_path / adjusted.poses).points
    first = points.offsets[adjusted.num_motion_points]
    assert {*map(tuple, points.xy[:first].tolist())} <= {*map(tuple, motion.xy.tolist())}
    assert {*map(tuple, points.xy[first:].tolist())} <= {*map(tuple, links.xy.tolist())}
    assert len(points.xyz) == adjusted.num_motion_points + adjusted.num_link_points


def test_images_between_are_not_registered_without_tracks(tmp_path: Path) -> None:
    """The key images keep their poses, as in a model that only links connect."""
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 500.0, 640, 480)
    exact, image_set = posed_scene(camera, 2.0), images(12)
    keyed = image_set.some(range(0, 12, 2))
    write_posed_model(tmp_path / "poses.npz", PosedModel({1: camera}, named(exact, image_set)[::2]))
    poses = Kept(PosesResult("poses.npz", 6), digest="", resumed=False)
    stage = resection_stage(run_in(tmp_path), tracks_from([], 12), image_set, keyed, poses)
    found = read_posed_model(tmp_path / stage.result.poses)
    assert [image.name for image in found.images] == keyed.images.names
    for image, other in zip(found.images, exact.images[::2], strict=True):
        np.testing.assert_array_equal(image.cam_from_world, other.cam_from_world)


@pytest.mark.parametrize(
    ("distortion", "options", "is_better"),
    [
        ((-0.24, 0.06), CameraOptions(), True),
        ((-0.24, 0.0), CameraOptions(), False),
        ((-0.24, 0.06), CameraOptions(camera_model="SIMPLE_RADIAL"), False),
    ],
)
def test_second_distortion_parameter_is_added_if_the_lens_needs_it(
    distortion: tuple[float, float], options: CameraOptions, is_better: bool, tmp_path: Path
) -> None:
    lens = pycolmap.Camera(
        camera_id=1, model="RADIAL", width=640, height=480, params=[400, 320, 240, *distortion]
    )
    exact = posed_scene(lens, 6.0)
    noise = np.random.default_rng(0).normal(0, 0.2, exact.points.xy.shape)
    assumed = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 430.0, 640, 480)
    model = PosedModel(
        {1: assumed}, exact.images, replace(exact.points, xy=exact.points.xy + noise)
    )
    run = SimpleNamespace(
        options=ReconstructOptions(match=MatchOptions(camera=options)),
        cameras=None,
        stages=tmp_path,
        context=RunContext(),
    )
    found = with_second_distortion(run, model)
    if is_better:
        assert found.cameras[1].model_name == "RADIAL"
        assert found.cameras[1].params == pytest.approx(lens.params, rel=0.05)
    else:
        assert found is model


@pytest.mark.parametrize(
    ("lens", "is_kept"),
    [([400, 320, 240, 0.1], False), ([400, 320, 240, 1.5], True), ([150, 320, 240, 0.0], True)],
)
def test_intrinsics_that_diverge_are_kept(lens: list[float], is_kept: bool, tmp_path: Path) -> None:
    camera = pycolmap.Camera(camera_id=1, model="SIMPLE_RADIAL", width=640, height=480, params=lens)
    assumed = pycolmap.Camera({**camera.todict(), "params": [1.4 * lens[0], 320, 240, 0.0]})
    model = replace(posed_scene(camera, 6.0), cameras={1: assumed})
    run = SimpleNamespace(options=ReconstructOptions(), stages=tmp_path, context=RunContext())
    adjusted = adjust_posed(run, model).model
    expected = assumed.params if is_kept else lens
    assert adjusted.cameras[1].params == pytest.approx(expected, rel=0.05)
    assert len(adjusted.images) == len(model.images)


def test_adjustment_recovers_poses_from_half_of_the_observations(
    made: ReconstructReport, truth: Truth, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = posed_model(read_model(made.output / "sparse" / "0"), with_points=True)
    some = model.points.take(np.arange(0, len(model.points.xyz), 5))
    mean = len(some.image) / len(model.images) / 2
    monkeypatch.setattr(adjusting, "OBSERVATIONS", mean)
    assert not used_observations(some, len(model.images), mean).all()
    # These shifts cause errors above the first scale of the robust loss.
    rng = np.random.default_rng(0)
    shifts = np.zeros((len(model.images), 3, 4))
    shifts[:, :, 3] = rng.normal(0, 0.01, (len(model.images), 3))
    images = [
        replace(image, cam_from_world=image.cam_from_world + shift)
        for image, shift in zip(model.images, shifts, strict=True)
    ]
    moved = replace(some, xyz=some.xyz + rng.normal(0, 0.01, some.xyz.shape))
    before = replace(model, images=images, points=moved)
    run = SimpleNamespace(options=OPTIONS, stages=tmp_path, context=RunContext())
    adjusted = adjust_posed(run, before)

    def error(images: Sequence[ModelImage]) -> float:
        known = [truth.cam_from_world[int(image.name[-10:-4])] for image in images]
        found = pose_errors(np.array([image.cam_from_world for image in images]), np.array(known))
        return found.ate / found.extent

    assert [image.name for image in adjusted.model.images] == [own.name for own in images]
    assert error(images) > 0.001
    assert error(adjusted.model.images) < 0.0005
    points, kept = adjusted.model.points, adjusted.kept_points
    assert len(kept) == len(points.xyz) > 0.95 * len(some.xyz)
    assert np.median(reprojection_errors(adjusted.model)) < 1.0
    first = some.xy[some.offsets[:-1]][kept]
    assert np.mean((points.xy[points.offsets[:-1]] == first).all(axis=1)) > 0.95

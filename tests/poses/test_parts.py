"""Models are split at seams that hardly any point joins."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap
import pytest
import walks
from image_sets import images
from sequences import model_poses

from colmap_av1.evaluate import pose_errors
from colmap_av1.geometry.colmap_model import ModelImage, read_model
from colmap_av1.geometry.model_points import ModelPoints
from colmap_av1.geometry.posed_model import PosedModel, read_posed_model, write_posed_model
from colmap_av1.images.image_set import ImageSet
from colmap_av1.options import ReconstructOptions
from colmap_av1.poses.adjustment_stage import AdjustedResult
from colmap_av1.poses.false_links import (
    contradicted_seams,
    jumping_seams,
    leaping_seams,
    misplaced_seams,
)
from colmap_av1.poses.mapping_stage import MappedResult
from colmap_av1.poses.model_tracks import tracks_of_model
from colmap_av1.poses.parts import certain_parts, parts_of, split_stage
from colmap_av1.poses.run import Run
from colmap_av1.reconstruct import reconstruct
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.run_context import RunContext
from colmap_av1.util.stages import Kept


def model(image_set: ImageSet, views: list[list[int]]) -> PosedModel:
    """A model of all images, with a point for each list of images that see it.

    The camera moves sideways past the points, so two views give a point depth.
    """
    count = len(views)
    points = ModelPoints(
        xyz=np.tile([0.0, 0.0, 50.0], (count, 1)),
        rgb=np.zeros((count, 3), np.uint8),
        error=np.zeros(count),
        offsets=np.concatenate([[0], np.cumsum([len(own) for own in views])]).astype(np.int64),
        image=np.concatenate(views).astype(np.int64),
        xy=np.zeros((sum(map(len, views)), 2)),
    )
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 500, 640, 480)
    posed = []
    for number, name in enumerate(image_set.images.names):
        pose = np.eye(3, 4)
        pose[0, 3] = -number
        posed.append(ModelImage(number + 1, name, 1, pose))
    return PosedModel({1: camera}, posed, points)


def names(image_set: ImageSet, *index: int) -> set[str]:
    return {image_set.images.names[i] for i in index}


def seam(image_set: ImageSet, before: int) -> tuple[str, str]:
    return image_set.images.names[before], image_set.images.names[before + 1]


def stretch(*index: int) -> list[list[int]]:
    """Points with depth in some images."""
    return [list(index)] * 200


def test_model_is_split_at_a_seam_with_few_points() -> None:
    image_set = images(30)
    own = [*stretch(0, 12), *stretch(13, 29)]
    few = model(image_set, [*own, *[[11, 12, 13, 14]] * 10])
    first, second = parts_of(few, image_set, [seam(image_set, 12)])
    assert (first, second) == (names(image_set, *range(13, 30)), names(image_set, *range(13)))
    many = model(image_set, [*own, *[[11, 12, 13, 14]] * 200])
    assert len(parts_of(many, image_set, [seam(image_set, 12)])) == 1


def test_points_without_parallax_on_either_side_do_not_join_parts() -> None:
    image_set = images(30)
    own = [*stretch(0, 12), *stretch(13, 29)]
    for views in ([12, 13], [11, 12, 13], [0, 29]):
        known = model(image_set, [*own, *[views] * 1000])
        assert len(parts_of(known, image_set, [seam(image_set, 12)])) == 2


def test_parallax_in_one_of_two_equally_good_models_does_not_join_parts() -> None:
    image_set, seams = images(30), [seam(images(30), 12)]
    known = model(image_set, [*stretch(0, 12), *stretch(13, 29), *[[11, 12, 13, 14]] * 200])
    still = [
        replace(image, cam_from_world=known.images[0].cam_from_world) if number < 13 else image
        for number, image in enumerate(known.images)
    ]
    for rival, count in ((None, 1), (known, 1), (replace(known, images=still), 2)):
        assert len(parts_of(known, image_set, seams, rival=rival)) == count


def test_only_images_of_the_model_give_its_rival_parallax() -> None:
    image_set, seams, used = images(30), [seam(images(30), 14)], range(4, 30)
    own = [*stretch(4, 14), *stretch(15, 29)]
    whole = model(image_set, [*own, *[[13, 14, 15, 16]] * 200])
    points, _ = whole.points.keep_observations(np.isin(whole.points.image, used))
    points = replace(points, image=points.image - used.start)
    part = PosedModel(whole.cameras, [whole.images[i] for i in used], points)
    rival = model(image_set, [*own, *[[0, 14, 15, 16]] * 200])
    assert len(parts_of(whole, image_set, seams, rival=rival)) == 1
    assert len(parts_of(part, image_set, seams)) == 1
    assert len(parts_of(part, image_set, seams, rival=rival)) == 2


def test_a_stretch_without_parallax_joins_no_parts() -> None:
    image_set = images(36)
    seams = [seam(image_set, 14), seam(image_set, 15)]
    own = [*stretch(0, 14), *stretch(16, 35)]
    known = model(image_set, [*own, *[[0, 15]] * 200, *[[15, 35]] * 200])
    first, second = parts_of(known, image_set, seams)
    assert (first, second) == (names(image_set, *range(16, 36)), names(image_set, *range(15)))


def test_a_revisited_place_joins_parts() -> None:
    image_set = images(36)
    seams = [seam(image_set, 11), seam(image_set, 23)]
    own = [*stretch(0, 11), *stretch(12, 23), *stretch(24, 35)]
    assert len(parts_of(model(image_set, [*own, *[[0, 5, 30, 35]] * 10]), image_set, seams)) == 3
    known = model(image_set, [*own, *[[0, 5, 30, 35]] * 200])
    first, second = parts_of(known, image_set, seams)
    assert first == names(image_set, *range(12), *range(24, 36))
    assert second == names(image_set, *range(12, 24))


def test_points_do_not_join_parts_across_a_seam_that_tracks_contradict() -> None:
    image_set = images(36)
    seams = [seam(image_set, 11), seam(image_set, 23)]
    own = [*stretch(0, 11), *stretch(12, 23), *stretch(24, 35)]
    known = model(image_set, [*own, *[[0, 5, 30, 35]] * 200, *[[12, 20, 30, 35]] * 200])
    assert len(parts_of(known, image_set, seams)) == 1
    parts = parts_of(known, image_set, seams, false=seams[:1])
    assert parts == [names(image_set, *range(12, 36)), names(image_set, *range(12))]


@pytest.mark.parametrize("share", [0.2, 0.9])
def test_a_seam_is_contradicted_if_most_tracks_do_not_fit(share: float) -> None:
    image_set = images(12)
    known = seen_at(model(image_set, [[5, 6]] * 100), [10.0] * 100)
    xy = known.points.xy.copy()
    xy[1 : round(2 * 100 * (1 - share)) : 2, 1] += 20  # in the second image
    points = replace(known.points, xy=xy)
    tracks = tracks_of_model(replace(known, points=points), image_set)
    seams = [seam(image_set, 5)]
    contradicted = seams if share < 0.4 else []
    assert contradicted_seams(known, image_set, tracks, seams) == contradicted
    few = tracks.keep_tracks(np.arange(tracks.num_tracks) < 20)
    assert contradicted_seams(known, image_set, few, seams) == []


@pytest.mark.parametrize(("jump", "is_false"), [(1, False), (7, False), (30, True)])
def test_a_camera_that_is_too_fast_at_a_seam_shows_false_links(jump: int, is_false: bool) -> None:
    """Five images are lost at the seam."""
    every = images(24)
    image_set = every.some([*range(10), *range(15, 24)])
    known = model(image_set, [[0, 1]])
    for number, image in enumerate(known.images):
        image.cam_from_world[0, 3] = -number - (jump if number >= 10 else 0)
    seams = [(image_set.images.names[9], image_set.images.names[10])]
    nothing = Tracks.empty(24, (640, 480))
    assert jumping_seams(known, every, nothing, seams) == (seams if is_false else [])


@pytest.mark.parametrize("is_true", [False, True])
def test_speed_at_a_seam_shows_false_links_only_without_tracks(is_true: bool) -> None:
    """A camera may truly be 2.2 times as fast: tracks then cross the seam and fit the poses."""
    image_set, seams = images(24), [seam(images(24), 9)]
    views = [[k, k + 1, k + 2] for k in range(22) if is_true or k not in (8, 9)]
    known = model(image_set, [own for own in views for _ in range(40)])
    for number, image in enumerate(known.images):
        image.cam_from_world[0, 3] = -number - (1.2 if number >= 10 else 0.0)
    seen = seen_at(known, [10.0] * len(known.points.xyz))
    tracks = tracks_of_model(seen, image_set)
    assert jumping_seams(seen, image_set, tracks, seams) == ([] if is_true else seams)
    assert contradicted_seams(seen, image_set, tracks, seams) == []
    assert leaping_seams(seen, image_set) == []


@pytest.mark.parametrize("is_connected", [False, True])
def test_a_jump_splits_a_model_only_if_nothing_else_does(
    is_connected: bool, tmp_path: Path
) -> None:
    """The camera jumps between images 23 and 24. Images 11 and 12 may have no common points."""
    image_set = images(36)
    joined = [*stretch(12, 17, 23, 24, 35), *(stretch(0, 11, 12, 23) if is_connected else [])]
    known = model(image_set, [*stretch(0, 11), *joined])
    for image in known.images[24:]:
        image.cam_from_world[0, 3] -= 30
    write_posed_model(tmp_path / "adjusted.npz", known)
    seams = (seam(image_set, 11), seam(image_set, 23))
    result = AdjustedResult("adjusted.npz", 36, 0, 0, (), seams, (), 0.0, None, False, False)
    mapped = Kept(MappedResult("poses.npz", 36, "incremental", ()), "0", False)
    nothing = Tracks.empty(36, (640, 480))
    inputs: Any = None  # only used by earlier stages
    run = Run(inputs, (), (), tmp_path, tmp_path, ReconstructOptions(), RunContext())
    split = split_stage(
        run,
        image_set,
        mapped,
        Kept(result, "1", False),
        seams,
        leaps=[],
        tracks=nothing,
        whole=nothing,
        rival=None,
        number=3,
    )
    files = [split.result.poses, *split.result.other_models]
    parts = [set(read_posed_model(tmp_path / file).by_name) for file in files]
    at_seam, at_jump = (names(image_set, *range(k)) for k in (12, 24))
    every = names(image_set, *range(36))
    assert parts == ([at_jump, every - at_jump] if is_connected else [every - at_seam, at_seam])


@pytest.mark.parametrize("is_true", [True, False])
def test_a_leap_is_false_if_points_do_not_project_to_their_tracks(is_true: bool) -> None:
    image_set = images(12)
    views = [[k, k + 1, k + 2, k + 3] for k in range(9) for _ in range(40)]
    still = model(image_set, views)
    leaps = replace(
        still, images=[replace(i, cam_from_world=i.cam_from_world.copy()) for i in still.images]
    )
    for image in leaps.images[6:]:
        image.cam_from_world[0, 3] -= 8
    depths = [10.0] * len(views)
    tracks = tracks_of_model(seen_at(leaps if is_true else still, depths), image_set)
    seams = leaping_seams(leaps, image_set)
    assert seams == [seam(image_set, 5)]
    assert misplaced_seams(leaps, image_set, tracks, seams) == ([] if is_true else seams)
    nothing = Tracks.empty(12, (640, 480))
    assert misplaced_seams(leaps, image_set, nothing, seams) == []


def test_another_video_joins_parts() -> None:
    image_set = images(24, 12)
    seams = [seam(image_set, 11)]
    apart = [*stretch(0, 1, 24), *stretch(12, 23)]
    assert len(parts_of(model(image_set, apart), image_set, seams)) == 2
    assert len(parts_of(model(image_set, [*apart, *[[23, 30]] * 30]), image_set, seams)) == 1


def test_short_parts_are_dropped() -> None:
    image_set = images(30)
    seams = [seam(image_set, 13), seam(image_set, 15)]
    parts = parts_of(model(image_set, [[0, 1]]), image_set, seams)
    assert parts == [names(image_set, *range(14)), names(image_set, *range(16, 30))]
    short = images(12)
    parts = parts_of(model(short, [[0, 1]]), short, [seam(short, 6)])
    assert parts == [names(short, *range(7))]


def seen_at(known: PosedModel, depths: list[float]) -> PosedModel:
    """The model with points at these depths, observed where they are, with small errors."""
    rng = np.random.default_rng(0)
    points = known.points
    first = points.image[points.offsets[:-1]]
    across = rng.uniform(-0.4, 0.4, (len(depths), 2)) * np.array(depths)[:, None]
    xyz = np.column_stack([first + 2 + across[:, 0], across[:, 1], depths])
    owner = np.repeat(np.arange(len(depths)), np.diff(points.offsets))
    local = xyz[owner] + np.array([i.cam_from_world[:, 3] for i in known.images])[points.image]
    xy = known.cameras[1].img_from_cam(local) + rng.normal(0, 0.1, (len(owner), 2))
    return replace(known, points=replace(points, xyz=xyz, xy=xy))


def test_uncertain_images_at_an_end_are_removed() -> None:
    image_set = images(24)
    near = [[k, k + 1, k + 2, k + 3] for k in range(11) for _ in range(40)]
    # Points that are so far away do not determine how far the camera moves.
    far = [[k, k + 1, k + 2, k + 3] for k in range(10, 21) for _ in range(40)]
    depths = [10.0] * len(near) + [1e5] * len(far)
    known = seen_at(model(image_set, near + far), depths)
    kept, *removed = certain_parts(known, image_set)
    assert kept == names(image_set, *range(14))
    assert removed == [names(image_set, *range(14, 24))]
    whole = seen_at(model(image_set, near + far), [10.0] * len(depths))
    assert certain_parts(whole, image_set) == [names(image_set, *range(24))]
    assert certain_parts(seen_at(whole, [1e5] * len(depths)), image_set)[0] == set()


@pytest.mark.slow
def test_walk_with_fast_turns_gives_no_bent_model(tmp_path: Path) -> None:
    """No model is bent, and most images are registered, wherever the turns split the walk."""
    num_frames = 75  # two of the four turns
    walks.make_clip(tmp_path / "walk.mp4", seed=0, num_frames=num_frames)
    truth = walks.walk(0)[:num_frames]
    report = reconstruct(tmp_path / "walk.mp4", tmp_path / "output")
    folders = [report.output, *(model.output for model in report.other_models)]
    registered = 0
    for folder in folders:
        found = model_poses(read_model(folder / "sparse" / "0"), len(truth))
        errors = pose_errors(found, truth)
        assert errors is not None
        assert errors.ate < walks.BENT * errors.extent
        registered += int(np.isfinite(found[:, 0, 0]).sum())
    assert registered > 0.7 * report.num_images

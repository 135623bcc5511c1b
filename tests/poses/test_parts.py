"""Splitting of models at seams that hardly any point joins."""

from __future__ import annotations

from pathlib import Path

import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pytest
import walks
from sequences import model_poses

from colmap_av1.evaluate import pose_errors
from colmap_av1.geometry.colmap_model import ModelImage, ModelPoints, read_model
from colmap_av1.geometry.posed_model import PosedModel
from colmap_av1.images.choosing import ChosenImages
from colmap_av1.images.image_set import ImageSet, count_through
from colmap_av1.poses.parts import parts_of
from colmap_av1.reconstruct import reconstruct


def images(*counts: int) -> ImageSet:
    """Images of videos named a, b and so on."""
    chosen = [
        ChosenImages([f"{k:03}.png" for k in range(count)], np.arange(count, dtype=np.int32))
        for count in counts
    ]
    return count_through("abcd"[: len(counts)], chosen, counts)


def model(image_set: ImageSet, views: list[list[int]]) -> PosedModel:
    """All images, and a point for each list of images that see it."""
    count = len(views)
    points = ModelPoints(
        xyz=np.zeros((count, 3)),
        rgb=np.zeros((count, 3), np.uint8),
        error=np.zeros(count),
        offsets=np.concatenate([[0], np.cumsum([len(own) for own in views])]).astype(np.int64),
        image=np.concatenate(views).astype(np.int64),
        xy=np.zeros((sum(map(len, views)), 2)),
    )
    posed = [ModelImage(i + 1, n, 1, np.eye(3, 4)) for i, n in enumerate(image_set.images.names)]
    return PosedModel({}, posed, points)


def names(image_set: ImageSet, *index: int) -> set[str]:
    return {image_set.images.names[i] for i in index}


def seam(image_set: ImageSet, before: int) -> tuple[str, str]:
    return image_set.images.names[before], image_set.images.names[before + 1]


def test_a_seam_that_few_points_join() -> None:
    image_set = images(10)
    known = model(image_set, [[3, 4]] * 50)
    first, second = parts_of(known, image_set, [seam(image_set, 3)])
    assert (first, second) == (names(image_set, *range(4, 10)), names(image_set, *range(4)))
    known = model(image_set, [[2, 3, 4]] * 200)
    assert len(parts_of(known, image_set, [seam(image_set, 3)])) == 1


def test_points_seen_in_a_turn_do_not_hold() -> None:
    image_set = images(10)
    known = model(image_set, [[3, 4]] * 1000)
    assert len(parts_of(known, image_set, [], [seam(image_set, 3)])) == 2
    longer = images(30)
    known = model(longer, [[3, 4]] * 1000 + [[0, 1, 28, 29]] * 200)
    assert len(parts_of(known, longer, [], [seam(longer, 3)])) == 1


def test_a_place_seen_again_holds() -> None:
    image_set = images(12)
    seams = [seam(image_set, 3), seam(image_set, 7)]
    assert len(parts_of(model(image_set, [[0, 11]] * 50), image_set, seams)) == 3
    first, second = parts_of(model(image_set, [[0, 11]] * 200), image_set, seams)
    assert first == names(image_set, *range(4), *range(8, 12))
    assert second == names(image_set, *range(4, 8))


def test_another_video_holds() -> None:
    image_set = images(8, 4)
    seams = [seam(image_set, 3)]
    apart = [[0, 1, 8]] * 100
    assert len(parts_of(model(image_set, apart), image_set, seams)) == 2
    assert len(parts_of(model(image_set, [*apart, *[[7, 9]] * 30]), image_set, seams)) == 1


def test_a_few_images_between_seams_are_left_out() -> None:
    image_set = images(10)
    seams = [seam(image_set, 3), seam(image_set, 5)]
    parts = parts_of(model(image_set, [[0, 1]]), image_set, seams)
    assert parts == [names(image_set, *range(4)), names(image_set, *range(6, 10))]


@pytest.mark.slow
def test_a_walk_through_rooms_with_fast_turns(tmp_path: Path) -> None:
    """No model is bent, whatever the turns leave of it."""
    walks.make_clip(tmp_path / "walk.mp4", seed=0)
    truth = walks.walk(0)
    report = reconstruct(tmp_path / "walk.mp4", tmp_path / "output")
    folders = [report.output, *(model.output for model in report.other_models)]
    registered = 0
    for folder in folders:
        found = model_poses(read_model(folder / "sparse" / "0"), len(truth))
        errors = pose_errors(found, truth)
        assert errors is not None
        assert errors.ate < walks.BENT * errors.extent
        registered += int(np.isfinite(found[:, 0, 0]).sum())
    assert registered > 0.8 * report.num_images

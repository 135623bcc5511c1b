"""Predicting how far a model of COLMAP's incremental mapper grows."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray
from synthetic_scene import CAMERA_PARAMS, HEIGHT, WIDTH, make_scene, match_scene

from colmap_av1.database.writing import write_matches
from colmap_av1.geometry.cameras import make_camera
from colmap_av1.matching.growth import Growth
from colmap_av1.matching.initial_pairs import prepare_start
from colmap_av1.matching.mapper_limits import DEFAULT_LIMITS, SMALL_ANGLES
from colmap_av1.matching.matched_images import MatchedImages
from colmap_av1.options import CameraOptions
from colmap_av1.util.progress import Clock

CAMERA = make_camera(CameraOptions(camera_params=CAMERA_PARAMS), WIDTH, HEIGHT)
NUM_IMAGES = 20
CAMERAS = [CAMERA] * NUM_IMAGES
# The first image of the second part.
SEAM = 10
NUM_CROSSING = 90
FIRST_PART, SECOND_PART = (2, 6), (13, 17)


@pytest.fixture(scope="module")
def scene() -> tuple[MatchedImages, list[NDArray[np.float64]]]:
    """Images of two parts, and their poses.

    Some tracks cross the seam and are observed in one image of the second part: only in the first
    part do these tracks give points. Others are cut, and keep their second part, which therefore
    has more matches.
    """
    made = make_scene(num_frames=NUM_IMAGES, num_points=3000, arc_degrees=60.0)
    tracks = made.tracks
    is_second = tracks.frame >= SEAM
    num_second = np.add.reduceat(is_second, tracks.offsets[:-1])
    crossing = np.flatnonzero((num_second > 0) & (num_second < tracks.lengths))
    kept = np.ones(tracks.num_observations, np.bool_)
    for order, track in enumerate(crossing.tolist()):
        own = slice(tracks.offsets[track], tracks.offsets[track + 1])
        kept[own] = is_second[own]
        if order < NUM_CROSSING:
            kept[own] = ~is_second[own] | (tracks.frame[own] == SEAM + order % 2)
    matched = match_scene(replace(made, tracks=tracks.keep_observations(kept)), CAMERA)
    poses = [
        np.column_stack([rotation, -rotation @ center])
        for rotation, center in zip(made.rotation, made.center, strict=True)
    ]
    return matched, poses


def num_mapped(matched: MatchedImages, folder: Path, pair: tuple[int, int] | None) -> int:
    """Number of images in the first model of COLMAP's mapper that begins with a pair."""
    folder.mkdir()
    names = [f"{number:02}.jpg" for number in range(NUM_IMAGES)]
    write_matches(folder / "a.db", names, CAMERAS, matched)
    options = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=0)
    if pair is not None:
        options.mapper.init_min_tri_angle = SMALL_ANGLES.init_min_tri_angle
        options.init_image_id1, options.init_image_id2 = (image + 1 for image in pair)
    models = pycolmap.incremental_mapping(folder / "a.db", folder, folder, options=options)
    return int(models[0].num_reg_images())


def test_growth_depends_on_the_initial_pair(
    scene: tuple[MatchedImages, list[NDArray[np.float64]]], tmp_path: Path
) -> None:
    matched, poses = scene
    growth = Growth(matched, CAMERAS, [poses])
    for pair, count in ((FIRST_PART, NUM_IMAGES), (SECOND_PART, NUM_IMAGES - SEAM)):
        assert growth.registered(pair).sum() == count
        assert num_mapped(matched, tmp_path / str(pair), pair) == count
    assert growth.registered(FIRST_PART, max_images=5).sum() == 5


def test_models_do_not_grow_across_models(
    scene: tuple[MatchedImages, list[NDArray[np.float64]]],
) -> None:
    matched, poses = scene
    nothing: list[None] = [None] * NUM_IMAGES
    known = [[*poses[:SEAM], *nothing[SEAM:]], [*nothing[:SEAM], *poses[SEAM:]]]
    growth = Growth(matched, CAMERAS, known)
    assert np.flatnonzero(growth.registered(FIRST_PART)).tolist() == list(range(SEAM))


def test_the_mapper_begins_with_a_pair_from_which_a_large_model_grows(
    scene: tuple[MatchedImages, list[NDArray[np.float64]]], tmp_path: Path
) -> None:
    matched, poses = scene
    assert num_mapped(matched, tmp_path / "before", None) == NUM_IMAGES - SEAM
    found = prepare_start(matched, CAMERAS, Clock(), [poses])
    assert found.is_certain
    assert found.limits == DEFAULT_LIMITS
    assert num_mapped(found.matched, tmp_path / "after", None) == NUM_IMAGES

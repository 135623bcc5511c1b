"""Selecting the tracks that COLMAP's global mapper starts from."""

from __future__ import annotations

import shutil
from collections import defaultdict
from pathlib import Path

import numpy as np
import pycolmap
from dense_scene import NUM_IMAGES, Truth
from numpy.typing import NDArray
from sequences import model_poses

from colmap_av1.database.reading import image_ids_from_pair_id
from colmap_av1.evaluate.metrics.poses import pose_errors
from colmap_av1.geometry.colmap_model import read_model
from colmap_av1.options import MapOptions
from colmap_av1.poses.longest_tracks import TRACKS_OF_IMAGE, TRACKS_OF_PAIR, keep_longest_tracks
from colmap_av1.poses.mapper import map_poses
from colmap_av1.reconstruct import ReconstructReport
from colmap_av1.util.progress import no_progress

Inliers = dict[tuple[int, int], NDArray[np.uint32]]


def inliers_of(database: Path) -> Inliers:
    """The inlier matches of each pair of image ids."""
    copy = shutil.copyfile(database, database.with_suffix(".copy"))
    with pycolmap.Database.open(copy) as opened:
        pair_ids, geometries = opened.read_two_view_geometries()
    found = {}
    for pair_id, geometry in zip(pair_ids, geometries, strict=True):
        found[image_ids_from_pair_id(int(pair_id))] = geometry.inlier_matches
    return found


def num_matched(inliers: Inliers) -> dict[int, int]:
    """The number of keypoints with a match, for each image id."""
    matched = defaultdict[int, set[int]](set)
    for pair, matches in inliers.items():
        for image_id, keypoints in zip(pair, matches.T.tolist(), strict=True):
            matched[image_id].update(keypoints)
    return {image_id: len(own) for image_id, own in matched.items()}


def test_images_and_pairs_keep_their_number_of_tracks(
    made: ReconstructReport, tmp_path: Path
) -> None:
    database = shutil.copyfile(made.database, tmp_path / "few.db")
    keep_longest_tracks(database)
    before, after = inliers_of(made.database), inliers_of(database)
    assert before.keys() == after.keys()
    for pair, matches in after.items():
        assert len(matches) >= min(TRACKS_OF_PAIR, len(before[pair]))
        assert {*map(tuple, matches.tolist())} <= {*map(tuple, before[pair].tolist())}
    counts = num_matched(after)
    for image_id, count in num_matched(before).items():
        assert counts[image_id] >= min(TRACKS_OF_IMAGE, count)
    assert sum(map(len, after.values())) < sum(map(len, before.values()))


def test_poses_are_as_accurate_as_with_all_tracks(
    made: ReconstructReport, truth: Truth, tmp_path: Path
) -> None:
    errors = {}
    for name in ("all", "few"):
        database = shutil.copyfile(made.database, tmp_path / f"{name}.db")
        if name == "few":
            keep_longest_tracks(database)
        sizes = map_poses(
            database,
            tmp_path / name,
            MapOptions(mapper="global", num_threads=1),
            image_path=None,
            log=tmp_path / "log",
            num_images=NUM_IMAGES,
            progress=no_progress,
        )
        assert sizes == (made.num_key_images,)
        model = read_model(tmp_path / name / "0")
        errors[name] = pose_errors(model_poses(model, 60), truth.cam_from_world)
    assert errors["few"].rotation < 2 * errors["all"].rotation


def test_short_tracks_across_a_gap_are_kept(tmp_path: Path) -> None:
    """The tracks on either side are longer and more than an image needs."""
    num_long, num_short = 3 * TRACKS_OF_IMAGE, TRACKS_OF_PAIR - 5
    rng = np.random.default_rng(0)
    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=640, height=480, params=[500, 320, 240])
    database = tmp_path / "a.db"
    with pycolmap.Database.open(database) as opened:
        camera.camera_id = opened.write_camera(camera)
        for number in range(10):
            image = pycolmap.Image(name=f"{number}.jpg", camera_id=camera.camera_id)
            image_id = opened.write_image(image)
            opened.write_keypoints(image_id, rng.uniform(0, 480, (num_long + num_short, 2)))
        for half in (range(1, 6), range(6, 11)):
            for first in half:
                for second in range(first + 1, half.stop):
                    opened.write_two_view_geometry(first, second, matching(0, num_long))
        opened.write_two_view_geometry(5, 6, matching(num_long, num_long + num_short))
    keep_longest_tracks(database)
    after = inliers_of(database)
    assert len(after[5, 6]) == num_short
    assert all(len(matches) == TRACKS_OF_IMAGE for pair, matches in after.items() if pair != (5, 6))


def matching(first: int, stop: int) -> pycolmap.TwoViewGeometry:
    """A pair in which keypoints of the same number match."""
    numbers = np.arange(first, stop, dtype=np.uint32)
    return pycolmap.TwoViewGeometry(
        config=pycolmap.TwoViewGeometryConfiguration.CALIBRATED,
        inlier_matches=np.column_stack([numbers, numbers]),
    )

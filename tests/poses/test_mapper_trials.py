"""Running COLMAP's mapper to check that it starts well from matches."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation
from synthetic_scene import CAMERA_PARAMS, HEIGHT, WIDTH, make_scene, match_scene

from colmap_av1.database.writing import write_matches
from colmap_av1.geometry.cameras import make_camera
from colmap_av1.matching.initial_pairs import PreparedStart
from colmap_av1.matching.mapper_limits import DEFAULT_LIMITS, INITIAL_MIN_INLIERS
from colmap_av1.matching.matched_images import MatchedImages
from colmap_av1.matching.pairs import ImageKeypoints
from colmap_av1.matching.verify import verify_pairs
from colmap_av1.options import CameraOptions
from colmap_av1.poses.mapper_trials import demote_failing_starts
from colmap_av1.util.progress import Clock

CAMERA = make_camera(CameraOptions(camera_params=CAMERA_PARAMS), WIDTH, HEIGHT)
NUM_IMAGES = 16
NAMES = [f"{number:02}.jpg" for number in range(NUM_IMAGES)]


@pytest.fixture(scope="module")
def scene() -> MatchedImages:
    """Images of one scene."""
    return match_scene(make_scene(num_frames=NUM_IMAGES), CAMERA)


@pytest.fixture(scope="module", params=[(2, 7, 13), (6, 7, 8)], ids=["far", "neighbours"])
def with_moving_object(scene: MatchedImages, request: pytest.FixtureRequest) -> MatchedImages:
    """The images, three of which show a large object that moves relative to the scene."""
    moving = request.param
    rng = np.random.default_rng(0)
    count = 2000
    points = rng.uniform((-3, -2, -2), (3, 2, 2), (count, 3))
    keypoints = list(scene.keypoints)
    first_track = 1 + max(int(own.track.max()) for own in keypoints)
    seen = []
    for image, angle, depth in zip(moving, (0, 20, 42), (9, 10, 12), strict=True):
        turn = Rotation.from_euler("y", angle, degrees=True).as_matrix()
        xy = CAMERA.img_from_cam(points @ turn.T + [0, 0, depth]) + rng.normal(0, 0.3, (count, 2))
        track = first_track + np.arange(count)
        seen.append(ImageKeypoints(xy.astype(np.float32), track))
        own = keypoints[image]
        keypoints[image] = replace(
            own,
            xy=np.concatenate([own.xy, xy]).astype(np.float32),
            track=np.concatenate([own.track, track]),
        )
    pairs = np.array([[0, 1], [0, 2], [1, 2]], np.int32)
    matches = np.column_stack([np.arange(count)] * 2).astype(np.uint32)
    geometries = verify_pairs(seen, pairs, [matches] * 3, CAMERA)
    of_images = np.array(moving)[pairs]
    is_moving = np.isin(scene.pairs, moving).all(axis=1)
    others = np.flatnonzero(~is_moving).tolist()
    first = np.array([len(own.xy) for own in scene.keypoints])[of_images]
    return replace(
        scene,
        keypoints=keypoints,
        pairs=np.vstack([scene.pairs[others], of_images]).astype(np.int32),
        matches=[
            *(scene.matches[k] for k in others),
            *((matches + own).astype(np.uint32) for own in first),
        ],
        geometries=[
            *(scene.geometries[k] for k in others),
            *(
                replace(g, inlier_matches=(g.inlier_matches + own).astype(np.uint32))
                for g, own in zip(geometries, first, strict=True)
            ),
        ],
    )


def num_registered(matched: MatchedImages, folder: Path) -> list[int]:
    """The number of images of each model of COLMAP's mapper."""
    folder.mkdir()
    write_matches(folder / "a.db", NAMES, [CAMERA] * NUM_IMAGES, matched)
    options = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=0)
    found = pycolmap.incremental_mapping(folder / "a.db", folder, folder, options=options)
    return [found[number].num_reg_images() for number in sorted(found)]


def prepared(matched: MatchedImages) -> PreparedStart:
    return PreparedStart(
        matched, DEFAULT_LIMITS, is_certain=True, is_tried=False, intrinsics_diverge=False
    )


def test_pair_from_which_no_model_grows_is_demoted(
    with_moving_object: MatchedImages, tmp_path: Path
) -> None:
    assert num_registered(with_moving_object, tmp_path / "before")[0] < NUM_IMAGES / 2
    start = prepared(with_moving_object)
    found = demote_failing_starts(start, NAMES, [CAMERA] * NUM_IMAGES, Clock())
    assert found is not None
    assert num_registered(found, tmp_path / "after") == [NUM_IMAGES]
    counts = [len(geometry.inlier_matches) for geometry in found.geometries[-3:]]
    assert 15 <= min(counts) < INITIAL_MIN_INLIERS / 2


def test_pairs_keep_their_inliers_if_the_mapper_starts_well(scene: MatchedImages) -> None:
    start = prepared(scene)
    found = demote_failing_starts(start, NAMES, [CAMERA] * NUM_IMAGES, Clock())
    assert found is not None
    assert found.geometries == scene.geometries


def test_pairs_keep_their_inliers_if_no_larger_model_is_possible(
    with_moving_object: MatchedImages,
) -> None:
    alone = replace(
        with_moving_object,
        pairs=with_moving_object.pairs[-3:],
        matches=with_moving_object.matches[-3:],
        geometries=with_moving_object.geometries[-3:],
    )
    start = prepared(alone)
    found = demote_failing_starts(start, NAMES, [CAMERA] * NUM_IMAGES, Clock())
    assert found is not None
    assert found.geometries == alone.geometries

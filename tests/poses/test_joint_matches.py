"""Matches that agree with a joint estimate of all poses."""

from __future__ import annotations

import shutil
import sqlite3
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from conftest import QUICK_AV1, Encode
from databases import keypoints_of
from dense_scene import SCENE, Truth
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from sequences import model_poses

from colmap_av1.database.reading import read_cameras
from colmap_av1.errors import ModelError, OptionError, VideoError
from colmap_av1.evaluate.metrics.poses import pose_errors
from colmap_av1.geometry.colmap_model import ModelImage, read_model
from colmap_av1.match import match
from colmap_av1.match_report import MatchReport
from colmap_av1.options import (
    CameraOptions,
    DensityOptions,
    ImageOptions,
    LinkOptions,
    MatchOptions,
    PairOptions,
    RunOptions,
    VerifyOptions,
)
from colmap_av1.poses import estimate, long_range
from colmap_av1.poses.estimate_steps import Estimate
from colmap_av1.poses.initial_pair import initial_pair
from colmap_av1.poses.joint_matches import are_inliers
from colmap_av1.video.decoding import decode_frames

# The pictures of the rendered clip are scaled by this factor.
SIZE = 0.75
EVERY = 5
OPTIONS = MatchOptions(images=ImageOptions(every=EVERY))


def by_pairs(options: MatchOptions) -> MatchOptions:
    """The same options with verification pair by pair."""
    return replace(options, verify=VerifyOptions(verify="pairs"))


def mapped(database: Path, images: Path) -> pycolmap.Reconstruction:
    """Run COLMAP's incremental mapper, and return the model in folder 0."""
    output = database.with_suffix(".models")
    output.mkdir()
    # pycolmap migrates the database that it opens.
    copy = shutil.copyfile(database, output / "copy.db")
    options = pycolmap.IncrementalPipelineOptions(random_seed=0, num_threads=1)
    pycolmap.incremental_mapping(copy, images, output, options=options)
    return read_model(output / "0")


def smaller(picture: NDArray[np.uint8], size: float) -> NDArray[np.uint8]:
    return cv2.resize(picture, None, fx=size, fy=size, interpolation=cv2.INTER_AREA)


def num_keypoints(database: Path) -> dict[str, int]:
    return {name: len(xy) for name, xy in keypoints_of(database).items()}


@pytest.fixture(scope="module")
def scene(encode: Encode, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The rendered clip in smaller pictures."""
    pictures = np.stack([smaller(picture, SIZE) for _, picture in decode_frames(SCENE)])
    return encode(pictures, tmp_path_factory.mktemp("scene") / "scene.mp4", *QUICK_AV1)


@pytest.fixture(scope="module")
def joint(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> MatchReport:
    folder = tmp_path_factory.mktemp("joint")
    return match(folder / "a.db", scene, image_path=folder / "images", options=OPTIONS)


def test_mapper_gets_fewer_keypoints_and_better_poses_with_joint_matches(
    joint: MatchReport, scene: Path, truth: Truth, tmp_path: Path
) -> None:
    images = joint.image_path
    assert images is not None
    assert joint.estimate is not None
    assert joint.estimate.num_registered == (joint.num_images,)
    assert joint.warnings == ()
    other = match(tmp_path / "b.db", scene, image_path=images, options=by_pairs(OPTIONS))
    assert other.estimate is None
    assert joint.num_observations < 0.7 * other.num_observations
    errors = []
    for database in (joint.database, other.database):
        model = mapped(database, images)
        assert model.num_reg_images() == joint.num_images
        found = pose_errors(model_poses(model, len(truth.cam_from_world)), truth.cam_from_world)
        assert found is not None
        errors.append(found.ate)
    assert errors[0] < errors[1]


def test_camera_of_the_database_is_the_estimated_one(joint: MatchReport, truth: Truth) -> None:
    assert joint.focal_length == pytest.approx(truth.camera.focal_length_x * SIZE, rel=0.005)
    (camera,) = read_cameras(joint.database).values()
    assert camera.has_prior_focal_length
    assert camera.focal_length_x == pytest.approx(joint.focal_length)
    assert camera.model_name == "RADIAL"


@pytest.mark.parametrize(("median", "inliers"), [(0.15, [True, False]), (0.3, [True, True])])
def test_links_may_have_larger_errors_than_corners(median: float, inliers: list[bool]) -> None:
    """Unless all errors are large, as those of a rolling shutter."""
    errors = np.array([0.9, 0.9, *[median] * 5])
    is_link = np.arange(7) == 0
    assert are_inliers(errors, is_link)[:2].tolist() == inliers


def test_no_track_has_two_keypoints_in_an_image(joint: MatchReport) -> None:
    with sqlite3.connect(joint.database) as connection:
        for rows, data in connection.execute("SELECT rows, data FROM keypoints"):
            xy = np.frombuffer(data, np.float32).reshape(rows, -1)[:, :2]
            near, _ = cKDTree(xy).query(xy, k=2)
            assert near[:, 1].min() > 0.01


def test_given_pairs_exclude_a_joint_estimate(
    joint: MatchReport, scene: Path, tmp_path: Path
) -> None:
    """A joint estimate chooses the pairs itself."""
    images, given = joint.image_path, PairOptions(offsets=(1, 2), growth=1)
    report = match(
        tmp_path / "a.db", scene, image_path=images, options=replace(OPTIONS, pairs=given)
    )
    assert report.estimate is None
    assert report.num_pairs == 2 * joint.num_images - 3
    options = replace(OPTIONS, pairs=given, verify=VerifyOptions(verify="joint"))
    with pytest.raises(OptionError, match="offsets"):
        match(tmp_path / "b.db", scene, image_path=images, options=options)


def test_requested_joint_estimate_that_fails_is_an_error(scene: Path, tmp_path: Path) -> None:
    (tmp_path / "list.txt").write_text("0\n4\n")
    options = MatchOptions(
        images=ImageOptions(frame_list=str(tmp_path / "list.txt")),
        density=DensityOptions(min_images=2),
        verify=VerifyOptions(verify="joint"),
    )
    with pytest.raises((ModelError, VideoError)):
        match(tmp_path / "a.db", scene, options=options)
    assert not (tmp_path / "a.db").exists()


def test_error_of_a_requested_joint_estimate_says_what_to_do(
    joint: MatchReport, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The log that the mapper's message names is deleted with the other temporary files."""

    def fail(*_: object, **__: object) -> None:
        raise ModelError("the mapper stopped with status 3: see scratch/mapper.log")

    monkeypatch.setattr("colmap_av1.poses.match_prepared.match_jointly", fail)
    options = replace(OPTIONS, verify=VerifyOptions(verify="joint"))
    with pytest.raises(ModelError, match="--verify") as raised:
        match(tmp_path / "a.db", scene, image_path=joint.image_path, options=options)
    assert "mapper.log" not in str(raised.value)


def test_matches_of_a_doubtful_joint_estimate_are_kept_with_a_warning(
    joint: MatchReport, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Images far apart in time contradict it; pairs alone would mostly give worse models."""
    monkeypatch.setattr(long_range, "_MAX_ERROR", 0.0)
    report = match(tmp_path / "a.db", scene, image_path=joint.image_path, options=OPTIONS)
    assert report.estimate is not None
    assert any("contradict" in warning for warning in report.warnings)
    model = mapped(report.database, joint.image_path)
    assert model.num_reg_images() == joint.num_images


@pytest.mark.parametrize("is_wrong", [False, True])
def test_links_that_images_contradict_are_not_used(
    joint: MatchReport,
    scene: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    is_wrong: bool,
) -> None:
    """Links at a doubtful seam replace motion unless images contradict only poses with them."""
    monkeypatch.setattr(estimate, "unlinked_seams", lambda run, image_set, posed: [30])
    is_contradicted = property(lambda own: is_wrong and bool(own.matches.result.links.gaps))
    monkeypatch.setattr(Estimate, "is_contradicted", is_contradicted)
    report = match(tmp_path / "a.db", scene, image_path=joint.image_path, options=OPTIONS)
    assert not joint.links.gaps
    assert bool(report.links.gaps) != is_wrong
    assert report.estimate is not None
    assert report.estimate.num_registered == (joint.num_images,)


@pytest.mark.parametrize("is_right", [False, True])
def test_links_are_left_out_if_images_agree_only_with_poses_without_them(
    joint: MatchReport,
    scene: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    is_right: bool,
) -> None:
    monkeypatch.setattr(estimate, "unlinked_seams", lambda run, image_set, posed: [30])
    monkeypatch.setattr(Estimate, "is_contradicted", property(lambda _: True))
    monkeypatch.setattr(Estimate, "is_confirmed", property(lambda _: is_right))
    report = match(tmp_path / "a.db", scene, image_path=joint.image_path, options=OPTIONS)
    assert (report.links.num_links == 0) == is_right
    assert report.estimate is not None
    assert report.estimate.num_registered == (joint.num_images,)


def test_same_input_gives_the_same_database(
    joint: MatchReport, scene: Path, tmp_path: Path
) -> None:
    """The number of threads makes no difference."""
    one = replace(OPTIONS, run=RunOptions(num_threads=1))
    match(tmp_path / "a.db", scene, image_path=joint.image_path, options=one)
    dumps = []
    for path in (joint.database, tmp_path / "a.db"):
        with sqlite3.connect(path) as connection:
            dumps.append(list(connection.iterdump()))
    assert dumps[0] == dumps[1]


def test_focal_length_fits_existing_images_of_half_the_size(
    joint: MatchReport, scene: Path, truth: Truth, tmp_path: Path
) -> None:
    assert joint.image_path is not None
    halves = tmp_path / "halves"
    halves.mkdir()
    for path in joint.image_path.iterdir():
        picture = cv2.imread(str(path))
        cv2.imwrite(str(halves / f"half_{path.name}"), smaller(picture, 0.5))
    report = match(tmp_path / "a.db", scene, image_path=halves, options=OPTIONS)
    assert report.estimate is not None
    assert report.estimate.num_registered == (joint.num_images,)
    assert report.focal_length == pytest.approx(truth.camera.focal_length_x * SIZE / 2, rel=0.01)


def test_too_few_images_for_a_joint_estimate_are_verified_by_pairs(
    scene: Path, tmp_path: Path
) -> None:
    (tmp_path / "list.txt").write_text("0\n4\n")
    options = MatchOptions(
        images=ImageOptions(frame_list=str(tmp_path / "list.txt")),
        density=DensityOptions(min_images=2),
    )
    report = match(tmp_path / "a.db", scene, image_path=tmp_path / "images", options=options)
    assert report.estimate is None
    assert any("joint estimate" in warning for warning in report.warnings)
    match(tmp_path / "b.db", scene, options=by_pairs(options))
    assert num_keypoints(tmp_path / "a.db") == num_keypoints(tmp_path / "b.db")


def test_camera_per_image_excludes_a_joint_estimate(
    joint: MatchReport, scene: Path, tmp_path: Path
) -> None:
    assert joint.image_path is not None
    few = tmp_path / "few"
    few.mkdir()
    for path in sorted(joint.image_path.iterdir())[:4]:
        shutil.copy(path, few)
    database = tmp_path / "existing.db"
    with pycolmap.Database.open(database):  # creates the file
        pass
    pycolmap.import_images(database, few, pycolmap.CameraMode.PER_IMAGE)
    report = match(database, scene, image_path=few)
    assert report.estimate is None
    assert any("several cameras" in warning for warning in report.warnings)
    options = replace(OPTIONS, verify=VerifyOptions(verify="joint"))
    options = replace(options, camera=CameraOptions(single_camera=False))
    with pytest.raises(OptionError, match="single_camera"):
        match(tmp_path / "new.db", scene, image_path=joint.image_path, options=options)


def test_no_temporary_files_are_left_next_to_the_database(joint: MatchReport) -> None:
    assert {path.name for path in joint.database.parent.iterdir()} >= {"a.db", "images"}
    assert not [p for p in joint.database.parent.iterdir() if p.name.startswith(".")]


@pytest.mark.parametrize("count", [13, 8])
def test_estimate_has_a_model_of_each_scene(count: int, encode: Encode, tmp_path: Path) -> None:
    """The larger model comes first, and a scene with too few images has none.

    The second scene is the mirrored end of the clip, in which nothing matches the first.
    """
    pictures = [smaller(picture, 0.75) for _, picture in decode_frames(SCENE)]
    videos = [
        encode(
            np.stack([p[:, ::-1] for p in pictures[40 : 40 + count]]),
            tmp_path / "one.mp4",
            *QUICK_AV1,
        ),
        encode(np.stack(pictures[:18]), tmp_path / "two.mp4", *QUICK_AV1),
    ]
    options = MatchOptions(
        links=LinkOptions(links="none"), camera=CameraOptions(single_camera=True)
    )
    report = match(tmp_path / "a.db", videos, image_path=tmp_path / "images", options=options)
    assert len(read_cameras(report.database)) == 1
    assert report.estimate is not None
    first, *others = report.estimate.num_registered
    assert first >= 16
    assert [number >= 11 for number in others] == [True] * (count >= 10)
    num_missing = report.num_images - first - sum(others)
    is_reported = any(f"{num_missing} of {report.num_images} images" in w for w in report.warnings)
    assert is_reported == (num_missing > 0)
    assert min(num_keypoints(report.database).values()) > 100
    if count >= 10:
        models = tmp_path / "models"
        models.mkdir()
        found = pycolmap.incremental_mapping(report.database, report.image_path, models)
        registered = [found[number].num_reg_images() for number in range(len(found))]
        assert len(registered) == 2
        assert registered[0] >= 16
        assert sum(registered) >= report.num_images - 2


def images_ahead(count: int) -> list[ModelImage]:
    """Images of a camera that moves along its axis."""
    poses = [np.hstack([np.eye(3), [[0], [0], [-1.0 * i]]]) for i in range(count)]
    return [ModelImage(i + 1, f"{i}.png", 1, pose) for i, pose in enumerate(poses)]


def test_initial_pair_of_a_drive_uses_points_beside_the_road() -> None:
    """Distant points ahead have too little parallax."""
    rng = np.random.default_rng(0)
    images = images_ahead(12)
    far = np.column_stack([rng.uniform(-20, 20, (2000, 2)), rng.uniform(100, 200, 2000)])
    near = np.column_stack([rng.uniform(3, 5, (400, 2)), rng.uniform(14, 25, 400)])
    xyz = np.concatenate([far, near])
    point = np.repeat(np.arange(len(xyz)), len(images))
    view = np.tile(np.arange(len(images)), len(xyz))
    start = initial_pair(point, view, xyz, images)
    assert start is not None
    assert len(start.points) >= 150
    assert (start.points >= len(far)).all()
    rays = xyz[start.points, None] - np.array([[0, 0, start.first], [0, 0, start.second]])
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    angles = np.degrees(np.arccos((rays[:, 0] * rays[:, 1]).sum(axis=1)))
    assert np.median(angles) > 8
    only = point < len(far)
    assert initial_pair(point[only], view[only], far, images) is None

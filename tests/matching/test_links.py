"""SIFT links: matches of SIFT features across gaps, where motion connects images badly."""

from __future__ import annotations

import copy
import re
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pycolmap
import pytest
from conftest import PROJECT, QUICK_AV1, STREET, Encode, Street, make_frames
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from sequences import model_poses
from synthetic_scene import alignment_error

from colmap_av1.check.database import check_database
from colmap_av1.database.reading import image_ids_from_pair_id
from colmap_av1.errors import VideoError
from colmap_av1.geometry.colmap_model import camera_centres
from colmap_av1.match import match
from colmap_av1.match_report import MatchReport
from colmap_av1.matching.features.retrieval import similar_images
from colmap_av1.matching.features.sift import Features, extract_features, match_features
from colmap_av1.matching.links.matching import Links
from colmap_av1.matching.links.merging import links_as_tracks, merge_links
from colmap_av1.matching.matched_images import MatchedImages
from colmap_av1.matching.pairs import ImageKeypoints
from colmap_av1.matching.two_view_geometry import TwoViewConfig, TwoViewGeometry
from colmap_av1.options import (
    ImageOptions,
    LinkOptions,
    MatchOptions,
    ReconstructOptions,
    VerifyOptions,
)
from colmap_av1.reconstruct import ReconstructReport, reconstruct
from colmap_av1.video.decoding import decode_frames

SCENE = PROJECT / "examples" / "scene.mp4"
TRUTH = PROJECT / "examples" / "scene_truth.npz"
# Frames removed from the rendered clip, so that the camera jerks there.
LEFT_OUT = range(24, 40)
FAR_OUT = range(14, 46)
# Without these frames, a tenth of the usual number of points join the images at the jerk.
DOUBTFUL_OUT = range(8, 50)


def pictures(video: Path = SCENE) -> list[NDArray[np.uint8]]:
    return [image for _, image in decode_frames(video)]


@pytest.fixture(scope="module")
def halved() -> NDArray[np.uint8]:
    """The pictures of the rendered clip at half their size."""
    halves = [cv2.resize(p, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for p in pictures()]
    return np.array(halves)


@pytest.fixture(scope="module")
def steady(
    halved: NDArray[np.uint8], encode: Encode, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """The rendered clip up to frame 35."""
    return encode(halved[:36], tmp_path_factory.mktemp("steady") / "steady.mp4", *QUICK_AV1)


@pytest.fixture(scope="module")
def jerk(
    halved: NDArray[np.uint8], encode: Encode, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """The rendered clip without 16 frames in the middle."""
    return encode(_without(halved, LEFT_OUT), tmp_path_factory.mktemp("jerk") / "jerk.mp4")


@pytest.fixture(scope="module")
def far_jerk(
    halved: NDArray[np.uint8], encode: Encode, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """The rendered clip without 32 frames in the middle."""
    return encode(_without(halved, FAR_OUT), tmp_path_factory.mktemp("far") / "jerk.mp4")


def _without(frames: NDArray[np.uint8], left_out: range) -> NDArray[np.uint8]:
    return np.delete(frames, left_out, axis=0)


def test_feature_matches_agree_with_the_true_epipolar_lines() -> None:
    images = pictures()
    a, b = extract_features(images[0], 1500), extract_features(images[30], 1500)
    matches = match_features(a, b)
    assert len(matches) > 100
    with np.load(TRUTH) as truth:
        K = np.array(
            [[truth["fx"], 0, truth["cx"]], [0, truth["fy"], truth["cy"]], [0, 0, 1]], np.float64
        )
        pose_a, pose_b = truth["cam_from_world"][[0, 30]]
    R = pose_b[:, :3] @ pose_a[:, :3].T
    t = pose_b[:, 3] - R @ pose_a[:, 3]
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    F = np.linalg.inv(K).T @ cross @ R @ np.linalg.inv(K)
    xa = np.column_stack([a.xy[matches[:, 0]], np.ones(len(matches))])
    xb = np.column_stack([b.xy[matches[:, 1]], np.ones(len(matches))])
    lines = xa @ F.T
    distance = np.abs((xb * lines).sum(1)) / np.hypot(lines[:, 0], lines[:, 1])
    assert np.median(distance) < 0.5


def test_image_without_features_has_no_matches() -> None:
    plain = extract_features(np.full((64, 64, 3), 128, np.uint8), 100)
    assert plain.xy.shape == (0, 2)
    assert len(match_features(plain, extract_features(pictures()[0], 100))) == 0


@pytest.fixture(scope="module")
def there_and_back() -> list[Features]:
    """Features of images along a path, and the same in reverse order."""
    there = [extract_features(image, 800) for image in pictures()[::6]]
    return [*there, *(copy.deepcopy(f) for f in reversed(there))]


def are_apart(count: int) -> NDArray[np.bool_]:
    """Whether images are at least 3 images apart, [count, count]."""
    return np.abs(np.subtract.outer(np.arange(count), np.arange(count))) >= 3


def test_similar_images_show_the_same_place(there_and_back: list[Features]) -> None:
    count = len(there_and_back)
    pairs = similar_images(there_and_back, are_apart(count), 1)
    assert np.array_equal(pairs, similar_images(there_and_back, are_apart(count), 1))
    found = {tuple(pair) for pair in pairs.tolist()}
    assert all((i, count - 1 - i) in found for i in range(count // 2 - 2))


def test_images_without_features_are_less_similar_than_the_same_place(
    there_and_back: list[Features],
) -> None:
    plain = extract_features(np.full((64, 64, 3), 128, np.uint8), 100)
    count = len(there_and_back)
    pairs = similar_images([*there_and_back, plain, plain], are_apart(count + 2), 1)
    found = {tuple(pair) for pair in pairs.tolist()}
    assert all((i, count - 1 - i) in found for i in range(count // 2 - 2))
    assert len(similar_images([plain] * 4, are_apart(4), 1)) == 1


@given(
    st.lists(
        st.tuples(st.integers(0, 3), st.integers(0, 3), st.integers(0, 4), st.integers(0, 4)),
        max_size=30,
    )
)
def test_tracks_of_links_have_one_observation_per_frame(
    edges: list[tuple[int, int, int, int]],
) -> None:
    rng = np.random.default_rng(0)
    descriptors = np.zeros((5, 128), np.float32)
    features = {
        i: Features(rng.uniform(0, 100, (5, 2)).astype(np.float32), descriptors) for i in range(4)
    }
    by_pair: dict[tuple[int, int], set[tuple[int, int]]] = {}
    for i, j, a, b in edges:
        if i < j:
            by_pair.setdefault((i, j), set()).add((a, b))
    pairs = sorted(by_pair)
    matches = [np.array(sorted(by_pair[p]), np.uint32).reshape(-1, 2) for p in pairs]
    geometries = [TwoViewGeometry(TwoViewConfig.CALIBRATED, m) for m in matches]
    links = Links(np.array(pairs, np.int32).reshape(-1, 2), geometries)
    frames = np.array([0, 10, 20, 30], np.int32)
    tracks = links_as_tracks(links, features, frames, 40, (100, 100))
    for start, stop in zip(tracks.offsets[:-1], tracks.offsets[1:], strict=True):
        own = tracks.frame[start:stop]
        assert len(own) >= 2
        assert np.all(np.diff(own) > 0)
    assert len(tracks.xy) == tracks.offsets[-1]


def test_inliers_of_merged_links_are_among_the_matches() -> None:
    """A link replaces the match of a track that is an outlier."""
    xy = np.array([[10.0, 10.0], [50.0, 10.0]], np.float32)
    keypoints = [ImageKeypoints(xy, np.arange(2)) for frame in range(2)]
    pair, same = np.array([[0, 1]], np.int32), np.array([[0, 0], [1, 1]], np.uint32)
    tracks = TwoViewGeometry(TwoViewConfig.CALIBRATED, same[:1])
    matched = MatchedImages(keypoints, pair, [same], [tracks], False)
    features = {
        image: Features(np.array(at, np.float32), np.zeros((2, 128), np.float32))
        for image, at in enumerate(([[50.3, 10.0], [90.0, 10.0]], [[70.0, 10.0], [95.0, 10.0]]))
    }
    links = Links(pair, [TwoViewGeometry(TwoViewConfig.CALIBRATED, same)])
    merged = merge_links(matched, links, features, [])
    places = [
        [
            np.hstack([own.xy[row] for own, row in zip(merged.keypoints, match, strict=True)])
            for match in rows
        ]
        for rows in (merged.geometries[0].inlier_matches, merged.matches[0])
    ]
    assert np.allclose(places[0], [[10, 10, 10, 10], [50, 10, 70, 10], [90, 10, 95, 10]])
    assert np.allclose(places[1], places[0])


@pytest.fixture(scope="module")
def linked(jerk: Path, tmp_path_factory: pytest.TempPathFactory) -> MatchReport:
    return match(tmp_path_factory.mktemp("linked") / "a.db", jerk)


def test_gap_at_a_jerk_is_linked_and_reported(
    jerk: Path, linked: MatchReport, tmp_path: Path
) -> None:
    report = linked
    before = LEFT_OUT.start - 1
    assert report.links.frames_of_gaps() == [(before, before + 1)]
    assert report.links.frames_of_gaps("no overlap") == []
    assert report.links.num_links > 20
    (warning,) = report.warnings
    named = re.search("'frame_(.*).png' and 'frame_(.*).png'", warning)
    assert named is not None
    assert before - 2 < int(named[1]) <= before < int(named[2]) < before + 3
    findings = check_database(linked.database).findings
    assert ("warning", warning) in [(f.severity, f.text) for f in findings]
    unlinked = match(tmp_path / "b.db", jerk, options=MatchOptions(links=LinkOptions(links="none")))
    assert unlinked.links.num_images == 0
    assert report.num_pairs > unlinked.num_pairs


def test_same_input_gives_the_same_links(jerk: Path, linked: MatchReport, tmp_path: Path) -> None:
    match(tmp_path / "b.db", jerk)
    assert linked.database.read_bytes() == (tmp_path / "b.db").read_bytes()


def test_no_picture_is_decoded_if_motion_connects_all_images(
    steady: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> Iterator[None]:
        raise AssertionError("a picture is decoded")

    monkeypatch.setattr("colmap_av1.images.image_set.decodable_frames", refuse)
    report = match(tmp_path / "a.db", steady)
    assert report.links.num_images == 0


@pytest.mark.shared
def test_no_picture_of_a_drive_with_rigid_motion_is_compared(
    street: Street, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Half of the units are intra coded, but nearly all motion vectors fit a rigid scene."""
    drive = street(9)
    options = MatchOptions(camera=STREET, images=ImageOptions(every=1))
    assert match(tmp_path / "a.db", drive, options=options).links.num_images == 0
    monkeypatch.setattr("colmap_av1.matching.gaps._RIGID_SHARE", 1.1)
    assert match(tmp_path / "b.db", drive, options=options).links.num_images > 0
    assert (tmp_path / "a.db").read_bytes() == (tmp_path / "b.db").read_bytes()


def test_suspected_gap_that_pictures_refute_gets_no_links(
    steady: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def suspected(
        _: object, frames: NDArray[np.int32], *, certain: bool = False
    ) -> NDArray[np.bool_]:
        return (np.arange(len(frames) - 1) == 20) & (not certain)

    monkeypatch.setattr("colmap_av1.matching.gaps.low_inter_gaps", suspected)
    report = match(tmp_path / "a.db", steady)
    assert report.links.num_images == 4
    assert report.links.gaps == ()
    assert report.links.num_links == 0
    match(tmp_path / "b.db", steady, options=MatchOptions(links=LinkOptions(links="none")))
    assert (tmp_path / "a.db").read_bytes() == (tmp_path / "b.db").read_bytes()


def test_gap_that_pictures_contradict_is_linked(
    far_jerk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The share of inter units does not reveal this gap, because its bounds are lowered."""
    monkeypatch.setattr("colmap_av1.matching.gaps._LEAST_INTER_SHARE", 0.001)
    monkeypatch.setattr("colmap_av1.matching.gaps._CERTAINLY_LESS", 0.0)
    by_pairs = MatchOptions(verify=VerifyOptions(verify="pairs"))
    report = match(tmp_path / "a.db", far_jerk, options=by_pairs)
    before = FAR_OUT.start - 1
    assert report.links.frames_of_gaps() == [(before, before + 1)]
    assert report.links.num_images > 4
    assert report.links.num_links > 10


@pytest.mark.slow
def test_model_of_a_clip_with_a_jerk_has_correct_poses(jerk: Path, tmp_path: Path) -> None:
    made = reconstruct(jerk, tmp_path / "out", options=ReconstructOptions())
    assert made.long_range is not None
    assert made.long_range < 0.6
    _check_poses(made, LEFT_OUT, 0.005)


@pytest.mark.slow
def test_gap_that_only_the_model_reveals_is_linked(
    halved: NDArray[np.uint8], encode: Encode, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Few points join the images at the jerk, so the pictures there are matched as well."""
    monkeypatch.setattr("colmap_av1.matching.gaps._LEAST_INTER_SHARE", 0.001)
    monkeypatch.setattr("colmap_av1.matching.gaps._LEAST_OF_NEIGHBOURS", 0.0)
    monkeypatch.setattr("colmap_av1.matching.gaps._CERTAINLY_LESS", 0.0)
    video = encode(_without(halved, DOUBTFUL_OUT), tmp_path / "jerk.mp4")
    made = reconstruct(video, tmp_path / "out", options=ReconstructOptions())
    before = DOUBTFUL_OUT.start - 1
    assert [gap.frames for gap in made.links.gaps] == [(before, before + 1)]
    assert made.warnings == ()
    _check_poses(made, DOUBTFUL_OUT, 0.0005)
    again = reconstruct(video, tmp_path / "out", options=ReconstructOptions())
    assert set(again.resumed) >= {"tracks", "matches", "poses", "adjustment", "model"}
    assert again.links == made.links

    # Without links, corners that are matched across the gap hold the model together.
    without = ReconstructOptions(match=MatchOptions(links=LinkOptions(links="none")))
    held = reconstruct(video, tmp_path / "held", options=without)
    assert held.warnings == ()
    _check_poses(held, DOUBTFUL_OUT, 0.0005)


def _check_poses(made: ReconstructReport, left_out: range, bound: float) -> None:
    """Check that all images are registered, with position errors below a share of the path."""
    kept = [i for i in range(60) if i not in left_out]
    assert made.num_registered == len(kept)
    poses = model_poses(pycolmap.Reconstruction(str(made.output / "sparse" / "0")), len(kept))
    with np.load(TRUTH) as truth:
        known = truth["cam_from_world"][kept]
    centres, found = camera_centres(known), camera_centres(poses)
    extent = np.linalg.norm(np.ptp(centres, axis=0))
    assert alignment_error(found, centres) < bound * extent


def test_gap_without_overlap_is_reported_and_gets_no_matches(
    encode: Encode, tmp_path: Path
) -> None:
    """The video has a cut to another place."""
    first = np.array([image[:128, :192] for image in pictures()[:14]])
    video = encode(np.concatenate([first, make_frames(14)]), tmp_path / "cut.mp4")
    report = match(tmp_path / "a.db", video)
    assert report.links.frames_of_gaps("no overlap") == [(13, 14)]
    assert any("frames 13 and 14" in warning for warning in report.warnings)
    with closing(sqlite3.connect(tmp_path / "a.db")) as database:
        frame = {
            number: int(name[6:12])
            for number, name in database.execute("SELECT image_id, name FROM images")
        }
        rows = database.execute("SELECT pair_id FROM two_view_geometries WHERE rows > 0")
        pairs = [image_ids_from_pair_id(pair) for (pair,) in rows]
    assert pairs
    assert all((frame[a] <= 13) == (frame[b] <= 13) for a, b in pairs)


@pytest.mark.parametrize("links", ["auto", "sift"])
def test_frames_of_one_colour_are_refused(
    encode: Encode, tmp_path: Path, links: Literal["auto", "sift"]
) -> None:
    """There are no tracks and no SIFT features."""
    grey = np.full((12, 128, 192, 3), 90, np.uint8)
    with pytest.raises(VideoError, match="detail"):
        match(
            tmp_path / "a.db",
            encode(grey, tmp_path / "grey.mp4"),
            options=MatchOptions(links=LinkOptions(links=links), images=ImageOptions(every=1)),
        )

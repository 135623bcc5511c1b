from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import cv2
import numpy as np
import pycolmap
import pytest
from conftest import SHARED
from numpy.typing import NDArray
from synthetic_scene import CAMERA_PARAMS, HEIGHT, WIDTH, Scene, make_scene

from colmap_av1.geometry.cameras import make_camera
from colmap_av1.matching import verify
from colmap_av1.matching.pairs import ImageKeypoints, image_keypoints, pair_matches, schedule_pairs
from colmap_av1.matching.two_view_geometry import TwoViewConfig, TwoViewGeometry
from colmap_av1.matching.verify import verify_pairs
from colmap_av1.options import CameraOptions, VerifyOptions

SHELFBOX = SHARED / "sequences/shelfbox/frames"
UNKNOWN = make_camera(CameraOptions(), WIDTH, HEIGHT)
KNOWN = make_camera(CameraOptions(camera_params=CAMERA_PARAMS), WIDTH, HEIGHT)


def prepare(
    scene: Scene, outliers: float = 0.0
) -> tuple[list[ImageKeypoints], NDArray[np.int32], list[NDArray[np.uint32]]]:
    """Keypoints, pairs and matches, a share of which is replaced by random ones."""
    keypoints = image_keypoints(scene.tracks, range(scene.tracks.num_frames))
    pairs = schedule_pairs(keypoints)
    matches = [pair_matches(keypoints[i], keypoints[j]) for i, j in pairs]
    rng = np.random.default_rng(1)
    for m in matches:
        wrong = rng.choice(len(m), int(outliers * len(m)), replace=False)
        m[wrong, 1] = rng.permutation(m[wrong, 1])
    return keypoints, pairs, matches


def colmap_geometry(
    keypoints: Sequence[ImageKeypoints],
    pair: NDArray[np.int32],
    matches: NDArray[np.uint32],
    camera: pycolmap.Camera,
) -> pycolmap.TwoViewGeometry:
    options = pycolmap.TwoViewGeometryOptions()
    options.detect_watermark = False
    options.ransac.random_seed = 0
    first, second = (keypoints[k].xy.astype(float) for k in pair)
    return pycolmap.estimate_two_view_geometry(camera, first, camera, second, matches, options)


def as_bytes(geometry: TwoViewGeometry) -> tuple[object, ...]:
    arrays = (geometry.E, geometry.F, geometry.H, geometry.qvec, geometry.tvec)
    return (
        geometry.config,
        geometry.inlier_matches.tobytes(),
        *(None if a is None else a.tobytes() for a in arrays),
    )


def agreement_with_colmap(
    keypoints: Sequence[ImageKeypoints],
    pairs: NDArray[np.int32],
    matches: Sequence[NDArray[np.uint32]],
    camera: pycolmap.Camera,
    ours: Sequence[TwoViewGeometry],
) -> tuple[list[bool], list[float]]:
    """For each pair, whether COLMAP chooses the same configuration, and the IoU of the inliers."""
    same, overlap = [], []
    for pair, m, geometry in zip(pairs, matches, ours, strict=True):
        theirs = colmap_geometry(keypoints, pair, m, camera)
        same.append(int(theirs.config) == geometry.config)
        a = set(map(tuple, geometry.inlier_matches.tolist()))
        b = set(map(tuple, theirs.inlier_matches.tolist()))
        overlap.append(len(a & b) / len(a | b))
    return same, overlap


@pytest.mark.parametrize(
    ("camera", "scene", "config"),
    [
        (KNOWN, make_scene(), TwoViewConfig.CALIBRATED),
        (UNKNOWN, make_scene(), TwoViewConfig.UNCALIBRATED),
        (KNOWN, make_scene(flat=True), TwoViewConfig.PLANAR_OR_PANORAMIC),
        (UNKNOWN, make_scene(flat=True), TwoViewConfig.PLANAR_OR_PANORAMIC),
        (KNOWN, make_scene(turning=True), TwoViewConfig.PLANAR_OR_PANORAMIC),
    ],
    ids=["calibrated", "uncalibrated", "flat", "flat uncalibrated", "turning"],
)
def test_configurations_agree_with_colmap(
    camera: pycolmap.Camera, scene: Scene, config: TwoViewConfig
) -> None:
    keypoints, pairs, matches = prepare(scene, outliers=0.2)
    ours = verify_pairs(keypoints, pairs, matches, camera)
    same, overlap = agreement_with_colmap(keypoints, pairs, matches, camera, ours)
    assert np.mean(same) >= 0.95
    assert np.mean(overlap) >= 0.95
    assert np.mean([g.config == config for g in ours]) >= 0.9


def test_planar_pairs_of_two_cameras_keep_the_larger_inlier_set() -> None:
    keypoints, pairs, matches = prepare(make_scene(flat=True, noise=0.5), outliers=0.1)
    first, second = copy.copy(UNKNOWN), copy.copy(UNKNOWN)
    cameras = [(first, second)[i % 2] for i in range(len(keypoints))]
    for ours, shared in zip(
        verify_pairs(keypoints, pairs, matches, cameras),
        verify_pairs(keypoints, pairs, matches, UNKNOWN),
        strict=True,
    ):
        if ours.config == shared.config == TwoViewConfig.PLANAR_OR_PANORAMIC:
            assert len(ours.inlier_matches) >= len(shared.inlier_matches)
    i, j = pairs[0]
    first.camera_id, second.camera_id = 1, 2
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = 0
    xy = [keypoints[k].xy.astype(float) for k in (i, j)]
    theirs = pycolmap.estimate_two_view_geometry(first, xy[0], second, xy[1], matches[0], options)
    (ours,) = verify_pairs(keypoints, pairs[:1], matches[:1], cameras)
    assert int(theirs.config) == ours.config
    assert len(ours.inlier_matches) >= 0.98 * len(theirs.inlier_matches)


def test_relative_pose_matches_the_truth() -> None:
    scene = make_scene(noise=0.1)
    keypoints, pairs, matches = prepare(scene, outliers=0.1)
    for (i, j), g in zip(pairs, verify_pairs(keypoints, pairs, matches, KNOWN), strict=True):
        if j - i < 4 or len(g.inlier_matches) < 100:
            continue
        assert g.E is not None
        assert g.qvec is not None
        assert g.tvec is not None
        R = pycolmap.Rotation3d(g.qvec[[1, 2, 3, 0]]).matrix()
        truth = scene.rotation[j] @ scene.rotation[i].T
        t = scene.rotation[j] @ (scene.center[i] - scene.center[j])
        angle = np.degrees(np.arccos(np.clip((np.trace(R @ truth.T) - 1) / 2, -1, 1)))
        direction = np.degrees(np.arccos(np.clip(g.tvec @ t / np.linalg.norm(t), -1, 1)))
        assert angle < 0.5
        assert direction < 5
        assert np.linalg.norm(g.tvec) == pytest.approx(1)
        x, y, z = g.tvec
        E = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ R
        assert np.allclose(E / np.linalg.norm(E), g.E, atol=1e-6)


def test_fundamental_matrix_maps_to_epipolar_lines_of_the_second_image() -> None:
    keypoints, pairs, matches = prepare(make_scene(noise=0.1), outliers=0.1)
    geometries = verify_pairs(keypoints, pairs, matches, UNKNOWN)
    for (i, j), g in zip(pairs, geometries, strict=True):
        if len(g.inlier_matches) < 50:
            continue
        assert g.F is not None
        a = keypoints[i].xy[g.inlier_matches[:, 0]]
        b = keypoints[j].xy[g.inlier_matches[:, 1]]
        ones = np.ones((len(a), 1))
        lines = np.hstack([a, ones]) @ g.F.T
        distance = np.abs((np.hstack([b, ones]) * lines).sum(axis=1))
        assert np.median(distance / np.hypot(lines[:, 0], lines[:, 1])) < 0.5


def test_outliers_are_rejected() -> None:
    scene = make_scene(noise=0.2)
    keypoints, pairs, clean = prepare(scene)
    _, _, matches = prepare(scene, outliers=0.3)
    for (i, j), right, m, g in zip(
        pairs, clean, matches, verify_pairs(keypoints, pairs, matches, KNOWN), strict=True
    ):
        if g.config == TwoViewConfig.DEGENERATE or len(m) < 50:
            continue
        kept = set(map(tuple, g.inlier_matches.tolist()))
        true = set(map(tuple, right.tolist())) & set(map(tuple, m.tolist()))
        assert len(kept & true) >= 0.97 * len(true), (i, j)
        # A wrong match remains if it happens to lie on its epipolar line.
        assert len(kept - true) <= 0.25 * len(m), (i, j)


def test_pairs_with_just_enough_inliers_are_found() -> None:
    keypoints, pairs, matches = prepare(make_scene(noise=0.2))
    options, rng = VerifyOptions(min_num_inliers=20), np.random.default_rng(0)
    num_tried = num_found = 0
    for pair, m in zip(pairs, matches, strict=True):
        if len(m) < 50:
            continue
        some = m[rng.permutation(len(m))[:28]]
        some[22:, 1] = rng.permutation(m[:, 1])[:6]
        for seed in range(5):
            (found,) = verify_pairs(keypoints, pair[None], [some], KNOWN, options, seed=seed)
            num_tried, num_found = num_tried + 1, num_found + (len(found.inlier_matches) >= 20)
    assert num_tried > 100
    assert num_found >= 0.99 * num_tried


def test_result_depends_on_the_seed_but_not_on_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(verify, "_PAIRS_FOR_A_THREAD", 10)
    keypoints, pairs, matches = prepare(make_scene(num_points=2500), outliers=0.2)

    def run(**changes: int) -> list[tuple[object, ...]]:
        options = VerifyOptions(max_samples=100)
        found = verify_pairs(keypoints, pairs, matches, UNKNOWN, options, **changes)
        return [as_bytes(g) for g in found]

    assert run(num_threads=1) == run(num_threads=3)
    assert run(seed=0) != run(seed=1)


def test_order_of_the_pairs_does_not_matter() -> None:
    keypoints, pairs, matches = prepare(make_scene(num_points=200))
    forwards = verify_pairs(keypoints, pairs, matches, UNKNOWN)
    order = np.random.default_rng(0).permutation(len(pairs))
    mixed = verify_pairs(keypoints, pairs[order], [matches[k] for k in order], UNKNOWN)
    assert [as_bytes(mixed[k]) for k in np.argsort(order)] == [as_bytes(g) for g in forwards]


def test_samples_give_nearly_as_many_inliers_as_all_matches() -> None:
    keypoints, pairs, matches = prepare(make_scene(num_points=6000), outliers=0.2)
    for g, h in zip(
        verify_pairs(keypoints, pairs, matches, KNOWN, VerifyOptions(max_samples=150)),
        verify_pairs(keypoints, pairs, matches, KNOWN, VerifyOptions(max_samples=100000)),
        strict=True,
    ):
        assert len(g.inlier_matches) >= 0.95 * len(h.inlier_matches)


def test_distortion_is_corrected() -> None:
    scene = make_scene(noise=0.1)
    camera = make_camera(
        CameraOptions("SIMPLE_RADIAL", CAMERA_PARAMS.removesuffix("0") + "0.3"), WIDTH, HEIGHT
    )
    straight = KNOWN.cam_from_img(scene.tracks.xy.astype(float))
    rays = np.column_stack([straight, np.ones(len(straight))])
    bent = replace(scene, tracks=replace(scene.tracks, xy=np.float32(camera.img_from_cam(rays))))
    keypoints, pairs, matches = prepare(bent)
    geometries = verify_pairs(keypoints, pairs, matches, camera)
    assert sum(len(g.inlier_matches) for g in geometries) > 0.99 * sum(map(len, matches))
    assert np.mean([g.config == TwoViewConfig.CALIBRATED for g in geometries]) > 0.9


def test_random_or_few_matches_are_degenerate() -> None:
    rng = np.random.default_rng(0)
    n = 60
    track = np.arange(n)
    images = [
        ImageKeypoints(rng.uniform(0, [WIDTH, HEIGHT], (n, 2)).astype(np.float32), track)
        for i in range(2)
    ]
    matches = np.repeat(np.arange(n, dtype=np.uint32)[:, None], 2, axis=1)
    options = VerifyOptions(max_error=1.0, max_iterations=500)
    for camera in (KNOWN, UNKNOWN):
        chance, few = verify_pairs(
            images, np.array([[0, 1], [0, 1]]), [matches, matches[:10]], camera, options
        )
        for geometry in (chance, few):
            assert geometry.config == TwoViewConfig.DEGENERATE
            assert geometry.inlier_matches.shape == (0, 2)
            assert geometry.F is None


def test_still_camera_is_panoramic() -> None:
    xy = np.random.default_rng(0).uniform(0, [WIDTH, HEIGHT], (200, 2)).astype(np.float32)
    images = [ImageKeypoints(xy, np.arange(200)) for i in range(2)]
    matches = np.repeat(np.arange(200, dtype=np.uint32)[:, None], 2, axis=1)
    (geometry,) = verify_pairs(images, np.array([[0, 1]]), [matches], KNOWN)
    assert geometry.config == TwoViewConfig.PLANAR_OR_PANORAMIC
    assert len(geometry.inlier_matches) == 200


@pytest.mark.parametrize("camera", [KNOWN, UNKNOWN], ids=["calibrated", "uncalibrated"])
def test_points_on_a_line_are_planar(camera: pycolmap.Camera) -> None:
    line = np.linspace([10, 20], [300, 200], 200).astype(np.float32)
    images = [ImageKeypoints(line + 3 * i, np.arange(200)) for i in range(2)]
    matches = np.repeat(np.arange(200, dtype=np.uint32)[:, None], 2, axis=1)
    (geometry,) = verify_pairs(images, np.array([[0, 1]]), [matches], camera)
    assert geometry.config == TwoViewConfig.PLANAR_OR_PANORAMIC
    assert len(geometry.inlier_matches) == 200


@pytest.mark.shared
@pytest.mark.skipif(not SHELFBOX.is_dir(), reason="no ../shared/sequences next to the checkout")
def test_configurations_agree_with_colmap_on_real_images() -> None:
    frames = sorted(SHELFBOX.iterdir())[:20:2]
    images = [cv2.imread(str(frame), cv2.IMREAD_GRAYSCALE) for frame in frames]
    height, width = images[0].shape
    sift = cv2.SIFT_create(4000)
    features = [sift.detectAndCompute(image, None) for image in images]
    keypoints = [
        ImageKeypoints(np.array([p.pt for p in points], np.float32) + 0.5, np.arange(len(points)))
        for i, (points, _) in enumerate(features)
    ]
    pairs = np.array(list(combinations(range(len(images)), 2)), dtype=np.int32)
    matches = []
    for i, j in pairs:
        found = cv2.BFMatcher().knnMatch(features[i][1], features[j][1], k=2)
        good = {a.trainIdx: a.queryIdx for a, b in found if a.distance < 0.8 * b.distance}
        matches.append(np.array(sorted((q, t) for t, q in good.items()), dtype=np.uint32))
    camera = make_camera(CameraOptions(), width, height)
    ours = verify_pairs(keypoints, pairs, matches, camera)
    same, overlap = agreement_with_colmap(keypoints, pairs, matches, camera, ours)
    # Neighbouring images are near COLMAP's threshold of 0.8 between homography and fundamental
    # matrix: COLMAP with another seed agrees with itself on 95 % of such pairs.
    assert np.mean(same) >= 0.9
    assert np.median(overlap) >= 0.95


def test_progress_counts_up() -> None:
    keypoints, pairs, matches = prepare(make_scene(num_points=200))
    seen: list[int] = []
    verify_pairs(keypoints, pairs, matches, UNKNOWN, progress=seen.append)
    assert seen == list(range(1, len(pairs) + 1))

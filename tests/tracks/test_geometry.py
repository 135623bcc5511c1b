"""Tracks of the rendered clip compared with the ground truth, and metrics with known cases."""

import functools
import json

import numpy as np
import pycolmap
import pytest
import render_scene
from conftest import PROJECT
from scipy.spatial.transform import Rotation
from sequences import read_sequence
from track_metrics import epipolar_errors, exact_errors, pairs_at_span, track_statistics

from colmap_av1 import build_tracks, read_motion
from colmap_av1.errors import ImageError, VideoError
from colmap_av1.evaluate import pose_errors
from colmap_av1.options import DensityOptions, RefineOptions
from colmap_av1.tracks.refine import refine_tracks
from colmap_av1.tracks.selection import select_tracks
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.video.decoding import decode_frames

EXAMPLES = PROJECT / "examples"


@pytest.fixture(scope="module")
def scene():
    return render_scene.build_scene()


@pytest.fixture(scope="module")
def transfer(scene):
    return functools.partial(render_scene.transfer, scene)


@pytest.fixture(scope="module")
def camera(scene):
    params = [scene.fx, scene.fy, scene.cx, scene.cy]
    return pycolmap.Camera(model="PINHOLE", width=scene.width, height=scene.height, params=params)


@pytest.fixture(scope="module")
def tracks():
    return build_tracks(read_motion(EXAMPLES / "scene.mp4"))


def _tracks(size, offsets, frame, xy):
    """Tracks of a video of size (frames, width, height)."""
    num_frames, width, height = size
    return Tracks(
        num_frames=num_frames,
        width=width,
        height=height,
        offsets=np.asarray(offsets, np.int64),
        frame=np.asarray(frame, np.int32),
        xy=np.asarray(xy, np.float32),
        sigma=np.full(len(frame), 0.5, np.float32),
        confirmed=np.zeros(len(frame), bool),
    )


@pytest.fixture(scope="module")
def true_tracks(scene):
    """Exact tracks of surface points from frame 10 to 20."""
    rng = np.random.default_rng(1)
    points = render_scene.surface_points(scene, 15, rng.uniform(100, 260, (300, 2)))
    frames = np.arange(10, 21)
    seen = [render_scene.project(scene, f, points) for f in frames]
    visible = np.all([v for _, _, v in seen], axis=0)
    points, xy = points[visible], np.stack([xy[visible] for xy, _, _ in seen], 1)
    offsets = np.arange(len(points) + 1) * len(frames)
    size = (len(scene.cam_from_world), scene.width, scene.height)
    return _tracks(size, offsets, np.tile(frames, len(points)), xy.reshape(-1, 2))


@pytest.fixture(scope="module")
def refined(tracks):
    return refine_tracks(tracks, decode_frames(EXAMPLES / "scene.mp4"), RefineOptions(refine="lk"))


# Limits by span: median and 90th percentile in px, about 15 % above the measured values.
EXACT = {1: (0.091, 0.33), 4: (0.16, 0.85), 16: (0.33, 2.4)}
REFINED = {1: (0.097, 0.28), 4: (0.146, 0.56), 16: (0.3, 1.83)}
TRUSTED = {1: (0.089, 0.2), 4: (0.134, 0.39), 16: (0.28, 1.38)}


def _check(tracks, transfer, span, limits):
    errors = exact_errors(tracks, transfer, span, max_pairs=15_000)
    assert len(errors) > 3_000
    distance = np.linalg.norm(errors, axis=1)
    median, percentile = limits[span]
    assert np.median(distance) <= median
    assert np.quantile(distance, 0.9) <= percentile


@pytest.mark.parametrize("span", EXACT)
def test_tracks_follow_surface_points(tracks, transfer, span):
    _check(tracks, transfer, span, EXACT)


@pytest.mark.parametrize("span", REFINED)
def test_refined_tracks_are_more_accurate(refined, transfer, span):
    _check(refined, transfer, span, REFINED)


@pytest.mark.parametrize("span", TRUSTED)
def test_selected_tracks_are_most_accurate(refined, transfer, span):
    chosen = select_tracks(refined, DensityOptions(preset="sparse"))
    _check(chosen, transfer, span, TRUSTED)


@pytest.mark.parametrize("kind", ["tracks", "refined"])
def test_tracks_are_not_biased(kind, transfer, request):
    # Mixing two pixel conventions would cause a bias of half a pixel.
    errors = exact_errors(request.getfixturevalue(kind), transfer, 1, max_pairs=15_000)
    assert np.abs(errors.mean(0)).max() <= 0.05
    assert np.abs(np.median(errors, axis=0)).max() <= 0.01


@pytest.mark.parametrize("axis", [0, 1])
def test_epipolar_error_detects_a_shift_of_two_pixels(tracks, scene, camera, axis):
    def median(shift):
        moved = tracks.xy + np.float32(shift) * np.eye(2, dtype=np.float32)[axis]
        moved = Tracks(**{**vars(tracks), "xy": moved})
        return np.median(epipolar_errors(moved, scene.cam_from_world, camera, 16))

    assert median(0) < 0.95 * min(median(-2), median(2))


def test_true_tracks_have_no_error(true_tracks, scene, camera, transfer):
    for span in (1, 4, 10):
        errors = exact_errors(true_tracks, transfer, span)
        # Positions have single precision: next to an edge the truth may be on another surface.
        assert np.quantile(np.abs(errors), 0.98) < 1e-3
        assert epipolar_errors(true_tracks, scene.cam_from_world, camera, span).max() < 1e-3
    assert len(exact_errors(true_tracks, transfer, 11)) == 0
    assert len(epipolar_errors(true_tracks, scene.cam_from_world, camera, 11)) == 0


def test_known_drift_is_measured(true_tracks, scene, camera, transfer):
    # Each observation drifts by 0.3 px to the right and 0.1 px up.
    drift = (true_tracks.frame - 10)[:, None] * np.float32([0.3, -0.1])
    moved = Tracks(**{**vars(true_tracks), "xy": true_tracks.xy + drift})
    errors = exact_errors(moved, transfer, 1)
    np.testing.assert_allclose(np.median(errors, axis=0), [0.3, -0.1], atol=0.02)
    # The camera moves sideways, so epipolar lines are nearly horizontal. The distance is shared
    # between the two views.
    distance = np.median(epipolar_errors(moved, scene.cam_from_world, camera, 1))
    assert 0.1 / np.sqrt(2) * 0.8 < distance < np.hypot(0.3, 0.1) / np.sqrt(2)


def test_epipolar_error_needs_poses(true_tracks, scene, camera):
    poses = scene.cam_from_world.copy()
    poses[15:] = np.nan
    some = epipolar_errors(true_tracks, poses, camera, 2)
    assert len(some) == 3 * true_tracks.num_tracks  # starting in frames 10, 11 and 12
    poses[:] = poses[0]
    assert len(epipolar_errors(true_tracks, poses, camera, 2)) == 0


def test_pairs_at_span_are_complete():
    frame = np.array([0, 1, 3, 1, 3, 5, 0, 4, 5], dtype=np.int32)
    offsets = np.array([0, 3, 6, 9])
    xy = np.zeros((9, 2), np.float32)
    tracks = _tracks((6, 64, 64), offsets, frame, xy)
    of = {0: 0, 1: 0, 2: 0, 3: 1, 4: 1, 5: 1, 6: 2, 7: 2, 8: 2}
    for span in range(1, 8):
        wanted = [
            (i, j)
            for i in range(9)
            for j in range(9)
            if of[i] == of[j] and frame[j] - frame[i] == span
        ]
        assert sorted(map(tuple, pairs_at_span(tracks, span))) == wanted
    some = pairs_at_span(tracks, 2, max_pairs=1)
    assert len(some) == 1
    np.testing.assert_array_equal(some, pairs_at_span(tracks, 2, max_pairs=1))


def test_track_statistics_count_observations_in_images():
    # Three frames of 2x1 cells; the second cell is cut at 20 px.
    frame = np.array([0, 1, 2, 0, 2, 1], dtype=np.int32)
    xy = np.float32([[1, 1], [2, 2], [17, 3], [18, 9], [19, 9], [20, 10]])
    tracks = _tracks((3, 20, 16), [0, 3, 5, 6], frame, xy)
    all_frames = track_statistics(tracks)
    assert (all_frames.num_images, all_frames.num_tracks, all_frames.mean_length) == (3, 2, 2.5)
    assert all_frames.tracks_by_length == {2: 2, 4: 0, 8: 0, 16: 0, 32: 0}
    assert all_frames.observations_per_image == (pytest.approx(5 / 3), 1)
    assert all_frames.coverage == (pytest.approx((2 + 1 + 1) / 6), 0.5)
    # Only one track is observed in both frames 0 and 1.
    two = track_statistics(tracks, np.array([0, 1]))
    assert (two.num_images, two.num_tracks, two.coverage) == (2, 1, (0.5, 0.5))


def test_pose_errors_are_invariant_to_a_similarity(scene):
    truth = scene.cam_from_world
    similarity = pycolmap.Sim3d(
        2.5, pycolmap.Rotation3d(np.array([0.1, 0.5, -0.2, 0.8])), [1, 2, 3]
    )
    poses = np.stack(
        [similarity.transform_camera_world(pycolmap.Rigid3d(p)).matrix() for p in truth]
    )
    exact = pose_errors(poses, truth)
    assert exact.num_poses == 60
    assert exact.ate < 1e-9
    assert exact.max_rotation < 1e-5
    assert exact.relative_translation < 1e-9
    assert exact.relative_rotation < 1e-5

    # One camera is shifted by 0.3 m, one is rotated by 2 degrees, one is missing.
    off = truth.copy()
    off[7, :, 3] += [0, 0.3, 0]
    off[9] = Rotation.from_rotvec([0, np.radians(2), 0]).as_matrix() @ off[9]
    off[20] = np.nan
    errors = pose_errors(off, truth)
    assert errors.num_poses == 59
    assert errors.max_centre == pytest.approx(0.3, rel=0.1)
    assert errors.ate == pytest.approx(0.3 / np.sqrt(59), rel=0.1)
    assert errors.max_rotation == pytest.approx(2, rel=0.05)
    assert errors.rotation < 0.05
    # The two motions at the rotated camera are wrong, of 58 between consecutive poses.
    assert errors.relative_rotation == pytest.approx(2 * np.sqrt(2 / 58), rel=0.01)
    assert errors.relative_translation == pytest.approx(0.3 * np.sqrt(2 / 58), rel=0.3)
    centres = -np.einsum("nij,ni->nj", truth[:, :, :3], truth[:, :, 3])
    assert errors.extent == pytest.approx(np.linalg.norm(np.ptp(centres, axis=0)), rel=0.01)

    # The robust alignment ignores an outlier, but the error includes its distance.
    off[3, :, 3] += [0, 0, 100]
    far = pose_errors(off, truth)
    assert far.robust_median < 0.01
    distances = [100, 0.3]
    assert far.robust_rms == pytest.approx(np.hypot(*distances) / np.sqrt(59), rel=0.01)
    assert far.ate < far.robust_rms

    assert pose_errors(np.full_like(truth, np.nan), truth) is None
    with pytest.raises(ValueError, match="59"):
        pose_errors(truth[:59], truth)


def _write_sequence(folder, truth, **about):
    (folder / "frames").mkdir()
    about = {"name": "own", "frames": 3, "width": 64, "height": 48, "fps": 10, **about}
    (folder / "sequence.json").write_text(json.dumps(about))
    (folder / "groundtruth.txt").write_text(truth)


def test_sequence_poses_are_cam_from_world(tmp_path):
    half = np.sqrt(0.5)
    truth = f"# name tx ty tz qx qy qz qw\n000001.png 1 2 3 0 0 {half} {half}\n"
    params = [50, 51, 32, 24]
    _write_sequence(tmp_path, truth, intrinsics={"model": "PINHOLE", "params": params})
    sequence = read_sequence(tmp_path)
    assert (sequence.name, sequence.num_frames, sequence.source) == ("own", 3, tmp_path / "frames")
    assert list(sequence.camera.params) == params
    assert np.isnan(sequence.cam_from_world[[0, 2]]).all()
    # The camera's x axis is the world's y axis, and its centre is (1, 2, 3).
    pose = sequence.cam_from_world[1]
    np.testing.assert_allclose(pose @ [1, 2, 3, 1], 0, atol=1e-9)
    np.testing.assert_allclose(pose @ [1, 3, 3, 1], [1, 0, 0], atol=1e-9)


def test_invalid_sequences_are_refused(tmp_path):
    with pytest.raises(VideoError, match=r"sequence\.json"):
        read_sequence(tmp_path)
    _write_sequence(tmp_path, "000003.png 0 0 0 0 0 0 1\n")
    with pytest.raises(ImageError, match=r"000003\.png"):
        read_sequence(tmp_path)
    (tmp_path / "frames").rmdir()
    with pytest.raises(VideoError, match="exist"):
        read_sequence(tmp_path)


@pytest.mark.shared
def test_street_sequence_moves_forward(shared):
    street = read_sequence(shared / "sequences" / "street")
    moved = street.cam_from_world[0, :, :3] @ (
        -street.cam_from_world[5, :, :3].T @ street.cam_from_world[5, :, 3]
    )
    assert street.camera.model.name == "PINHOLE"
    assert moved[2] > 20 * np.abs(moved[:2]).max() / 2

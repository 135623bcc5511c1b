from __future__ import annotations

import numpy as np
import pycolmap
import pytest

from colmap_av1.geometry.colmap_model import camera_centres
from colmap_av1.geometry.resection import Sightings, interpolate_poses, resect, sightings_of
from colmap_av1.geometry.track_points import TriangulatedTracks
from colmap_av1.geometry.triangulation import TriangulatedPoints
from colmap_av1.tracks.tracks import Tracks

_FOCAL = 500.0


def pose(turn: tuple[float, float, float], centre: tuple[float, float, float]) -> np.ndarray:
    rotation = pycolmap.Rotation3d(np.array(turn)).matrix()
    return np.column_stack([rotation, -rotation @ np.array(centre)])


def sightings(poses: list[np.ndarray], counts: list[int], noise: float) -> Sightings:
    """Points in front of the cameras, with noise in pixels and a fifth of outliers."""
    rng = np.random.default_rng(3)
    xyz = [np.column_stack([rng.uniform(-2, 2, (n, 2)), rng.uniform(4, 8, n)]) for n in counts]
    rays = []
    for p, own in zip(poses, xyz, strict=True):
        seen = own @ p[:, :3].T + p[:, 3]
        ray = seen[:, :2] / seen[:, 2:] + rng.normal(0, noise / _FOCAL, (len(own), 2))
        ray[::5] += rng.uniform(0.05, 0.3, ray[::5].shape)
        rays.append(ray)
    bounds = np.concatenate([[0], np.cumsum(counts)])
    return Sightings(np.concatenate(rays), np.concatenate(xyz), bounds)


def test_poses_are_found_from_good_and_bad_initial_poses() -> None:
    poses = [pose((0.02 * i, -0.05 * i, 0.01), (0.1 * i, 0.02 * i, 0.0)) for i in range(8)]
    seen = sightings(poses, [400] * 8, noise=0.3)
    near = np.array([pose((0.0, 0.0, 0.0), (0.1 * i, 0.0, 0.0)) for i in range(8)])
    far = np.array([pose((1.0, 2.0, 0.5), (30.0, -9.0, 2.0))] * 8)
    for guesses in (near, far):
        found = resect(seen, guesses, np.full(len(guesses), _FOCAL), num_threads=1)
        for one, true in zip(found, poses, strict=True):
            assert one is not None
            assert np.degrees(np.arccos((np.trace(one[:, :3] @ true[:, :3].T) - 1) / 2)) < 0.05
            assert np.ptp(camera_centres(np.array([one, true])), axis=0).max() < 0.01


def test_result_does_not_depend_on_threads() -> None:
    poses = [pose((0.0, 0.01 * i, 0.0), (0.1 * i, 0.0, 0.0)) for i in range(12)]
    seen = sightings(poses, [100] * 12, noise=0.5)
    guesses = np.array(poses[:1] * 12)
    one, four = (
        resect(seen, guesses, np.full(len(guesses), _FOCAL), num_threads=n) for n in (1, 4)
    )
    np.testing.assert_array_equal(np.array(one), np.array(four))


def test_too_few_points_give_no_pose() -> None:
    poses = [pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))] * 3
    found = resect(sightings(poses, [0, 29, 200], noise=0.3), np.array(poses), np.full(3, _FOCAL))
    assert [one is not None for one in found] == [False, False, True]


def test_poses_are_interpolated() -> None:
    known = np.array([pose((0, 0, 0), (0, 0, 0)), pose((0, 0.4, 0), (2, 0, 4))])
    frames = np.array([10, 20], np.int32)
    between = interpolate_poses(known, frames, np.array([5, 10, 15, 20, 30], np.int32))
    np.testing.assert_allclose(between[:2], [known[0]] * 2, atol=1e-12)
    np.testing.assert_allclose(between[3:], [known[1]] * 2, atol=1e-12)
    np.testing.assert_allclose(between[2], pose((0, 0.2, 0), (1, 0, 2)), atol=1e-12)
    np.testing.assert_allclose(
        interpolate_poses(known[:1], frames[:1], frames), known[[0, 0]], atol=1e-12
    )


@pytest.mark.parametrize("wanted", [(1, 3), (3,), ()])
def test_sightings_come_from_tracks_with_points(wanted: tuple[int, ...]) -> None:
    # Track 0 is in all five frames, track 1 only in those without a pose, track 2 in frames 1 to 4.
    frame = np.array([0, 1, 2, 3, 4, 1, 3, 1, 2, 3, 4], np.int32)
    xy = np.column_stack([10.0 + np.arange(11), 20.0 + np.arange(11)]).astype(np.float32)
    offsets, zero = np.array([0, 5, 7, 11]), np.zeros(11, np.float32)
    tracks = Tracks(5, 100, 80, offsets, frame, xy, zero, zero > 0)
    seen = tracks.keep_frames(np.array([0, 2, 4], np.int32))
    points = TriangulatedPoints(
        np.array([[1.0, 2, 3], [4, 5, 6]]), np.zeros(2), np.array([0, 3, 5]), np.arange(5), 2, 2
    )
    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=100, height=80, params=[50.0, 0, 0])
    known = TriangulatedTracks(seen, seen.frame // 2, np.zeros(seen.xy.shape), points)
    found = sightings_of(known, tracks, np.array(wanted, np.int32), [camera] * len(wanted))
    rows = {1: [1, 7], 3: [3, 9]}
    np.testing.assert_array_equal(found.bounds, 2 * np.arange(len(wanted) + 1))
    expected = [row for f in wanted for row in rows[f]]
    np.testing.assert_allclose(found.rays * 50, xy[expected], rtol=1e-6)
    np.testing.assert_array_equal(found.xyz, points.xyz[[0, 1] * len(wanted)])

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from colmap_av1 import _core
from colmap_av1.geometry.triangulation import Observations, TriangulatedPoints, Views, triangulate
from colmap_av1.options import TriangulateOptions

FOCAL = 500.0


def views(count: int) -> Views:
    """Cameras that look along z, in a row 0.2 apart."""
    poses = np.tile(np.eye(4)[:3], (count, 1, 1))
    poses[:, 0, 3] = -0.2 * np.arange(count)
    return Views(poses, np.full((count, 2), FOCAL))


def rays_of(xyz: np.ndarray, seen_by: Views) -> np.ndarray:
    """Exact rays, float64 [num_points, num_views, 2]."""
    pose = seen_by.cam_from_world
    in_camera = np.einsum("vij,pj->pvi", pose[:, :, :3], xyz) + pose[None, :, :, 3]
    return in_camera[..., :2] / in_camera[..., 2:]


def observations(rays: np.ndarray) -> Observations:
    """Tracks that are observed in every view."""
    num_tracks, num_views = rays.shape[:2]
    return Observations(
        np.arange(num_tracks + 1) * num_views,
        np.tile(np.arange(num_views), num_tracks),
        rays.reshape(-1, 2),
        np.full(num_tracks * num_views, 0.3, np.float32),
    )


@pytest.fixture
def scene() -> tuple[np.ndarray, Views]:
    rng = np.random.default_rng(3)
    return rng.uniform([-2, -2, 4], [3, 2, 9], (400, 3)), views(9)


def owners(points: TriangulatedPoints, num_views: int) -> np.ndarray:
    """The track that each point comes from."""
    return points.observation[points.offsets[:-1]] // num_views


def test_exact_rays_give_exact_points(scene: tuple[np.ndarray, Views]) -> None:
    xyz, seen_by = scene
    points = triangulate(observations(rays_of(xyz, seen_by)), seen_by)
    assert np.abs(points.xyz - xyz).max() < 1e-6
    assert points.error.max() < 1e-6
    assert np.array_equal(points.observation, np.arange(400 * 9))
    assert points.num_agreeing == points.num_tracks == 400


def test_noisy_rays_give_the_expected_accuracy(scene: tuple[np.ndarray, Views]) -> None:
    """The depth error corresponds to a baseline of 1.6 and the noise."""
    xyz, seen_by = scene
    rays = rays_of(xyz, seen_by)
    rays += np.random.default_rng(0).normal(0, 0.3 / FOCAL, rays.shape)
    points = triangulate(observations(rays), seen_by)
    off = points.xyz - xyz[owners(points, 9)]
    assert np.median(np.abs(off[:, 2]) / xyz[owners(points, 9), 2] ** 2) < 0.0006
    # The mean length of 2D noise, reduced by the degrees of freedom of the point.
    assert 0.3 < points.error.mean() < 0.38


def test_outliers_are_dropped(scene: tuple[np.ndarray, Views]) -> None:
    xyz, seen_by = scene
    rays = rays_of(xyz, seen_by)
    rays[:, 0] += 20 / FOCAL
    rays[:, 8, 1] += 15 / FOCAL
    points = triangulate(observations(rays), seen_by)
    assert len(points.xyz) == 400
    assert np.abs(points.xyz - xyz).max() < 1e-6
    assert set(np.diff(points.offsets)) == {7}
    assert not np.isin(points.observation % 9, [0, 8]).any()


def test_track_that_slides_gives_two_points(scene: tuple[np.ndarray, Views]) -> None:
    xyz, seen_by = scene
    rays = rays_of(xyz, seen_by)
    other = rays_of(xyz + np.array([0, 1.0, 0]), seen_by)
    rays[0, 5:] = other[0, 5:]
    points = triangulate(observations(rays), seen_by)
    assert len(points.xyz) == 401
    assert owners(points, 9)[:2].tolist() == [0, 0]
    assert np.diff(points.offsets)[:2].tolist() == [5, 4]
    assert np.allclose(points.xyz[:2], [xyz[0], xyz[0] + np.array([0, 1.0, 0])], atol=1e-6)


def test_tracks_without_a_valid_point(scene: tuple[np.ndarray, Views]) -> None:
    _, seen_by = scene
    far = np.array([[0.0, 0.0, 4000.0]])
    behind = np.array([[0.5, 0.0, -6.0]])
    points = triangulate(observations(rays_of(far, seen_by)), seen_by)
    assert len(points.xyz) == 0
    assert points.num_agreeing == 1
    points = triangulate(observations(rays_of(behind, seen_by)), seen_by)
    assert (len(points.xyz), points.num_agreeing, points.num_tracks) == (0, 0, 1)
    wild = np.random.default_rng(1).uniform(-0.5, 0.5, (50, 9, 2))
    assert len(triangulate(observations(wild), seen_by).xyz) < 5
    short = Observations(np.array([0, 2]), np.arange(2), np.zeros((2, 2)), np.zeros(2, np.float32))
    assert triangulate(short, seen_by).num_tracks == 0
    nothing = Observations(
        np.zeros(1, np.int64), np.empty(0, int), np.empty((0, 2)), np.empty(0, np.float32)
    )
    assert len(triangulate(nothing, seen_by).xyz) == 0


def test_points_with_uncertain_depth_are_dropped(scene: tuple[np.ndarray, Views]) -> None:
    """The depth error is estimated from the triangulation angle and the ray errors."""
    _, seen_by = scene
    rng = np.random.default_rng(7)
    xyz = np.column_stack(
        [rng.uniform(-2, 3, (4000, 2)), 1.6 / np.radians(rng.uniform(2, 8, 4000))]
    )
    noise = rng.uniform(0, 2, 4000)
    rays = rays_of(xyz, seen_by)
    # The same error in some of the views, as with tracks that drift.
    rays[:, 5:, 0] += (noise * rng.choice([-1, 1], 4000))[:, None] / FOCAL
    every = TriangulateOptions(points="survey", max_depth_error=None)
    all_points = triangulate(observations(rays), seen_by, every)
    options = TriangulateOptions(points="survey", max_depth_error=0.015)
    sure = triangulate(observations(rays), seen_by, options)

    def off(points: TriangulatedPoints) -> np.ndarray:
        return np.abs(points.xyz[:, 2] / xyz[owners(points, 9), 2] - 1)

    dropped = ~np.isin(owners(all_points, 9), owners(sure, 9))
    assert 0.2 < dropped.mean() < 0.8
    assert np.quantile(off(sure), 0.99) < 3 * 0.015
    assert np.median(off(all_points)[dropped]) > 2 * np.median(off(sure))
    assert (sure.num_agreeing, sure.num_tracks) == (all_points.num_agreeing, 4000)


def test_unusable_observations_are_ignored(scene: tuple[np.ndarray, Views]) -> None:
    xyz, seen_by = scene
    rays = rays_of(xyz, seen_by)
    rays[:, 4] = np.nan
    points = triangulate(observations(rays), seen_by)
    assert np.abs(points.xyz - xyz).max() < 1e-6
    assert not np.any(points.observation % 9 == 4)


def test_result_does_not_depend_on_threads() -> None:
    rng = np.random.default_rng(3)
    seen_by = views(12)
    rays = rays_of(rng.uniform([-2, -2, 4], [3, 2, 9], (40_000, 3)), seen_by)
    rays += rng.normal(0, 1 / FOCAL, rays.shape)
    done: list[int] = []
    one = triangulate(observations(rays), seen_by, num_threads=1, progress=done.append)
    two = triangulate(observations(rays), seen_by, num_threads=2)
    for name in ("xyz", "error", "offsets", "observation"):
        assert np.array_equal(getattr(one, name), getattr(two, name))
    assert len(done) > 1
    assert done[-1] == 40_000


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"view": np.array([0, 7])}, "of no view"),
        ({"view": np.array([0, 1, 1])}, "view, rays and sigma"),
        ({"offsets": np.array([0, 3])}, "offsets and view"),
        ({"offsets": np.array([2, 0])}, "offsets and view"),
        ({"focal": np.ones((3, 2))}, "poses and focal lengths"),
        ({"last": 2}, "no such tracks"),
    ],
)
def test_mismatched_arrays_are_refused(changed: dict[str, Any], message: str) -> None:
    fitting: dict[str, Any] = {
        "cam_from_world": np.tile(np.eye(3, 4), (2, 1, 1)),
        "focal": np.ones((2, 2)),
        "offsets": np.array([0, 2]),
        "view": np.array([0, 1]),
        "rays": np.zeros((2, 2)),
        "sigma": np.ones(2, np.float32),
        **{"first": 0, "last": 1, "min_observations": 2, "max_reprojection_error": 1.0},
        **{"min_angle": 0.0, "max_depth_error": None, "sigma_floor": 0.3, "error_to_sigma": 2.0},
    }
    assert len(_core.triangulate(**fitting)) == 6
    with pytest.raises(ValueError, match=message):
        _core.triangulate(**(fitting | changed))

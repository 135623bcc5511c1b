"""Point clouds for training Gaussian splats: bounded depths, even spacing, no holes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from colmap_av1 import _core
from colmap_av1.errors import OptionError
from colmap_av1.geometry.colmap_model import camera_centres
from colmap_av1.geometry.coverage import coverage
from colmap_av1.geometry.distant_points import splat_points
from colmap_av1.geometry.model_points import ModelPoints
from colmap_av1.geometry.posed_camera import PosedCamera
from colmap_av1.geometry.triangulation import Observations, TriangulatedPoints, Views, triangulate
from colmap_av1.options import TriangulateOptions
from colmap_av1.splats.cloud import splat_cloud

WIDTH, HEIGHT, FOCAL = 320, 240, 300.0
CAMERA = pycolmap.Camera(
    camera_id=1, model="PINHOLE", width=WIDTH, height=HEIGHT, params=[FOCAL, FOCAL, 160, 120]
)
SPLATS = TriangulateOptions()
NUM_VIEWS = 8


def moving(step: float, count: int = NUM_VIEWS) -> np.ndarray:
    """Poses of a camera that looks along z and moves to the right."""
    return np.stack([np.column_stack([np.eye(3), [-step * i, 0.0, 0.0]]) for i in range(count)])


def turning(degrees: float, count: int = NUM_VIEWS) -> np.ndarray:
    """Poses of a camera that turns on the spot."""
    angle = np.radians(degrees) * np.arange(count)
    rotation = np.zeros((count, 3, 3))
    rotation[:, 0, 0] = rotation[:, 2, 2] = np.cos(angle)
    rotation[:, 0, 2], rotation[:, 2, 0] = -np.sin(angle), np.sin(angle)
    rotation[:, 1, 1] = 1.0
    return np.concatenate([rotation, np.zeros((count, 3, 1))], axis=2)


def scattered(count: int, depth: float | tuple[float, float], seed: int = 0) -> np.ndarray:
    """Random points in the field of view of the first view."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-0.9, 0.9, (count, 2)) * (WIDTH / 2 / FOCAL, HEIGHT / 2 / FOCAL)
    low, high = depth if isinstance(depth, tuple) else (depth, depth)
    return np.column_stack([xy, np.ones(count)]) * rng.uniform(low, high, (count, 1))


def see(xyz: np.ndarray, poses: np.ndarray, noise: float, seed: int = 0) -> Observations:
    """Observations of every point in every view, with noise in pixels."""
    own = np.einsum("vij,nj->nvi", poses[:, :, :3], xyz) + poses[:, :, 3]
    rays = own[:, :, :2] / own[:, :, 2:]
    rays = rays + np.random.default_rng(seed).normal(0, noise / FOCAL, rays.shape)
    offsets = np.arange(len(xyz) + 1) * len(poses)
    view = np.tile(np.arange(len(poses)), len(xyz))
    sigma = np.full(len(view), noise, np.float32)
    return Observations(offsets, view, rays.reshape(-1, 2), sigma)


def views_of(poses: np.ndarray) -> Views:
    return Views(poses, np.full((len(poses), 2), FOCAL))


def tracks_of(points: TriangulatedPoints) -> np.ndarray:
    return points.observation[points.offsets[:-1]] // NUM_VIEWS


def test_near_points_match_survey_points() -> None:
    poses = moving(0.2)
    seen = see(scattered(300, (3, 6)), poses, 0.1)
    points = splat_points(seen, views_of(poses), SPLATS)
    survey = triangulate(seen, views_of(poses), replace(SPLATS, points="survey"))
    assert len(points.xyz) == len(survey.xyz) == 300
    off = np.linalg.norm(points.xyz - survey.xyz, axis=1) / survey.xyz[:, 2]
    assert off.max() < 0.02
    assert np.array_equal(points.offsets, survey.offsets)


def test_far_points_are_kept_at_a_bounded_distance() -> None:
    """Survey points leave them out, because their distance is not observable."""
    poses = moving(0.02)
    near, far = scattered(300, (2, 6)), scattered(200, (500, 5000), seed=1)
    seen = see(np.concatenate([near, far]), poses, 0.3)
    survey = triangulate(seen, views_of(poses), replace(SPLATS, points="survey", min_angle=0.5))
    assert (tracks_of(survey) < 300).all()
    points = splat_points(seen, views_of(poses), SPLATS)
    track = tracks_of(points)
    assert (track >= 300).sum() > 190  # including points whose rays are parallel
    distant = points.xyz[track >= 300]
    assert distant[:, 2].min() > 1.0
    assert np.isfinite(distant).all()
    # They lie beyond the far field only as far as the reprojection error requires.
    assert np.quantile(distant[:, 2], 0.9) < 100
    assert points.error.max() < 2.0
    assert (np.diff(points.offsets) >= SPLATS.min_observations).all()
    assert (np.diff(track) >= 0).all()


def test_points_of_a_rotating_camera_lie_on_a_sphere() -> None:
    poses = turning(1.0)
    sky = scattered(200, 50.0)
    points = splat_points(see(sky, poses, 0.2), views_of(poses), SPLATS)
    assert points.num_agreeing >= 195
    distance = np.linalg.norm(points.xyz, axis=1)
    assert np.allclose(distance, distance[0])
    direction = points.xyz / distance[:, None]
    true = sky[tracks_of(points)] / 50.0
    true /= np.linalg.norm(true, axis=1, keepdims=True)
    assert np.abs(direction - true).max() < 0.01


def test_no_tracks_give_no_points() -> None:
    none = Observations(np.zeros(1, np.int64), np.empty(0, np.int64), *(np.empty((0, 2)),) * 2)
    assert len(splat_points(none, views_of(moving(0.2)), SPLATS).xyz) == 0


def test_floating_points_are_dropped() -> None:
    """Lone points near the camera are dropped; a pole of many points and the wall are kept."""
    poses = moving(0.05)
    wall = scattered(2000, 8.0)
    pole = np.column_stack([np.full(60, 0.3), np.linspace(-0.6, 0.6, 60), np.full(60, 3.0)])
    alone = np.array([[-0.2, 0.1, 2.0], [-0.1, -0.3, 1.5]])
    truth = np.concatenate([wall, pole, alone])
    points = splat_points(see(truth, poses, 0.05), views_of(poses), SPLATS)
    track = tracks_of(points)
    assert not np.isin([2060, 2061], track).any()
    assert np.isin(np.arange(2000, 2060), track).all()
    assert (track < 2000).sum() > 1990


def cloud(xyz: np.ndarray, views: list[PosedCamera]) -> ModelPoints:
    """A cloud whose points are observed by all views they project into, and by at least one."""
    seen = [(i, *view.project(xyz)[:2]) for i, view in enumerate(views)]
    point = np.concatenate([index for _, index, _ in seen])
    order = np.argsort(point, kind="stable")
    image = np.concatenate([np.full(len(index), i) for i, index, _ in seen])[order]
    xy = np.concatenate([at for *_, at in seen])[order]
    counts = np.bincount(point, minlength=len(xyz))
    offsets = np.concatenate([[0], np.cumsum(counts)])
    rgb = np.full((len(xyz), 3), 7, np.uint8)
    made = ModelPoints(xyz, rgb, np.full(len(xyz), 0.5), offsets, image, xy)
    return made.take(np.flatnonzero(counts))


def posed(poses: np.ndarray) -> list[PosedCamera]:
    return [PosedCamera(CAMERA, pose) for pose in poses]


def test_dense_areas_are_thinned_and_holes_are_filled() -> None:
    """The crowded half is thinned to the resolution of the images; the empty half gets points."""
    views = posed(moving(0.1))
    wall = scattered(20_000, 5.0)
    wall = np.concatenate([wall[wall[:, 0] < 0], [[2.0, 1.5, 5.0]]])
    given = cloud(wall, views)
    assert coverage(views, given.xyz) < 0.6
    made = splat_cloud(given, views, None)
    is_new = made.error < 0
    assert coverage(views, made.xyz) > 0.99
    assert 300 < (~is_new).sum() < 3000 < len(given.xyz)
    # New points have the depth of the wall and are observed by images.
    assert np.allclose(made.xyz[is_new, 2], 5.0)
    assert (np.diff(made.offsets) >= 1).all()
    for i, view in enumerate(views):
        own = np.repeat(np.arange(len(made.xyz)), np.diff(made.offsets))[made.image == i]
        index, xy, _ = view.project(made.xyz[own])
        assert len(index) == len(own)
        assert np.allclose(xy, made.xy[made.image == i])
    kept = {tuple(xyz) for xyz in given.xyz}
    assert all(tuple(xyz) in kept for xyz in made.xyz[~is_new])
    again = splat_cloud(given, views, None)
    assert all(
        np.array_equal(a, b) for a, b in zip(vars(made).values(), vars(again).values(), strict=True)
    )


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("SIMPLE_RADIAL", [191, 160, 120, -0.2]),
        ("SIMPLE_RADIAL", [125, 160, 120, -0.5]),
        ("OPENCV_FISHEYE", [95, 95, 160, 120, 0, 0, 0, 0]),
        ("OPENCV_FISHEYE", [45, 45, 160, 120, -0.05, 0, 0, 0]),
    ],
)
def test_pixels_without_a_ray_get_no_points(model: str, params: list[float]) -> None:
    lens = pycolmap.Camera(camera_id=1, model=model, width=WIDTH, height=HEIGHT, params=params)
    views = [PosedCamera(lens, pose) for pose in moving(0.1)]
    made = splat_cloud(cloud(scattered(3000, 5.0), views), views, None)
    assert np.isfinite(made.xyz).all()
    assert (np.diff(made.offsets) >= 1).all()
    assert coverage(views, made.xyz) > 0.95


def test_point_behind_a_filled_hole_leaves_no_hole() -> None:
    """A far point seen through a hole in a near wall is hidden once the hole is filled."""
    views = posed(moving(0.0, 1))
    x, y = np.meshgrid(np.arange(4.0, WIDTH, 8), np.arange(4.0, HEIGHT, 8))
    hole = (np.abs(x // 16 - 10) <= 1) & (np.abs(y // 16 - 7) <= 1)
    rays = (np.column_stack([x[~hole], y[~hole]]) - (WIDTH / 2, HEIGHT / 2)) / FOCAL
    wall = 5.0 * np.column_stack([rays, np.ones(len(rays))])
    beyond = np.array([[0.0, 0.0, 50.0]])
    made = splat_cloud(cloud(np.concatenate([wall, beyond]), views), views, None)
    assert coverage(views, made.xyz) == 1.0


@pytest.mark.parametrize("max_points", [100, 500, 1000])
def test_max_points_keeps_the_coverage(max_points: int) -> None:
    views = posed(moving(0.1))
    given = cloud(scattered(20_000, 5.0), views)
    made = splat_cloud(given, views, max_points)
    assert 0.9 * max_points < len(made.xyz) <= max_points
    assert coverage(views, made.xyz) > {100: 0.25, 500: 0.75, 1000: 0.96}[max_points]


def test_overlapping_surfaces_are_both_kept() -> None:
    views = posed(moving(0.3, 24))
    front, back = scattered(4000, 4.0), scattered(4000, 40.0, seed=1)
    made = splat_cloud(cloud(np.concatenate([front, back]), views), views, None)
    assert (made.xyz[:, 2] == 4.0).sum() > 500
    assert (made.xyz[:, 2] == 40.0).sum() > 500


def test_holes_next_to_an_edge_are_filled_at_the_background() -> None:
    """Otherwise new points would occlude what other images observe."""
    views = posed(moving(0.2))
    front = scattered(3000, 2.0)
    back = scattered(3000, 20.0, seed=1)
    front = front[front[:, 0] < -0.2]
    back = back[back[:, 0] / back[:, 2] > 0.1]
    made = splat_cloud(cloud(np.concatenate([front, back]), views), views, None)
    added = made.xyz[made.error < 0]
    between = added[(added[:, 0] / added[:, 2] > -0.05) & (added[:, 0] / added[:, 2] < 0.1)]
    assert len(between) > 20
    assert np.mean(between[:, 2] > 15) > 0.9


def test_images_without_points_get_a_wall() -> None:
    """An empty cloud is filled with points in front of the cameras."""
    views = posed(moving(0.1))
    none = ModelPoints(
        np.empty((0, 3)),
        np.empty((0, 3), np.uint8),
        np.empty(0),
        np.zeros(1, np.int64),
        np.empty(0, np.int64),
        np.empty((0, 2)),
    )
    made = splat_cloud(none, views, None)
    assert coverage(views, made.xyz) > 0.99


def test_invalid_options_are_refused() -> None:
    with pytest.raises(OptionError, match="max_points"):
        TriangulateOptions(max_points=99)
    with pytest.raises(OptionError, match="max_points"):
        TriangulateOptions(points="survey", max_points=500)
    for given in ({"min_angle": 2.0}, {"max_depth_error": None}):
        with pytest.raises(OptionError, match="--points survey"):
            TriangulateOptions(**given)
        TriangulateOptions(points="survey", **given)


def test_camera_centres_are_correct() -> None:
    poses = turning(20.0)
    poses[:, :, 3] = np.arange(24).reshape(8, 3)
    for view, centre in zip(posed(poses), camera_centres(poses), strict=True):
        assert np.allclose(view.centre, centre)


def given_to_core(num_points: int) -> dict[str, np.ndarray]:
    """Arguments of the core functions for points that every view observes."""
    poses = moving(0.2)
    truth = scattered(num_points, 3.0)
    seen = see(truth, poses, 0.0)
    return {
        "cam_from_world": poses,
        "focal": views_of(poses).focal,
        "view": seen.view,
        "rays": seen.rays,
        "xyz": truth,
        "offsets": seen.offsets,
        "observation": np.arange(len(seen.view)),
    }


FLOATERS = {
    "distance_share": 0.7,
    "near_ratio": 1.1,
    "support": 2,
    "square_width": 1000.0,
    "fewest_in_square": 3,
}


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("view", lambda view: view + 1),
        ("view", lambda view: view - 1),
        ("offsets", lambda offsets: offsets[::-1].copy()),
        ("offsets", lambda offsets: offsets[:-1]),
        ("offsets", lambda offsets: offsets[:0]),
        ("observation", lambda observation: observation + 1),
        ("rays", lambda rays: rays[1:]),
        ("focal", lambda focal: focal[1:]),
        ("xyz", lambda xyz: xyz[1:]),
        ("cam_from_world", lambda poses: poses[:1]),
    ],
)
def test_core_refuses_mismatched_arrays_of_points(name: str, wrong: Callable[..., object]) -> None:
    given = given_to_core(5)
    assert np.abs(_core.reprojection_errors(**given)).max() < 1e-9
    assert _core.floater_observations(**given, **FLOATERS).tolist() == [0] * 5
    given[name] = wrong(given[name])
    with pytest.raises(ValueError, match=r"fit|no such"):
        _core.reprojection_errors(**given)
    with pytest.raises(ValueError, match=r"fit|no such"):
        _core.floater_observations(**given, **FLOATERS)
    if name in ("view", "offsets", "xyz", "cam_from_world"):
        centres = camera_centres(given["cam_from_world"])
        rest = {key: given[key] for key in ("xyz", "offsets", "view")}
        with pytest.raises(ValueError, match=r"fit|no such"):
            _core.widest_angles(centres=centres, **rest)


def test_core_ignores_nan() -> None:
    given = given_to_core(5)
    given["xyz"][0] *= 0.3  # floats in front of the others
    given["rays"] += 1.0  # all in one grid cell
    counts = _core.floater_observations(**given, **FLOATERS)
    assert counts.tolist() == [NUM_VIEWS, 0, 0, 0, 0]
    given["rays"][0] = np.nan
    given["xyz"][4] = np.nan
    counts = _core.floater_observations(**given, **FLOATERS)
    assert counts.tolist() == [NUM_VIEWS - 1, 0, 0, 0, 0]
    errors = _core.reprojection_errors(**given)
    assert np.isinf(errors[0])
    assert np.isinf(errors[-NUM_VIEWS:]).all()
    assert np.isfinite(errors[1:-NUM_VIEWS]).all()
    rest = {key: given[key] for key in ("xyz", "offsets", "view")}
    angles = _core.widest_angles(centres=camera_centres(given["cam_from_world"]), **rest)
    assert (angles[:4] > 0).all()
    assert angles[4] == 0
    with pytest.raises(ValueError, match="wider than 0"):
        _core.floater_observations(**given, **FLOATERS | {"square_width": 0.0})


def test_core_refuses_mismatched_arrays_of_surfaces() -> None:
    xy, depth = np.array([[3.0, 4.0], [5.0, 4.0]]), np.array([2.0, 2.1])
    limits = {"width": 8, "height": 8, "steps_per_octave": 2.0, "most_steps": 64}
    spacings, rank = np.array([8, 2]), np.array([1, 0])
    best = _core.best_at_spacings(xy, depth, rank, spacings=spacings, **limits)
    assert best.tolist() == [1, 0]
    for wrong in ({"spacings": np.array([0])}, {"spacings": spacings, "width": 5}):
        with pytest.raises(ValueError, match=r"spacings|outside"):
            _core.best_at_spacings(xy, depth, rank, **limits | wrong)
    for beyond in (np.inf, np.nan, 0.0):
        with pytest.raises(ValueError, match="outside"):
            _core.best_at_spacings(xy, np.full(2, beyond), rank, spacings=spacings, **limits)
    # With extremely many steps per octave, the surfaces are not separated.
    limits["steps_per_octave"] = 1e308
    steep = _core.best_at_spacings(xy, depth * 8, rank, spacings=spacings, **limits)
    assert steep.tolist() == [1, 0]

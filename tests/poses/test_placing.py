"""Models are placed by positions, gravity, vertical lines and known distances."""

from __future__ import annotations

import cv2
import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from colmap_av1.database.reading import PosePrior
from colmap_av1.errors import OptionError
from colmap_av1.geometry.alignment import PathFit, Up, east_north_up, fit_path, transform_poses
from colmap_av1.geometry.colmap_model import ModelImage, camera_centres
from colmap_av1.options.place import PlaceOptions, parse_distance
from colmap_av1.poses.placing.distance import model_distance
from colmap_av1.poses.placing.placement import PlacementData, find_placement
from colmap_av1.poses.placing.up import (
    rotation_to_up,
    up_of_cameras,
    up_of_gravity,
    up_of_lines,
    vertical_lines,
)

CAMERA = pycolmap.Camera(
    camera_id=1, model="PINHOLE", width=640, height=480, params=[500.0, 500.0, 320.0, 240.0]
)
Z = np.array([0.0, 0.0, 1.0])


def looking(centres: NDArray[np.float64], forward: NDArray[np.float64]) -> NDArray[np.float64]:
    """Poses of level cameras in a world with z up."""
    poses = []
    for centre, ahead in zip(centres, forward, strict=True):
        z = ahead / np.linalg.norm(ahead)
        x = np.cross(z, Z) / np.linalg.norm(np.cross(z, Z))
        rotation = np.array([x, np.cross(z, x), z])
        poses.append(np.c_[rotation, -rotation @ centre])
    return np.array(poses)


def walk(num: int = 40, *, straight: bool = False) -> NDArray[np.float64]:
    """Poses of a walk of 20 m with a camera pitched down by 20 degrees, in metres with z up."""
    t = np.linspace(0, 1, num)
    side = np.zeros(num) if straight else 3 * np.sin(4 * t)
    centres = np.column_stack([20 * t, side, 0.05 * np.sin(9 * t) + 1.6])
    yaw = 0.6 * np.sin(5 * t)
    forward = np.column_stack([np.sin(yaw), np.cos(yaw), np.full(num, -0.36)])
    return looking(centres, forward)


def elsewhere(seed: int = 3) -> pycolmap.Sim3d:
    """A similarity from metres to the coordinates of a mapper."""
    rotation = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    return pycolmap.Sim3d(0.07, pycolmap.Rotation3d(rotation), np.array([1.0, -2.0, 0.5]))


def images_of(poses: NDArray[np.float64]) -> list[ModelImage]:
    return [ModelImage(i + 1, f"{i}.png", 1, pose) for i, pose in enumerate(poses)]


def angle(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    return float(np.rad2deg(np.arccos(np.clip(a @ b, -1, 1))))


def test_similarity_transforms_poses_like_points() -> None:
    moved = elsewhere()
    poses = walk()
    np.testing.assert_allclose(
        camera_centres(transform_poses(moved, poses)), moved * camera_centres(poses), atol=1e-12
    )
    point = np.array([4.0, 9.0, 1.0])
    before = poses[:, :, :3] @ point + poses[:, :, 3]
    after = transform_poses(moved, poses)
    seen = after[:, :, :3] @ (moved * point) + after[:, :, 3]
    np.testing.assert_allclose(seen, moved.scale * before, atol=1e-12)


def test_east_north_up_is_tangent_to_the_ellipsoid() -> None:
    origin = (59.33, 18.07, 20.0)
    # A minute of latitude is a nautical mile; a minute of longitude is half as long there.
    there = np.array([[59.33 + 1 / 60, 18.07, 20], [59.33, 18.07 + 1 / 60, 21]])
    east, north, up = east_north_up(there, origin).T
    assert north[0] == pytest.approx(1857, abs=2)
    assert east[1] == pytest.approx(949, abs=2)
    assert up == pytest.approx([-0.27, 0.93], abs=0.02)


@pytest.mark.parametrize("straight", [False, True])
def test_path_is_fitted_to_positions_with_noise_and_outliers(straight: bool) -> None:
    poses = walk(straight=straight)
    positions = camera_centres(poses)
    rng = np.random.default_rng(1)
    measured = positions + rng.normal(0, 0.4, positions.shape)
    measured[[5, 20, 21]] += [[80.0, 0, 0], [0, -500, 30], [0, 0, 15]]
    mapped = transform_poses(elsewhere(), poses)
    up = Up(up_of_cameras(mapped), np.deg2rad(6))
    found = fit_path(camera_centres(mapped), measured, up, 0)
    assert isinstance(found, PathFit)
    assert found.num_used == 37
    placed = found.similarity * camera_centres(mapped)
    assert np.abs(placed - positions).max() < 0.6
    assert found.similarity.scale * elsewhere().scale == pytest.approx(1, abs=0.03)
    level = found.similarity.rotation * (elsewhere().rotation * Z)
    assert angle(level, Z) < 4
    again = fit_path(camera_centres(mapped), measured, up, 0)
    assert isinstance(again, PathFit)
    assert np.array_equal(again.similarity.matrix(), found.similarity.matrix())


@pytest.mark.parametrize("straight", [False, True])
def test_a_third_of_the_positions_may_be_outliers(straight: bool) -> None:
    poses = walk(straight=straight)
    positions = camera_centres(poses)
    rng = np.random.default_rng(1)
    measured = positions + rng.normal(0, 0.4, positions.shape)
    jumped = rng.permutation(len(measured))[: len(measured) // 3]
    measured[jumped] += rng.normal(0, 800, (len(jumped), 3))
    mapped = transform_poses(elsewhere(), poses)
    up = Up(up_of_cameras(mapped), np.deg2rad(6))
    found = fit_path(camera_centres(mapped), measured, up, 0)
    assert isinstance(found, PathFit), found
    assert found.num_used == len(measured) - len(jumped)
    placed = found.similarity * camera_centres(mapped)
    assert np.abs(placed - positions).max() < 0.6


@pytest.mark.parametrize(
    ("move", "reason"),
    [
        (lambda p, rng: np.tile(p[0], (len(p), 1)), "still"),
        (lambda p, rng: rng.normal(0, 90, p.shape), "from the path"),
        (lambda p, rng: 0.1 * p + rng.normal(0, 1.5, p.shape), "scatter"),
    ],
)
def test_unusable_positions_give_a_reason(move: object, reason: str) -> None:
    poses = walk()
    places = move(camera_centres(poses), np.random.default_rng(0))  # type: ignore[operator]
    found = fit_path(camera_centres(poses), places, Up(Z, 0.1), 0)
    assert isinstance(found, str)
    assert reason in found


@given(st.integers(0, 1000))
@settings(max_examples=25, deadline=None)
def test_up_is_estimated_from_the_camera_orientation(seed: int) -> None:
    """Pitch does no harm if the camera turns, and the mapper's world may have any orientation."""
    world = elsewhere(seed)
    poses = transform_poses(world, walk())
    up = up_of_cameras(poses)
    assert angle(up, world.rotation * Z) < 4
    np.testing.assert_allclose(rotation_to_up(up) @ up, Z, atol=1e-9)
    assert np.linalg.det(rotation_to_up(up)) == pytest.approx(1)


def test_up_is_estimated_although_some_pictures_are_stored_sideways() -> None:
    world = elsewhere()
    poses = transform_poses(world, walk())
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    poses[::4] = quarter @ poses[::4]
    assert angle(up_of_cameras(poses), world.rotation * Z) < 4


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1), (1, 2, 0)])
def test_up_by_gravity_works_in_any_sensor_axes(order: tuple[int, ...]) -> None:
    world = elsewhere()
    poses = walk()
    rng = np.random.default_rng(0)
    gravity = (poses[:, :, :3] @ -Z)[:, order] * [1, -1, -1] + rng.normal(0, 0.01, (40, 3))
    gravity[7] = np.nan
    found = up_of_gravity(transform_poses(world, poses), gravity)
    assert found is not None
    assert angle(found[0], world.rotation * Z) < 1
    assert found[1] < 2
    assert up_of_gravity(poses, rng.normal(0, 1, (40, 3))) is None
    assert up_of_gravity(poses, np.full((40, 3), np.nan)) is None


def test_up_is_estimated_from_vertical_lines() -> None:
    """A camera that is pitched down sees posts, and slanted beams as outliers."""
    world = elsewhere()
    poses = walk()[::5]
    normals = []
    rough = Rotation.from_rotvec(np.deg2rad([6.0, 3.0, 0])).as_matrix() @ (world.rotation * Z)
    for pose in poses:
        picture = np.full((480, 640, 3), 90, np.uint8)
        for x in range(-10, 40, 2):
            ends = [np.array([x, 12.0, 0.0]), np.array([x, 12.0, 6.0])]
            beam = [np.array([x, 12.0, 2.0]), np.array([x + 1.5, 12.0, 2.6])]
            for a, b in (ends, beam):
                seen = [pose[:, :3] @ p + pose[:, 3] for p in (a, b)]
                if min(p[2] for p in seen) > 0.5:
                    pixels = [500 * p[:2] / p[2] + [320, 240] for p in seen]
                    p, q = [tuple(int(16 * v) for v in xy) for xy in pixels]
                    cv2.line(picture, p, q, (230, 230, 230), 5, cv2.LINE_AA, 4)
        moved = transform_poses(world, pose[None])[0]
        normals.append(vertical_lines(picture, CAMERA, moved, rough))
    found = up_of_lines(normals, rough)
    assert found is not None
    assert angle(found, world.rotation * Z) < 0.5
    assert angle(rough, world.rotation * Z) > 5
    assert up_of_lines([], rough) is None


def test_known_distance_between_cameras_or_marks_gives_the_scale() -> None:
    world = elsewhere()
    poses = walk()
    images = {image.name: image for image in images_of(transform_poses(world, poses))}
    centres = camera_centres(poses)
    apart = float(np.linalg.norm(centres[0] - centres[30]))

    def distance(text: str) -> float:
        return model_distance(parse_distance(text), images, {1: CAMERA})

    assert distance("1=0.png,30.png") == pytest.approx(apart * world.scale)

    def mark(point: list[float], i: int) -> str:
        x, y, z = poses[i, :, :3] @ np.array(point) + poses[i, :, 3]
        return f"{i}.png:{500 * x / z + 320:.3f}:{500 * y / z + 240:.3f}"

    a, b = [4.0, 9.0, 1.0], [4.9, 9.0, 2.2]
    text = f"1.5={mark(a, 0)}+{mark(a, 10)},{mark(b, 3)}+{mark(b, 8)}+{mark(b, 12)}"
    assert distance(text) == pytest.approx(1.5 * world.scale, rel=1e-3)
    known = PlacementData({})
    options = PlaceOptions(scale=text)
    found, _ = find_placement([*images.values()], {1: CAMERA}, known, options, 0)
    assert found.units == "metres"
    assert found.similarity.scale * world.scale == pytest.approx(1, rel=1e-3)
    for wrong, reason in (
        ("1=0.png,99.png", "no image '99.png'"),
        (f"1={mark(a, 0)}+{mark(b, 10)},1.png", "not mark the same point"),
        (f"1={mark(a, 0)}+0.png:10:10,1.png", "give METRES=A,B"),
        ("1=0.png", "give METRES=A,B"),
        ("-1=0.png,1.png", "above 0 metres"),
        ("1=0.png,0.png", "both ends"),
        ("far=0.png,1.png", "give METRES=A,B"),
    ):
        with pytest.raises(OptionError, match=reason):
            distance(wrong)


def test_known_distance_overrides_the_scale_of_positions() -> None:
    poses = walk()
    world = elsewhere()
    images = images_of(transform_poses(world, poses))
    centres = camera_centres(poses)
    priors = {
        image.name: PosePrior(1.1 * place, is_cartesian=True)
        for image, place in zip(images, centres, strict=True)
    }
    apart = float(np.linalg.norm(centres[0] - centres[30]))
    for scale, expected in ((None, 1.1), (f"{apart}=0.png,30.png", 1.0)):
        options = PlaceOptions(scale=scale)
        found, _ = find_placement(images, {1: CAMERA}, PlacementData(priors), options, 0)
        assert found.similarity.scale * world.scale == pytest.approx(expected, rel=1e-6)
        moved = camera_centres(
            transform_poses(found.similarity, np.array([i.cam_from_world for i in images]))
        )
        # The centre of the path still comes from the positions.
        np.testing.assert_allclose(moved.mean(axis=0), 1.1 * centres.mean(axis=0), atol=1e-6)
        assert found.axes == "of the pose priors"


@pytest.mark.parametrize("longitude", [0.0, 170.0, 180.0, -180.0])
def test_positions_on_both_sides_of_the_date_line_place_a_model(longitude: float) -> None:
    poses = walk()
    images = images_of(transform_poses(elsewhere(), poses))
    centres = camera_centres(poses) - camera_centres(poses).mean(axis=0)
    metres = 111_319.49  # per degree on the equator
    priors = {
        image.name: PosePrior(
            np.array([y / metres, (longitude + x / metres + 180) % 360 - 180, z]),
            is_cartesian=False,
        )
        for image, (x, y, z) in zip(images, centres, strict=True)
    }
    found, place_warnings = find_placement(
        images, {1: CAMERA}, PlacementData(priors), PlaceOptions(), 0
    )
    assert not place_warnings
    assert found.units == "metres"
    assert found.origin is not None
    assert abs((found.origin.longitude - longitude + 180) % 360 - 180) < 1e-3
    assert -180 <= found.origin.longitude < 180


def test_rejected_positions_name_only_the_options_that_would_help() -> None:
    images = images_of(transform_poses(elsewhere(), walk()))
    here = PosePrior(np.array([1.0, 2.0, 3.0]), is_cartesian=True)
    known = PlacementData({image.name: here for image in images})
    ends = f"2.5={images[0].name},{images[30].name}"
    for scale, upright in ((None, False), (None, True), (ends, False), (ends, True)):
        options = PlaceOptions(upright=upright, scale=scale)
        found, (warning,) = find_placement(images, {1: CAMERA}, known, options, 0)
        assert found.units == ("arbitrary" if scale is None else "metres")
        assert ("--scale" in warning) == (scale is None)
        assert ("--upright" in warning) == (not upright)


def test_a_single_position_is_kept_when_a_model_is_turned_upright() -> None:
    images = images_of(transform_poses(elsewhere(), walk()))
    known = PlacementData({}, position=(1.0, 2.0, 3.0))
    found, _ = find_placement(images, {1: CAMERA}, known, PlaceOptions(upright=True), 0)
    assert found.axes == "z up"
    assert any("single position" in how for how in found.how)

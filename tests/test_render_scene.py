"""The example clip and its ground truth are consistent."""

import av
import cv2
import numpy as np
import pytest
import render_scene
from conftest import PROJECT

EXAMPLES = PROJECT / "examples"


@pytest.fixture(scope="module")
def scene():
    return render_scene.build_scene()


@pytest.fixture(scope="module")
def truth():
    with np.load(EXAMPLES / "scene_truth.npz") as file:
        return dict(file)


@pytest.fixture(scope="module")
def luma():
    with av.open(str(EXAMPLES / "scene.mp4")) as container:
        assert container.streams.video[0].codec_context.codec.canonical_name == "av1"
        frames = [f.to_ndarray()[: f.height, : f.width] for f in container.decode(video=0)]
    return np.stack(frames).astype(np.float32)


def _positions(scene, count, seed, margin=0.0):
    rng = np.random.default_rng(seed)
    size = np.array([scene.width, scene.height])
    return rng.uniform(margin, size - margin, (count, 2))


def test_clip_has_one_picture_per_pose(scene, luma):
    assert luma.shape == (len(scene.cam_from_world), scene.height, scene.width)
    assert (EXAMPLES / "scene.mp4").stat().st_size < 1_000_000


def test_truth_file_matches_the_scene(scene, truth):
    # The last bits of a sine depend on the processor.
    np.testing.assert_allclose(truth["cam_from_world"], scene.cam_from_world, rtol=0, atol=1e-13)
    assert truth["cam_from_world"].dtype == np.float64
    for name in ("width", "height", "fx", "fy", "cx", "cy"):
        assert truth[name] == getattr(scene, name)


def test_rotations_are_orthonormal(scene):
    for pose in scene.cam_from_world:
        np.testing.assert_allclose(pose[:, :3] @ pose[:, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(pose[:, :3]) == pytest.approx(1)


def test_depth_map_matches_the_scene(scene, truth):
    grid = np.stack(np.meshgrid(truth["depth_x"], truth["depth_y"]), -1)
    for frame in (0, 31, 59):
        points = render_scene.surface_points(scene, frame, grid.reshape(-1, 2))
        depth = render_scene.project(scene, frame, points)[1].reshape(grid.shape[:2])
        np.testing.assert_allclose(truth["depth"][frame], depth, rtol=2**-11)


def test_projection_uses_the_stored_pose_and_intrinsics(truth, scene):
    pose, point = truth["cam_from_world"][17], np.array([0.4, 0.2, 0.3])
    x, y, z = pose[:, :3] @ point + pose[:, 3]
    expected = [truth["fx"] * x / z + truth["cx"], truth["fy"] * y / z + truth["cy"]]
    xy, depth, _ = render_scene.project(scene, 17, point[None])
    np.testing.assert_allclose(xy[0], expected, atol=1e-12)
    assert depth[0] == pytest.approx(z)


@pytest.mark.parametrize("frame", [0, 31])
def test_surface_points_have_no_distance_to_the_surfaces(scene, frame):
    points = render_scene.surface_points(scene, frame, _positions(scene, 3000, frame))
    assert render_scene.surface_distance(scene, points).max() < 1e-9
    pose = scene.cam_from_world[frame]
    ray = points + pose[:, :3].T @ pose[:, 3]
    before = render_scene.surface_distance(scene, points - 0.05 * ray)
    assert (before <= 0.05 * np.linalg.norm(ray, axis=1) + 1e-9).all()
    assert np.median(before) > 0.02


@pytest.mark.parametrize("frame", [0, 24, 59])
def test_surface_points_project_to_their_pixels(scene, frame):
    xy = _positions(scene, 4000, frame)
    points = render_scene.surface_points(scene, frame, xy)
    assert np.isfinite(points).all()
    back, depth, visible = render_scene.project(scene, frame, points)
    np.testing.assert_allclose(back, xy, atol=1e-8)
    assert visible.all()
    assert 1.0 < depth.min() < depth.max() < 15.0


@pytest.mark.parametrize(("a", "b"), [(0, 1), (10, 18), (59, 20), (0, 59)])
def test_transfer_is_invertible(scene, a, b):
    xy = _positions(scene, 4000, 100 * a + b)
    there, visible = render_scene.transfer(scene, xy, a, b)
    assert 0.3 < visible.mean() <= 1
    back, seen = render_scene.transfer(scene, there[visible], b, a)
    np.testing.assert_allclose(back, xy[visible], atol=1e-6)
    assert seen.all()


def test_transfer_marks_hidden_and_outside_points(scene):
    # A point behind the ball is hidden from the first camera.
    ball = next(s for s in scene.surfaces if s.material == "marble")
    pose = scene.cam_from_world[0]
    centre = -pose[:, :3].T @ pose[:, 3]
    behind = ball.origin + 0.6 * (ball.origin - centre) / np.linalg.norm(ball.origin - centre)
    above = np.array([0.0, 30.0, 30.0])
    at_back = centre - pose[2, :3]
    xy, _, visible = render_scene.project(scene, 0, np.stack([behind, above, at_back]))
    assert not visible.any()
    assert np.isfinite(xy[:2]).all()
    assert np.isnan(xy[2]).all()


def test_camera_moves_along_a_hand_held_arc(scene):
    xy = _positions(scene, 2000, 5)
    for frame in range(0, 58, 6):
        there, visible = render_scene.transfer(scene, xy, frame, frame + 1)
        step = np.median(np.linalg.norm(there - xy, axis=1)[visible])
        assert 1.0 < step < 6.0
    points = render_scene.surface_points(scene, 30, xy)
    rays = []
    for pose in scene.cam_from_world[[0, -1]]:
        ray = points + pose[:, :3].T @ pose[:, 3]
        rays.append(ray / np.linalg.norm(ray, axis=1, keepdims=True))
    parallax = np.degrees(np.arccos((rays[0] * rays[1]).sum(1)))
    assert np.median(parallax) > 25


def _disagreement(scene, luma, a, b, shifts):
    """Mean absolute luma difference of frame a and frame b warped onto it, for each shift."""
    rows, cols = np.mgrid[1 : scene.height : 2, 0 : scene.width : 3]
    xy, visible = render_scene.transfer(
        scene, np.stack([cols, rows], -1).reshape(-1, 2) + 0.5, a, b
    )
    size = np.array([scene.width, scene.height])
    use = visible & (xy > 3).all(1) & (xy < size - 3).all(1)
    reference = luma[a][rows.ravel()[use], cols.ravel()[use]]
    errors = []
    for shift in shifts:
        # cv2.remap has the origin at the centre of the first pixel, and accepts at most 32767 rows.
        moved = (xy[use] + shift - 0.5).astype(np.float32)
        moved = np.pad(moved, ((0, -len(moved) % 256), (0, 0))).reshape(-1, 256, 2)
        warped = cv2.remap(luma[b], moved, None, cv2.INTER_CUBIC).ravel()[: len(reference)]
        errors.append(float(np.abs(warped - reference).mean()))
    return errors


@pytest.mark.parametrize(("a", "b"), [(30, 31), (20, 28), (50, 42)])
def test_decoded_pictures_agree_with_the_transfer(scene, luma, a, b):
    shifts = [[0, 0], [0.5, 0], [-0.5, 0], [0, 0.5], [0, -0.5]]
    exact, *shifted = _disagreement(scene, luma, a, b, shifts)
    assert exact < 0.4 * np.abs(luma[a] - luma[b]).mean()
    assert min(shifted) > 1.3 * exact


@pytest.mark.parametrize("axis", [0, 1])
def test_decoded_pictures_have_no_subpixel_offset(scene, luma, axis):
    # A parabola through the errors at -0.25, 0 and 0.25 px has its minimum within 0.03 px of 0.
    shifts = np.zeros((3, 2))
    shifts[:, axis] = -0.25, 0, 0.25
    errors = _disagreement(scene, luma, 33, 36, shifts)
    low, middle, high = errors
    assert abs(0.125 * (low - high) / (low - 2 * middle + high)) < 0.03


@pytest.mark.parametrize("axis", [0, 1])
def test_outlines_are_at_depth_discontinuities(scene, luma, axis):
    # Warping hardly detects an offset common to all frames, but object outlines do. Brightness
    # steps must be equally strong one pixel before and after depth discontinuities.
    profile = np.zeros(3)
    for frame in (5, 30, 55):
        rows, cols = np.mgrid[0 : scene.height, 0 : scene.width]
        centres = np.stack([cols, rows], -1).reshape(-1, 2) + 0.5
        points = render_scene.surface_points(scene, frame, centres)
        depth = render_scene.project(scene, frame, points)[1].reshape(rows.shape)
        jump = np.moveaxis(np.abs(np.diff(depth, axis=axis)) > 0.5, axis, 0)
        step = np.moveaxis(np.abs(np.diff(luma[frame], axis=axis)), axis, 0)
        inner = jump[2:-2]
        profile += [step[2 + k : len(step) - 2 + k][inner].mean() for k in (-1, 0, 1)]
    low, middle, high = profile
    assert middle > 1.5 * max(low, high)
    assert abs(0.5 * (low - high) / (low - 2 * middle + high)) < 0.1

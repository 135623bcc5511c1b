"""Coverage: the share of the images that points fill."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest

from colmap_av1.geometry.coverage import CELL, coverage, nearest_depth
from colmap_av1.geometry.masks import make_mask
from colmap_av1.geometry.posed_camera import PosedCamera

SIZE = (160, 96)
PLAIN = pycolmap.Camera(
    camera_id=1, model="PINHOLE", width=SIZE[0], height=SIZE[1], params=[100, 100, 80, 48]
)
# The distortion folds far rays back into the image.
BENT = pycolmap.Camera(
    camera_id=2, model="SIMPLE_RADIAL", width=SIZE[0], height=SIZE[1], params=[100, 80, 48, -0.1]
)
# Lenses whose distortion gives some or all pixels at the image edge no ray.
NO_CORNERS = pycolmap.Camera(
    camera_id=3, model="SIMPLE_RADIAL", width=SIZE[0], height=SIZE[1], params=[96, 80, 48, -0.2]
)
NO_EDGE = pycolmap.Camera(
    camera_id=4, model="SIMPLE_RADIAL", width=SIZE[0], height=SIZE[1], params=[62, 80, 48, -0.5]
)
CIRCLE = pycolmap.Camera(
    camera_id=5,
    model="OPENCV_FISHEYE",
    width=SIZE[0],
    height=SIZE[1],
    params=[22, 22, 80, 48, -0.05, 0, 0, 0],
)
HERE = np.column_stack([np.eye(3), np.zeros(3)])
NUM_CELLS = SIZE[0] // CELL * SIZE[1] // CELL


def at_cells(depth: float, camera: pycolmap.Camera = PLAIN) -> np.ndarray:
    """A point in the centre of each cell, row by row."""
    y, x = np.mgrid[CELL // 2 : SIZE[1] : CELL, CELL // 2 : SIZE[0] : CELL].reshape(2, -1)
    rays = np.asarray(camera.cam_from_img(np.column_stack([x, y]).astype(float)))
    return np.column_stack([rays, np.ones(len(rays))]) * depth


@pytest.mark.parametrize("camera", [PLAIN, BENT])
def test_projection_agrees_with_colmap(camera: pycolmap.Camera) -> None:
    """With points outside the image and behind the camera, and more points than in a chunk."""
    rng = np.random.default_rng(1)
    angles = rng.uniform(-3, 3, 3)
    rotation = pycolmap.Rotation3d(angles).matrix()
    view = PosedCamera(camera, np.column_stack([rotation, [0.3, -0.2, 0.1]]))
    xyz = rng.normal(0, 2, (5000, 3))
    local = xyz @ rotation.T + view.cam_from_world[:, 3]
    there = np.flatnonzero(local[:, 2] > 0)
    # Outside the field of view the distortion folds rays back into the image.
    rays = local[there, :2] / local[there, 2:]
    there = there[(np.abs(rays) < [1.0, 0.6]).all(axis=1)]
    at = np.asarray(camera.img_from_cam(local[there])).reshape(-1, 2)
    inside = ((at >= 0) & (at < SIZE)).all(axis=1)
    index, xy, depth = view.project(xyz)
    assert len(index) > 200
    assert index.tolist() == there[inside].tolist()
    assert np.allclose(xy, at[inside], atol=1e-9)
    assert np.allclose(depth, local[index, 2], atol=1e-12)


@pytest.mark.parametrize("camera", [PLAIN, BENT])
def test_coverage_is_the_share_of_cells(camera: pycolmap.Camera) -> None:
    view = PosedCamera(camera, HERE)
    points = at_cells(3.0, camera)
    assert len(points) == NUM_CELLS
    assert coverage([view], points) == 1.0
    assert coverage([view], points[::3]) == pytest.approx(len(points[::3]) / NUM_CELLS)
    assert coverage([view], np.concatenate([points[::3]] * 5)) < 0.4
    assert coverage([view], -points) == 0.0
    assert coverage([view], np.empty((0, 3))) == 0.0
    assert coverage([], points) == 0.0


def test_images_have_equal_weight() -> None:
    """An image that sees no point halves the coverage."""
    turned = PosedCamera(PLAIN, np.column_stack([np.diag([1.0, -1.0, -1.0]), np.zeros(3)]))
    assert coverage([PosedCamera(PLAIN, HERE), turned], at_cells(3.0)) == 0.5


def test_points_behind_a_surface_do_not_fill_its_gap() -> None:
    view = PosedCamera(PLAIN, HERE)
    near, far = at_cells(3.0), at_cells(30.0)
    columns = SIZE[0] // CELL
    gap = 2 * columns + 4
    wall = np.delete(near, gap, axis=0)
    assert coverage([view], np.concatenate([wall, far[[gap]]])) == pytest.approx(1 - 1 / NUM_CELLS)
    # A point on the surface fills it, and points next to the edge of a surface count as well.
    assert coverage([view], np.concatenate([wall, 1.1 * near[[gap]]])) == 1.0
    half = np.arange(NUM_CELLS) % columns < columns // 2
    assert coverage([view], np.where(half[:, None], near, far)) == 1.0


def test_projection_gives_pixels_and_depths() -> None:
    """Points outside the image, behind the camera or folded back by distortion are dropped."""
    view = PosedCamera(BENT, np.column_stack([np.eye(3), [0.0, 0.0, 1.0]]))
    points = np.array([[0.5, 0.2, 1.0], [5.0, 0.0, 0.5], [0.1, 0.2, -3.0], [0.0, 0.0, 4.0]])
    index, xy, depth = view.project(points)
    assert index.tolist() == [0, 3]
    assert depth.tolist() == [2.0, 5.0]
    assert np.allclose(xy[1], (80, 48))
    grid = nearest_depth(view, points)
    assert grid.shape == (6, 10)
    assert np.sort(grid.ravel())[:3].tolist() == [2.0, 5.0, np.inf]


@pytest.mark.parametrize("camera", [NO_CORNERS, NO_EDGE, CIRCLE])
def test_lens_without_rays_at_the_image_edge_sees_exactly_the_points_on_its_rays(
    camera: pycolmap.Camera,
) -> None:
    view = PosedCamera(camera, HERE)
    xyz = np.random.default_rng(1).uniform((-6, -6, -1), (6, 6, 6), (5000, 3))
    index, xy, depth = view.project(xyz)
    # The distortion folds no other points into the image, and no point near the axis is lost.
    assert np.allclose(view.rays(xy) * depth[:, None], xyz[index], atol=0.01)
    near = np.flatnonzero((xyz[:, 2] > 0) & (np.abs(xyz[:, :2]) < 0.4 * xyz[:, 2:]).all(axis=1))
    assert len(near) > 100
    assert np.isin(near, index).all()


@pytest.mark.parametrize("camera", [NO_CORNERS, NO_EDGE, CIRCLE])
def test_cells_without_a_ray_are_not_counted(camera: pycolmap.Camera) -> None:
    view = PosedCamera(camera, HERE)
    y, x = np.mgrid[0.5 : SIZE[1], 0.5 : SIZE[0]].reshape(2, -1)
    xy = np.column_stack([x, y])
    own = view.rays(xy[view.keeps(xy)]) * 3.0
    assert 0 < len(own) < len(xy)
    assert len(view.project(own)[0]) == len(own)
    masked = PosedCamera(camera, HERE, make_mask(np.ones(SIZE[::-1], np.bool_)))
    assert coverage([view], own) == coverage([masked], own) == 1.0


@pytest.mark.parametrize("focal_length", [400.0, 600.0])
def test_distortion_does_not_fold_points_into_the_image(focal_length: float) -> None:
    """With the shorter focal length, even the edge of the image has no rays."""
    lens = pycolmap.Camera(
        camera_id=1,
        model="SIMPLE_RADIAL",
        width=640,
        height=480,
        params=[focal_length, 320, 240, -0.25],
    )
    view = PosedCamera(lens, HERE)
    own = np.column_stack([np.linspace(0, 6, 200), np.zeros(200), np.ones(200)])
    xy = np.asarray(lens.img_from_cam(own)).reshape(-1, 2)
    inside = (xy[:, 0] >= 0) & (xy[:, 0] < 640)
    seen = view.sees(own, xy)
    assert (inside & ~seen).any()
    assert np.flatnonzero(inside & seen).tolist() == view.project(own)[0].tolist()

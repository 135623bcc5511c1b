"""Pairs of views with known poses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from synthetic_scene import CAMERA_PARAMS, HEIGHT, WIDTH

from colmap_av1.geometry.cameras import make_camera
from colmap_av1.matching.matched_images import MatchedImages
from colmap_av1.matching.pairs import ImageKeypoints
from colmap_av1.matching.two_view_geometry import TwoViewGeometry
from colmap_av1.matching.verify import verify_pairs
from colmap_av1.options import CameraOptions

CAMERA = make_camera(CameraOptions(camera_params=CAMERA_PARAMS), WIDTH, HEIGHT)
TURN = Rotation.from_euler("y", 20, degrees=True).as_matrix()
# The pose of the second of `turned_views`.
TURNED = np.column_stack([TURN, [0, 0, 1] - TURN[:, 2]])
PAIR = np.array([[0, 1]], dtype=np.int32)
ANGLE = 6.0


def two_views(
    bend: float, rng: np.random.Generator, count: int = 160, angle: float = ANGLE
) -> tuple[list[ImageKeypoints], NDArray[np.uint32]]:
    """Two views of a curved wall, `angle` degrees apart."""
    x = rng.uniform((-0.4, -0.25), (0.4, 0.25), (count, 2))
    depth = 1 + 0.3 * x[:, 0] + bend * (x**2).sum(axis=1)
    points = np.c_[x * depth[:, None], depth]
    turn = Rotation.from_euler("y", -angle / 2, degrees=True).as_matrix()
    moved = (points - [np.radians(angle), 0, 0]) @ turn.T
    return _seen(points, moved, 0.15, rng)


def turned_views(
    spread: float, depth: float, count: int, rng: np.random.Generator
) -> tuple[list[ImageKeypoints], NDArray[np.uint32]]:
    """Two views, 20 degrees apart, of points within `spread` of the axis and `depth` of 1."""
    x = rng.uniform((-spread, -spread), (spread, spread), (count, 2))
    points = np.c_[x, np.ones(count)] * (1 + rng.uniform(-depth, depth, count))[:, None]
    moved = points @ TURN.T + TURNED[:, 3]
    return _seen(points, moved, 0.3, rng)


def _seen(
    points: NDArray[np.float64], moved: NDArray[np.float64], noise: float, rng: np.random.Generator
) -> tuple[list[ImageKeypoints], NDArray[np.uint32]]:
    """Keypoints of points in the coordinates of two cameras, with noise in pixels."""
    own = np.arange(len(points), dtype=np.uint32)
    keypoints = []
    for seen in (points, moved):
        xy = CAMERA.img_from_cam(seen) + rng.normal(0, noise, (len(points), 2))
        keypoints.append(ImageKeypoints(xy.astype(np.float32), np.arange(len(points))))
    return keypoints, np.c_[own, own]


def verified(keypoints: list[ImageKeypoints], matches: NDArray[np.uint32]) -> TwoViewGeometry:
    return verify_pairs(keypoints, PAIR, [matches], CAMERA)[0]


def separate_pairs(
    views: list[tuple[list[ImageKeypoints], NDArray[np.uint32]]],
    poses: list[NDArray[np.float64] | None],
    models: list[int] | None = None,
) -> tuple[MatchedImages, list[list[NDArray[np.float64] | None]]]:
    """Pairs that share no image, given the poses of their second images.

    The images of a pair are no neighbours. With None, the pose of both images is unknown. `models`
    gives the model of each pair; without it, all are in one.

    Returns:
        The images, eight for each pair, and for each model the pose of each image.
    """
    models = models or [0] * len(views)
    nothing = np.empty((0, 2), np.float32)
    keypoints = [ImageKeypoints(nothing, np.arange(0)) for i in range(8 * len(views))]
    known: list[list[NDArray[np.float64] | None]] = [
        [None] * len(keypoints) for _ in range(1 + max(models))
    ]
    pairs = np.array([[8 * i, 8 * i + 4] for i in range(len(views))], dtype=np.int32)
    for i, ((own, _), pose) in enumerate(zip(views, poses, strict=True)):
        first, second = pairs[i].tolist()
        keypoints[first], keypoints[second] = own
        if pose is not None:
            model = known[models[i]]
            model[first], model[second] = np.eye(3, 4), pose
    geometries = [verified(*own) for own in views]
    matched = MatchedImages(
        keypoints, pairs, [g.inlier_matches for g in geometries], geometries, False
    )
    return matched, known

"""Synthetic tracks of a moving camera, without pictures."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from colmap_av1.tracks.tracks import Tracks

WIDTH, HEIGHT, FOCAL = 640, 480, 700.0
NUM_FRAMES = 24


def seen_by(
    centre: NDArray[np.float64], turn: NDArray[np.float64], num_points: int = 600
) -> Tracks:
    """Make tracks of points in a box.

    Args:
        centre: float64 [NUM_FRAMES, 3] camera centres.
        turn: float64 [NUM_FRAMES, 3] rotation vectors from world to camera.
        num_points: number of points.
    """
    rng = np.random.default_rng(0)
    points = rng.uniform([-6, -4, 8], [6, 4, 16], (num_points, 3))
    rotation = Rotation.from_rotvec(turn).as_matrix()
    local = np.einsum("fij,fpj->pfi", rotation, points - centre[:, None])
    xy = FOCAL * local[..., :2] / local[..., 2:] + np.array([WIDTH / 2, HEIGHT / 2])
    xy += rng.normal(0, 0.2, xy.shape)
    return Tracks(
        num_frames=NUM_FRAMES,
        width=WIDTH,
        height=HEIGHT,
        offsets=np.arange(num_points + 1, dtype=np.int64) * NUM_FRAMES,
        frame=np.tile(np.arange(NUM_FRAMES), num_points).astype(np.int32),
        xy=xy.reshape(-1, 2).astype(np.float32),
        sigma=np.zeros(xy.size // 2, np.float32),
        confirmed=np.zeros(xy.size // 2, np.bool_),
    )


def walk(num_points: int = 600) -> Tracks:
    """Tracks of a hand-held camera that moves sideways and looks up and around."""
    t = np.linspace(0, 1, NUM_FRAMES)[:, None]
    centre = np.hstack([3 * t, 0.5 * np.sin(5 * t), 0.8 * np.sin(3 * t)])
    turn = np.hstack([0.2 * np.sin(6 * t), 0.25 * np.sin(4 * t), 0.05 * t])
    return seen_by(centre, turn, num_points)

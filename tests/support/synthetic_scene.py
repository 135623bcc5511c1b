"""A synthetic scene with exact poses: points observed by a camera that moves along an arc."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_av1.matching.matched_images import MatchedImages
from colmap_av1.matching.pairs import image_keypoints, pair_matches, schedule_pairs
from colmap_av1.matching.verify import verify_pairs
from colmap_av1.options import PairOptions, VerifyOptions
from colmap_av1.tracks.tracks import Tracks

WIDTH, HEIGHT, FOCAL = 640, 480, 700.0
CAMERA_PARAMS = f"{FOCAL},{WIDTH / 2},{HEIGHT / 2},0"


@dataclass(frozen=True)
class Scene:
    """Noisy tracks and the true poses.

    Attributes:
        tracks: observations of the points, each in consecutive frames.
        rotation: float64 [n, 3, 3] rotations from world to camera.
        center: float64 [n, 3] camera centres.
    """

    tracks: Tracks
    rotation: NDArray[np.float64]
    center: NDArray[np.float64]


def make_scene(
    *,
    num_frames: int = 16,
    num_points: int = 1500,
    noise: float = 0.3,
    arc_degrees: float = 40.0,
    flat: bool = False,
    turning: bool = False,
    seed: int = 0,
) -> Scene:
    """Make a scene of points 8 to 12 units from a camera that moves along an arc around them.

    Args:
        flat: all points lie in one plane.
        turning: the camera rotates in place.
    """
    rng = np.random.default_rng(seed)
    points = rng.uniform([-4, -3, 0.0 if flat else -2], [4, 3, 0.0 if flat else 2], (num_points, 3))
    angles = np.deg2rad(np.linspace(-arc_degrees / 2, arc_degrees / 2, num_frames))
    rotation, center = [], []
    for angle in angles:
        c, s = np.cos(angle), np.sin(angle)
        if turning:
            c, s = np.cos(angle / 4), np.sin(angle / 4)
        rotation.append([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        away = 0.0 if turning else angle
        center.append([10 * np.sin(away), 0, -10 * np.cos(away)])
    R, C = np.array(rotation), np.array(center)
    seen_by = np.einsum("fij,fpj->fpi", R, points[None] - C[:, None])
    xy = FOCAL * seen_by[..., :2] / seen_by[..., 2:] + [WIDTH / 2, HEIGHT / 2]
    xy += rng.normal(0, noise, xy.shape)
    visible = ((xy > 0) & (xy < [WIDTH, HEIGHT])).all(axis=2)
    first = rng.integers(-8, num_frames - 3, num_points)
    length = rng.integers(6, 14, num_points)
    frame = np.arange(num_frames)[:, None]
    visible &= (frame >= first) & (frame < first + length)
    point, where = np.nonzero(visible.T)
    offsets = np.concatenate([[0], np.cumsum(np.bincount(point, minlength=num_points))])
    tracks = Tracks(
        num_frames=num_frames,
        width=WIDTH,
        height=HEIGHT,
        offsets=offsets.astype(np.int64),
        frame=where.astype(np.int32),
        xy=xy[where, point].astype(np.float32),
        sigma=np.full(len(where), noise, np.float32),
        confirmed=np.zeros(len(where), bool),
    )
    return Scene(tracks, R, C)


def match_scene(scene: Scene, camera: object) -> MatchedImages:
    """Run the stages up to verification."""
    keypoints = image_keypoints(scene.tracks, range(scene.tracks.num_frames))
    pairs = schedule_pairs(keypoints, PairOptions())
    matches = [pair_matches(keypoints[i], keypoints[j]) for i, j in pairs]
    geometries = verify_pairs(keypoints, pairs, matches, camera, VerifyOptions())
    return MatchedImages(keypoints, pairs, matches, geometries, forward_motion=False)


def alignment_error(estimated: NDArray[np.float64], truth: NDArray[np.float64]) -> float:
    """RMS distance of camera centres after similarity alignment (Umeyama 1991)."""
    a, b = estimated - estimated.mean(axis=0), truth - truth.mean(axis=0)
    u, d, vt = np.linalg.svd(b.T @ a)
    sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    scale = (d * np.diag(sign)).sum() / (a**2).sum()
    return float(np.sqrt(((scale * a @ (u @ sign @ vt).T - b) ** 2).sum(axis=1).mean()))

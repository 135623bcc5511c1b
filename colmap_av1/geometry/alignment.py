"""Similarity transforms, and alignment of a camera path with measured positions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap

from colmap_av1.util.arrays import Bools, Floats

# Inlier threshold of GPS positions in metres: their usual scatter within minutes. Positions with
# larger errors are outliers.
_MAX_ERROR = 3.0
# Positions with a smaller spread (RMS, in metres) come from a receiver at rest.
_LEAST_SPREAD = 1.0
_LEAST_POSITIONS = 3
# Smallest share of inliers, and largest relative error of the scale, of an accepted fit.
_LEAST_SHARE = 0.6
_LARGEST_SCALE_ERROR = 0.1
# Height in metres of the virtual points above the path that represent the up direction. An up
# direction that is 10 degrees off moves such a point by less than _MAX_ERROR, so good positions of
# a wide path still determine the rotation.
_POST = 12.0
# Quantile of the scales of pairs of positions that determines this height in the path's units.
_ROUGH_QUANTILE = 0.25
_NUM_TRIALS = 10_000
_ITERATIONS = 10
# Lower bound on the estimated error of positions, in metres.
_LEAST_ERROR = 0.1
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Up:
    """The up direction in a model.

    Attributes:
        direction: float64 [3] unit vector.
        error: standard error of the direction in radians.
    """

    direction: Floats
    error: float


@dataclass(frozen=True)
class PathFit:
    """A camera path aligned with positions.

    Attributes:
        similarity: the transform from the path to the positions.
        num_used: number of inlier positions.
        error: RMS distance of the inliers to the path, in metres.
        scale_error: relative standard error of the scale.
    """

    similarity: pycolmap.Sim3d
    num_used: int
    error: float
    scale_error: float


def fit_path(path: Floats, positions: Floats, up: Up, seed: int) -> PathFit | str:
    """Align a camera path with positions that may contain outliers.

    A straight path does not determine the rotation about itself. Therefore virtual points above
    the path, in the up direction, take part in the estimation (LO-RANSAC, Chum et al. 2003).

    Args:
        path: float64 [n, 3] camera centres.
        positions: float64 [n, 3] measured positions in metres, z up.
        up: approximate up direction in the path's world.
        seed: random seed of the samples.

    Returns:
        The fit, or a text with the reason why there is none.
    """
    if len(path) < _LEAST_POSITIONS:
        return f"only {len(path)} images have a position"
    distinct = len(np.unique(positions.round(2), axis=0))
    spread = _spread(positions)
    if distinct < _LEAST_POSITIONS or spread < _LEAST_SPREAD:
        return f"they stand still, within {spread:.1f} m"
    rough = _rough_scale(path, positions)
    if rough is None:
        return "the camera does not move"
    post = _POST / rough
    # pycolmap returns a dictionary, although its stub declares Sim3d.
    found: Any = pycolmap.estimate_sim3d_robust(
        np.concatenate([path, path + post * up.direction]),
        np.concatenate([positions, positions + _POST * _UP]),
        pycolmap.RANSACOptions(max_error=_MAX_ERROR, max_num_trials=_NUM_TRIALS, random_seed=seed),
    )
    if found is None:
        return "the camera path has a different shape"
    similarity, used = _refined(path, positions, up, found["tgt_from_src"])
    away = np.linalg.norm(similarity * path - positions, axis=1)
    if used.mean() < _LEAST_SHARE:
        return f"{np.mean(~used):.0%} of them are {_MAX_ERROR:.0f} m or more from the path"
    error = float(np.sqrt(np.mean(away[used] ** 2)))
    # Interpolated positions of images between two measurements are not independent.
    num_distinct = len(np.unique(positions[used].round(2), axis=0))
    scale_error = error / (_spread(positions[used]) * np.sqrt(num_distinct))
    if scale_error > _LARGEST_SCALE_ERROR:
        return f"they scatter by {error:.1f} m over a path of {spread:.1f} m"
    return PathFit(similarity, int(used.sum()), error, float(scale_error))


def transform_poses(similarity: pycolmap.Sim3d, cam_from_world: Floats) -> Floats:
    """Transform cam_from_world poses, float64 [n, 3, 4], to the target world of a similarity."""
    rotation = cam_from_world[:, :, :3] @ np.asarray(similarity.rotation.matrix()).T
    translation = similarity.scale * cam_from_world[:, :, 3] - rotation @ similarity.translation
    return np.concatenate([rotation, translation[:, :, None]], axis=2)


def east_north_up(places: Floats, origin: tuple[float, float, float]) -> Floats:
    """Local tangent-plane coordinates: float64 [n, 3] metres east, north and up of an origin.

    Args:
        places: float64 [n, 3] latitude and longitude in degrees, altitude in metres (WGS 84).
        origin: latitude, longitude and altitude of the origin.
    """
    to_ecef = pycolmap.GPSTransform().ellipsoid_to_ecef
    away = np.asarray(to_ecef(places)) - np.asarray(to_ecef(np.array([origin])))
    latitude, longitude = np.deg2rad(origin[:2])
    sin_lat, cos_lat = np.sin(latitude), np.cos(latitude)
    sin_lon, cos_lon = np.sin(longitude), np.cos(longitude)
    axes = np.array(
        [
            [-sin_lon, cos_lon, 0],
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
        ]
    )
    return np.asarray(away @ axes.T)


def _refined(
    path: Floats, positions: Floats, up: Up, start: pycolmap.Sim3d
) -> tuple[pycolmap.Sim3d, Bools]:
    """Least-squares similarity of the inlier positions and the up direction.

    Scale and translation depend on the positions only (Umeyama 1991). The up direction contributes
    one direction to the rotation, weighted by its accuracy.

    Returns:
        The similarity, and the inlier mask of the positions.
    """
    found = start
    for _ in range(_ITERATIONS):
        away = np.linalg.norm(found * path - positions, axis=1)
        used = away <= _MAX_ERROR
        if used.sum() < _LEAST_POSITIONS:
            return found, used
        error = max(float(np.sqrt(np.mean(away[used] ** 2))), _LEAST_ERROR)
        # Interpolated positions of images between two measurements are not independent.
        share = len(np.unique(positions[used].round(2), axis=0)) / int(used.sum())
        here, there = (
            path[used] - path[used].mean(axis=0),
            positions[used] - positions[used].mean(axis=0),
        )
        moment = found.scale * share / error**2 * there.T @ here
        moment += np.outer(_UP, up.direction) / up.error**2
        u, _, vt = np.linalg.svd(moment)
        rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        scale = float((there * (here @ rotation.T)).sum() / (here**2).sum())
        if scale <= 0:
            return found, used
        mean = scale * rotation @ path[used].mean(axis=0)
        translation = positions[used].mean(axis=0) - mean
        found = pycolmap.Sim3d(scale, pycolmap.Rotation3d(rotation), translation)
    return found, used


def _spread(points: Floats) -> float:
    return float(np.sqrt(np.mean(((points - np.median(points, axis=0)) ** 2).sum(axis=1))))


def _rough_scale(path: Floats, positions: Floats) -> float | None:
    """Metres per unit of the path, from pairs of distant images.

    A lower quantile than the median is used, because an outlier in a pair increases its distance,
    and most pairs contain one if a third of the positions are outliers.
    """
    half = max(len(path) // 2, 1)
    there = np.linalg.norm(positions[half:] - positions[:-half], axis=1)
    here = np.linalg.norm(path[half:] - path[:-half], axis=1)
    moved = here > 1e-9 * max(float(np.abs(path).max()), 1e-9)
    if not moved.any() or not (there[moved] > 0).any():
        return None
    return float(np.quantile(there[moved] / here[moved], _ROUGH_QUANTILE)) or None

"""How certain the camera positions of a model are."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from colmap_av1.geometry.colmap_model import camera_centres
from colmap_av1.geometry.posed_model import PosedModel, reprojection_errors
from colmap_av1.util.arrays import Floats

# Largest expected error of the camera centres of a model that is certain, as a share of their
# extent. Of 52 models of rendered walks, those below it were off by at most 0.26 % of their extent,
# and those above by up to 23 %. Eight clips have 0.003 to 0.06 %.
MAX_CERTAIN_ERROR = 0.001
# Models with more images are not examined, because that would take long.
MAX_IMAGES = 500
# The expected error of a model with more observations is estimated from some of its points.
_MAX_OBSERVATIONS = 300_000
# A similarity transform explains any error of two centres.
_FEWEST_IMAGES = 3
# Observations whose error exceeds this multiple of the median error are outliers.
_OUTLIER = 4.0
# Median of a Rayleigh distribution, that of the length of errors in two dimensions, in units of its
# scale.
_RAYLEIGH_MEDIAN = 1.1774
# Added to the normal equations of points, as a share of their largest eigenvalue: points at
# infinity have no depth.
_DAMPING = 1e-11
# Smallest eigenvalue of the normal equations that is not due to rounding, as a share of the
# largest.
_LEAST_EIGENVALUE = 1e-12
# Smallest singular value of the moves by a similarity transform, as a share of the largest.
_ON_A_LINE = 1e-9
# Added so that the equations of points without observations can be solved.
_NO_OBSERVATION = 1e-30
# Number of degrees of freedom of a similarity transform, which no observation determines.
_GAUGE_FREEDOMS = 7


def expected_error(model: PosedModel) -> float | None:
    """Expected error of the camera centres of a model, see `centre_uncertainty`.

    Args:
        model: a model with points.

    Returns:
        The root mean square over the images, as a share of the extent of the centres. None for
        models of more than 500 images, and where it is not defined: with fewer than three images,
        without points, or with all centres at one place.
    """
    if not _FEWEST_IMAGES <= len(model.images) <= MAX_IMAGES:
        return None
    errors = centre_uncertainty(model)
    return float(np.sqrt(np.mean(errors**2))) if np.isfinite(errors).all() else None


def uncertainty_warning(error: float | None) -> str | None:
    """Warning about an `expected_error` that is large; None if it is small or not known."""
    if error is None or error <= MAX_CERTAIN_ERROR:
        return None
    return (
        f"few points with parallax determine the camera positions: expect errors of "
        f"{error:.1%} of their extent or more; move sideways more while filming"
    )


def centre_uncertainty(model: PosedModel) -> Floats:
    """Expected errors of the camera centres that follow from errors of the observations.

    They are the standard deviations of bundle adjustment of poses and points (Triggs et al., Bundle
    Adjustment - A Modern Synthesis, 2000), after similarity alignment of the centres. Errors of
    observations are assumed to be independent and as large as the model's reprojection errors. In
    tracks they are not independent: on rendered walks, actual errors were 2 to 20 times the
    expected ones.

    Args:
        model: a model of three images or more, with points.

    Returns:
        float64 [num_images] in units of the diagonal of the bounding box of all centres; very large
        where observations do not determine a pose. Infinite if all centres are at one place, or no
        observed point lies in front of its camera.
    """
    every = math.ceil(len(model.points.image) / _MAX_OBSERVATIONS)
    if every > 1:  # the information of independent observations adds up
        some = np.arange(len(model.points.xyz)) % every == 0
        kept = np.repeat(some, np.diff(model.points.offsets))
        points, _ = model.points.keep_observations(kept)
        return centre_uncertainty(replace(model, points=points)) / math.sqrt(every)

    from scipy.linalg import cholesky, solve_triangular  # noqa: PLC0415 - slow to import
    from scipy.sparse import block_diag, bsr_matrix  # noqa: PLC0415

    points, num_images = model.points, len(model.images)
    centres = camera_centres(np.array([own.cam_from_world for own in model.images]))
    extent = float(np.linalg.norm(np.ptp(centres, axis=0)))
    errors = reprojection_errors(model)
    if extent == 0 or not np.isfinite(errors).any():
        return np.full(num_images, np.inf)
    median = float(np.median(errors[np.isfinite(errors)]))
    kept = np.isfinite(errors) & (errors <= _OUTLIER * median)
    point = points.point[kept]
    image = points.image[kept].astype(np.int64)
    # In units of the extent, and from the mean of the centres.
    rotation = np.array([own.cam_from_world[:, :3] for own in model.images])
    origin = centres.mean(axis=0)
    centres = (centres - origin) / extent
    xyz = (points.xyz - origin) / extent
    translation = -np.einsum("nij,nj->ni", rotation, centres)
    focal = np.array([model.cameras[own.camera_id].mean_focal_length() for own in model.images])

    # An observation measures the direction of its ray by two angles. An error of one pixel is an
    # error of 1 / focal length.
    ray = np.einsum("nij,nj->ni", rotation[image], xyz[point]) + translation[image]
    depth = np.linalg.norm(ray, axis=1)
    unit = ray / depth[:, None]
    across = np.eye(3) - unit[:, :, None] * unit[:, None, :]
    by_ray = across * (focal[image] / depth)[:, None, None]
    by_pose = np.concatenate([-by_ray @ _cross(ray), by_ray], axis=2)
    by_point = by_ray @ rotation[image]

    # The reduced camera matrix: the Schur complement of the points in the normal equations.
    of_poses = np.zeros((num_images, 6, 6))
    np.add.at(of_poses, image, by_pose.transpose(0, 2, 1) @ by_pose)
    of_points = np.zeros((len(points.xyz), 3, 3))
    np.add.at(of_points, point, by_point.transpose(0, 2, 1) @ by_point)
    # The inverse by eigenvectors stays accurate across the rays of points without depth.
    eigenvalues, eigenvectors = np.linalg.eigh(of_points)
    damped = eigenvalues + _DAMPING * eigenvalues[:, -1:] + _NO_OBSERVATION
    root_of_inverse = eigenvectors / np.sqrt(damped)[:, None, :]
    mixed = by_pose.transpose(0, 2, 1) @ by_point @ root_of_inverse[point]
    order = np.lexsort([point, image])
    rows = np.searchsorted(image[order], np.arange(num_images + 1))
    shape = (6 * num_images, 3 * len(points.xyz))
    eliminated = bsr_matrix((mixed[order], point[order], rows), shape=shape)
    reduced = (block_diag(of_poses) - eliminated @ eliminated.T).toarray()

    # Errors of the centres, without those that a similarity transform of the whole model explains.
    gauge = _gauge(rotation, translation)
    largest = float(np.diag(reduced).max())
    ridge = _LEAST_EIGENVALUE * largest * np.eye(len(reduced))
    root = cholesky(reduced + ridge + largest * gauge @ gauge.T, lower=True)
    by_translation = np.zeros((num_images, 3, num_images, 6))
    each = np.arange(num_images)
    by_translation[each, :, each, 3:] = -rotation.transpose(0, 2, 1)
    moves = by_translation.reshape(3 * num_images, -1)
    similarity = _similarity_moves(centres)
    moves -= similarity @ (similarity.T @ moves)
    deviations = solve_triangular(root, moves.T, lower=True)
    variance = (deviations**2).sum(axis=0).reshape(-1, 3).sum(axis=1)
    return np.asarray(median / _RAYLEIGH_MEDIAN * np.sqrt(variance))


def _cross(vectors: Floats) -> Floats:
    """Matrices [n, 3, 3] of cross products with vectors [n, 3]."""
    x, y, z = vectors.T
    zero = np.zeros(len(vectors))
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return np.asarray(np.stack([np.stack(row, axis=1) for row in rows], axis=1))


def _gauge(rotation: Floats, translation: Floats) -> Floats:
    """Orthonormal basis [6 n, 7] of the pose changes that follow a similarity transform."""
    changes = np.zeros((len(rotation), 6, _GAUGE_FREEDOMS))
    changes[:, 3:, :3] = rotation
    changes[:, :3, 3:6] = rotation
    changes[:, 3:, 3:6] = _cross(translation) @ rotation
    changes[:, 3:, 6] = translation
    return np.asarray(np.linalg.qr(changes.reshape(-1, _GAUGE_FREEDOMS))[0])


def _similarity_moves(centres: Floats) -> Floats:
    """Orthonormal basis [3 n, 7] of the moves of centres [n, 3] by similarity transforms.

    The basis has one column less if the centres lie on a line: a rotation about it moves none.
    """
    moves = np.zeros((len(centres), 3, _GAUGE_FREEDOMS))
    moves[:, :, :3] = np.eye(3)
    moves[:, :, 3:6] = _cross(centres)
    moves[:, :, 6] = centres
    basis, singular_values, _ = np.linalg.svd(
        moves.reshape(-1, _GAUGE_FREEDOMS), full_matrices=False
    )
    return np.asarray(basis[:, singular_values > _ON_A_LINE * singular_values[0]])

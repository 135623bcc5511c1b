"""Errors of tracks against ground truth, by frame distance."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_av1.matching.two_view_models import essential_of_poses, sampson_error
from colmap_av1.tracks.tracks import Tracks

SPANS = (1, 2, 4, 8, 16)

# Ground-truth correspondence: maps positions [n, 2] in frame a to positions [n, 2] in frame b, and
# tells whether each surface point is visible there.
Transfer = Callable[[NDArray[np.float64], int, int], tuple[NDArray[np.float64], NDArray[np.bool_]]]


def pairs_at_span(tracks: Tracks, span: int, *, max_pairs: int | None = None) -> NDArray[np.int64]:
    """Pairs of observations of the same track that are `span` frames apart.

    Args:
        tracks: the tracks.
        span: distance between the two frames.
        max_pairs: size of a random sample with a fixed seed; None: all pairs.

    Returns:
        int64 [n, 2] indices of observations, the earlier frame first, in the order of the tracks.
    """
    track = tracks.track
    # The observations of a track are sorted by frame, so these keys ascend.
    key = track * (tracks.num_frames + span) + tracks.frame
    first = np.flatnonzero(tracks.frame + span < tracks.num_frames)
    second = np.searchsorted(key, key[first] + span)
    found = second < len(key)
    found[found] = key[second[found]] == key[first[found]] + span
    pairs = np.stack([first[found], second[found]], 1)
    if max_pairs is not None and len(pairs) > max_pairs:
        rng = np.random.default_rng(0)
        pairs = pairs[np.sort(rng.choice(len(pairs), max_pairs, replace=False))]
    return pairs


def epipolar_errors(
    tracks: Tracks,
    cam_from_world: NDArray[np.float64],
    camera: pycolmap.Camera,
    span: int,
    *,
    max_pairs: int | None = 200_000,
) -> NDArray[np.float64]:
    """Sampson distances of tracks to the true epipolar geometry.

    They measure only the component of an error perpendicular to the epipolar line.

    Args:
        tracks: the tracks.
        cam_from_world: float64 [num_frames, 3, 4] true poses, NaN where unknown.
        camera: pycolmap.Camera with the true intrinsics.
        span: distance between the two frames.
        max_pairs: size of a random sample of pairs; None: all.

    Returns:
        float64 [n] distances in pixels of an undistorted image with the camera's focal length.
        Pairs of frames with an unknown pose or without a baseline are omitted.
    """
    pairs = pairs_at_span(tracks, span, max_pairs=max_pairs)
    frame = tracks.frame[pairs[:, 0]]
    errors = np.full(len(pairs), np.nan)
    for a in np.unique(frame):
        of_a = np.flatnonzero(frame == a)
        pose = cam_from_world[a]
        essential = essential_of_poses(pose, cam_from_world[a + span])
        # The essential matrix of a camera at rest is rounding noise.
        if np.linalg.norm(essential) > 1e-12 * (1 + np.linalg.norm(pose[:, 3])):
            rays = [_rays(camera, tracks.xy[pairs[of_a, side]]) for side in (0, 1)]
            errors[of_a] = camera.mean_focal_length() * sampson_error(essential, *rays)
    return np.asarray(errors[np.isfinite(errors)], dtype=np.float64)


def exact_errors(
    tracks: Tracks, transfer: Transfer, span: int, *, max_pairs: int | None = 50_000
) -> NDArray[np.float64]:
    """Positions of tracks minus the true projections of their surface points.

    An occluded point still has a true position, so a track that continues on the occluding surface
    has an error.

    Args:
        tracks: the tracks.
        transfer: the ground-truth correspondence between frames.
        span: distance between the two frames.
        max_pairs: size of a random sample of pairs; None: all.

    Returns:
        float64 [n, 2] signed errors in pixels (x right, y down). Positions that show no surface
        are omitted.
    """
    pairs = pairs_at_span(tracks, span, max_pairs=max_pairs)
    frame = tracks.frame[pairs[:, 0]]
    errors = np.full((len(pairs), 2), np.nan)
    for a in np.unique(frame):
        of_a = np.flatnonzero(frame == a)
        start = tracks.xy[pairs[of_a, 0]].astype(np.float64)
        truth, _ = transfer(start, int(a), int(a) + span)
        errors[of_a] = tracks.xy[pairs[of_a, 1]] - truth
    return np.asarray(errors[np.isfinite(errors).all(1)], dtype=np.float64)


def _rays(camera: pycolmap.Camera, xy: NDArray[np.float32]) -> NDArray[np.float64]:
    """[2, n] undistorted positions (x / z, y / z) of positions [n, 2]."""
    return np.transpose(np.asarray(camera.cam_from_img(xy.astype(np.float64)), dtype=np.float64))

"""Errors of tracks against ground truth, by the number of frames they span."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_av1.matching.two_view_models import essential_of_poses, sampson_error
from colmap_av1.tracks.tracks import Tracks

SPANS = (1, 2, 4, 8, 16)

# Carries positions [n, 2] of frame a to frame b: their positions [n, 2] there, and whether the
# point is visible there.
Transfer = Callable[[NDArray[np.float64], int, int], tuple[NDArray[np.float64], NDArray[np.bool_]]]


def pairs_at_span(tracks: Tracks, span: int, *, max_pairs: int | None = None) -> NDArray[np.int64]:
    """Observations of the same track that lie `span` frames apart.

    Args:
        tracks: the tracks.
        span: frames between the two observations.
        max_pairs: keep this many, drawn at random, the same ones each time; None: all.

    Returns:
        int64 [n, 2] rows of `tracks.frame` and `tracks.xy`, the earlier frame first, in the
        tracks' order.
    """
    track = tracks.track
    # Tracks are sorted by frame, so these keys ascend.
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

    Only the part of an error across the epipolar line shows.

    Args:
        tracks: the tracks.
        cam_from_world: float64 [num_frames, 3, 4] true poses, NaN where unknown.
        camera: pycolmap.Camera with the true intrinsics.
        span: frames between the two positions that are compared.
        max_pairs: pairs of positions at most, drawn at random; None: all.

    Returns:
        float64 [n] distances in pixels of an undistorted image of the camera's focal length;
        pairs of frames without known poses or without a baseline are left out.
    """
    pairs = pairs_at_span(tracks, span, max_pairs=max_pairs)
    frame = tracks.frame[pairs[:, 0]]
    errors = np.full(len(pairs), np.nan)
    for a in np.unique(frame):
        of_a = np.flatnonzero(frame == a)
        pose = cam_from_world[a]
        essential = essential_of_poses(pose, cam_from_world[a + span])
        # What rounding leaves of a camera at rest is no direction.
        if np.linalg.norm(essential) > 1e-12 * (1 + np.linalg.norm(pose[:, 3])):
            rays = [_rays(camera, tracks.xy[pairs[of_a, side]]) for side in (0, 1)]
            errors[of_a] = camera.mean_focal_length() * sampson_error(essential, *rays)
    return np.asarray(errors[np.isfinite(errors)], dtype=np.float64)


def exact_errors(
    tracks: Tracks, transfer: Transfer, span: int, *, max_pairs: int | None = 50_000
) -> NDArray[np.float64]:
    """Positions of tracks minus the true projections of their surface points.

    A point that another surface hides by then still has a true position: a track that goes on
    with what hides it is wrong by its distance to that.

    Args:
        tracks: the tracks.
        transfer: the truth: carries positions of one frame to another.
        span: frames between the two positions that are compared.
        max_pairs: pairs of positions at most, drawn at random; None: all.

    Returns:
        float64 [n, 2] signed errors in pixels, (x right, y down); positions that see no
        surface are left out.
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

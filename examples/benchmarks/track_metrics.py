"""Tracks of a database, their errors against ground truth, and their lengths and coverage."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap
from numpy.typing import NDArray

from colmap_av1 import DatabaseError, Tracks
from colmap_av1.database.file import open_unaltered
from colmap_av1.database.reading import (
    image_ids_from_pair_id,
    matches_from_row,
    read_keypoints,
)
from colmap_av1.evaluate.metrics.poses import frame_number
from colmap_av1.matching.epipolar import essential_of_poses, sampson_error
from colmap_av1.util.graphs import connected_components

# Lower bounds of the classes that track lengths are counted in.
LENGTHS = (2, 4, 8, 16, 32)
CELL = 16

# Ground-truth correspondence: maps positions [n, 2] in frame a to positions [n, 2] in frame b, and
# tells whether each surface point is visible there.
Transfer = Callable[[NDArray[np.float64], int, int], tuple[NDArray[np.float64], NDArray[np.bool_]]]


def database_tracks(database: Path, num_frames: int) -> Tracks:
    """Join the verified matches of a database to tracks, as a mapper does.

    Keypoints connected by inlier matches form a track. If several of them lie in one image, the
    matches contradict each other, and the track gets no observation in that image.

    Args:
        database: COLMAP database whose image names contain the frame number, from 0.
        num_frames: number of frames of the video.

    Returns:
        Tracks with two or more observations. Their expected errors are unknown: NaN.

    Raises:
        DatabaseError: the file is not a COLMAP database, is damaged, has no images, or has images
            of different sizes.
        ImageError: an image's name has no frame number.
    """
    names, sizes, keypoints, edge = _read(database)
    if len(sizes) != 1:
        raise DatabaseError(
            f"{database}: has images of {len(sizes)} sizes: give a database of one video"
        )
    count = sum(map(len, keypoints))
    track = connected_components(count, edge)
    frame = np.repeat([frame_number(n) for n in names], [len(k) for k in keypoints]).astype(
        np.int32
    )

    _, place, seen = np.unique(
        track.astype(np.int64) * num_frames + frame, return_inverse=True, return_counts=True
    )
    keep = seen[place] == 1
    keep &= np.bincount(track[keep], minlength=count + 1)[track] >= 2
    row = np.flatnonzero(keep)
    row = row[np.lexsort((frame[row], track[row]))]
    lengths = np.unique(track[row], return_counts=True)[1]
    width, height = sizes.pop()
    return Tracks(
        num_frames=num_frames,
        width=width,
        height=height,
        offsets=np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
        frame=frame[row],
        xy=np.concatenate(keypoints)[row].astype(np.float32),
        sigma=np.full(len(row), np.nan, dtype=np.float32),
        confirmed=np.zeros(len(row), dtype=bool),
    )


def _read(
    database: Path,
) -> tuple[list[str], set[tuple[int, int]], list[NDArray[np.float32]], NDArray[np.int64]]:
    """Image names, camera sizes, keypoints [n, 2] of each image, and all inlier matches.

    The matches, int64 [m, 2], are indices into the concatenated keypoints.
    """
    with open_unaltered(database) as connection:
        images = dict(connection.execute("SELECT image_id, name FROM images ORDER BY image_id"))
        sizes = set(connection.execute("SELECT width, height FROM cameras").fetchall())
        keypoints = {i: read_keypoints(connection, database, i)[:, :2] for i in images}
        first = dict(zip(images, np.cumsum([0, *map(len, keypoints.values())]), strict=False))
        edges = [np.empty((0, 2), dtype=np.int64)]
        for pair_id, *row in connection.execute(
            "SELECT pair_id, rows, data FROM two_view_geometries WHERE rows > 0 ORDER BY pair_id"
        ):
            a, b = image_ids_from_pair_id(pair_id)
            inliers = matches_from_row(database, pair_id, *row).astype(np.int64)
            counts = [len(keypoints[i]) if i in images else 0 for i in (a, b)]
            if (inliers >= counts).any():
                raise DatabaseError(
                    f"{database}: images {a} and {b} match keypoints that do not exist: "
                    "run 'colmap-av1 check' for a full list of problems"
                )
            edges.append(inliers + np.array([first[a], first[b]]))
    return list(images.values()), sizes, list(keypoints.values()), np.concatenate(edges)


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


@dataclass(frozen=True)
class TrackStatistics:
    """Figures of tracks, counted in images.

    Attributes:
        num_images: number of images.
        num_tracks: number of tracks that two or more images observe.
        mean_length: mean number of images that observe a track.
        tracks_by_length: number of tracks by the lower bound of their class, see LENGTHS.
        observations_per_image: number of observations of an image, mean and minimum.
        coverage: share of an image's cells of 16x16 pixels with an observation, mean and minimum.
    """

    num_images: int
    num_tracks: int
    mean_length: float
    tracks_by_length: dict[int, int]
    observations_per_image: tuple[float, int]
    coverage: tuple[float, float]


def track_statistics(tracks: Tracks, frames: NDArray[np.integer] | None = None) -> TrackStatistics:
    """Count tracks and the image area that they cover.

    Args:
        tracks: the tracks.
        frames: the frames that are images; all frames of the video if None.
    """
    images = np.arange(tracks.num_frames) if frames is None else np.unique(frames)
    is_image = np.zeros(tracks.num_frames, dtype=bool)
    is_image[images] = True
    track = tracks.track
    seen = is_image[tracks.frame]
    length = np.bincount(track[seen], minlength=tracks.num_tracks)
    # Drop tracks that only one image observes.
    seen &= length[track] >= 2
    length = length[length >= 2]

    observations = np.bincount(tracks.frame[seen], minlength=tracks.num_frames)[images]
    columns, rows = math.ceil(tracks.width / CELL), math.ceil(tracks.height / CELL)
    cell = (tracks.xy[seen] // CELL).astype(np.int64)
    column = np.clip(cell[:, 0], 0, columns - 1)
    row = np.clip(cell[:, 1], 0, rows - 1)
    place = (tracks.frame[seen].astype(np.int64) * rows + row) * columns + column
    covered = np.zeros(tracks.num_frames * rows * columns, dtype=bool)
    covered[place] = True
    coverage = covered.reshape(tracks.num_frames, -1)[images].mean(1)
    bounds = (*LENGTHS, np.iinfo(np.int64).max)
    counts = np.histogram(length, bounds)[0]
    return TrackStatistics(
        num_images=len(images),
        num_tracks=len(length),
        mean_length=float(length.mean()) if len(length) else 0.0,
        tracks_by_length={low: int(n) for low, n in zip(LENGTHS, counts, strict=True)},
        observations_per_image=(float(observations.mean()), int(observations.min())),
        coverage=(float(coverage.mean()), float(coverage.min())),
    )

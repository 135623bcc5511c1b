"""Tracks from the verified matches of a database."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_av1.database.file import open_unaltered
from colmap_av1.database.reading import (
    image_ids_from_pair_id,
    keypoints_from_row,
    matches_from_row,
)
from colmap_av1.errors import DatabaseError
from colmap_av1.evaluate.metrics.sequence import frame_number
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.graphs import connected_components


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
        keypoints = {i: np.empty((0, 2), dtype=np.float32) for i in images}
        for image_id, *row in connection.execute(
            "SELECT image_id, rows, cols, data FROM keypoints WHERE rows > 0"
        ):
            if image_id in images:
                keypoints[image_id] = keypoints_from_row(database, image_id, *row)[:, :2]
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

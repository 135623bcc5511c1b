"""Tracks joined from the verified matches of a database, whichever front-end wrote them."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from colmap_av1.errors import DatabaseError
from colmap_av1.evaluate.metrics.sequence import frame_number
from colmap_av1.tracks.tracks import Tracks


def database_tracks(database: Path, num_frames: int) -> Tracks:
    """Join the verified matches of a database to tracks, as a mapper does.

    Keypoints that inlier matches connect are one track. Where several of them lie in one image,
    the matches contradict each other: none of that image's is in the track.

    Args:
        database: COLMAP database; image names hold the frame's number from 0.
        num_frames: number of frames of the video.

    Returns:
        Tracks of two observations or more. The expected error is not known: NaN.

    Raises:
        DatabaseError: the images differ in size, or there is none.
        ImageError: an image's name holds no frame number.
    """
    with tempfile.TemporaryDirectory() as folder:
        # pycolmap brings a database to its own layout.
        copy = Path(folder) / database.name
        shutil.copyfile(database, copy)
        with pycolmap.Database.open(copy) as rows:
            images = rows.read_all_images()
            sizes = {(c.width, c.height) for c in rows.read_all_cameras()}
            keypoints = [np.asarray(rows.read_keypoints(i.image_id))[:, :2] for i in images]
            pair_ids, geometries = rows.read_two_view_geometries()
    if len(sizes) != 1:
        raise DatabaseError(
            f"{database}: holds images of {len(sizes)} sizes: give a database of one video"
        )
    start = np.concatenate([[0], np.cumsum([len(k) for k in keypoints])])
    row_of = {image.image_id: start[i] for i, image in enumerate(images)}
    ends = [np.empty((0, 2), dtype=np.int64)]
    for pair_id, geometry in zip(pair_ids, geometries, strict=True):
        a, b = pycolmap.pair_id_to_image_pair(pair_id)
        matches = np.asarray(geometry.inlier_matches, dtype=np.int64).reshape(-1, 2)
        ends.append(matches + np.array([row_of[a], row_of[b]]))
    edge = np.concatenate(ends)
    count = int(start[-1])
    graph = coo_array((np.ones(len(edge), dtype=np.int8), edge.T), shape=(count, count))
    _, track = connected_components(graph, directed=False)
    frame = np.repeat([frame_number(i.name) for i in images], np.diff(start)).astype(np.int32)

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

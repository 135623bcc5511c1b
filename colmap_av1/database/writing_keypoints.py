"""Writing keypoints to a COLMAP database, after those that its images have."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_av1.database.layout import columns
from colmap_av1.database.reading import SHAPES, keypoints_from_row
from colmap_av1.errors import DatabaseError
from colmap_av1.matching.pairs import ImageKeypoints


def append_keypoints(
    connection: sqlite3.Connection,
    path: Path,
    image_ids: Sequence[int],
    keypoints: Sequence[ImageKeypoints],
) -> list[int]:
    """Append keypoints to those that the images have; returns where each image's begin."""
    firsts = [0] * len(image_ids)
    all_present = any(len(k.xy) for k in keypoints)
    for index in np.argsort(np.asarray(image_ids, dtype=np.int64)):
        image_id, xy = image_ids[index], keypoints[index].xy.astype("<f4")
        present = _read_present_keypoints(connection, path, image_id)
        firsts[index] = len(present)
        all_present &= np.array_equal(present[len(present) - len(xy) :, :2], xy)
        shapes = np.tile(np.array(SHAPES[present.shape[1]], dtype="<f4"), (len(xy), 1))
        data = np.concatenate([present, np.concatenate([xy, shapes], axis=1)])
        connection.execute(
            "INSERT OR REPLACE INTO keypoints (image_id, rows, cols, data) VALUES (?, ?, ?, ?)",
            (image_id, *data.shape, data.tobytes()),
        )
        _append_descriptors(connection, image_id, len(present), len(xy))
    if all_present:
        raise DatabaseError(
            f"{path} has these very keypoints already: they were appended before, so there is "
            "nothing to do; on_existing replace writes them anew"
        )
    return firsts


def _read_present_keypoints(
    connection: sqlite3.Connection, path: Path, image_id: int
) -> NDArray[np.float32]:
    """An image's keypoints with all their columns; [0, 2] where it has none."""
    row = connection.execute(
        "SELECT rows, cols, data FROM keypoints WHERE image_id = ?", (image_id,)
    ).fetchone()
    if row is None or row[0] == 0:
        return np.empty((0, 2), dtype="<f4")
    return keypoints_from_row(path, image_id, *row)


def _append_descriptors(
    connection: sqlite3.Connection, image_id: int, num_present: int, num_new: int
) -> None:
    """Keep an image's descriptors, where it has any, as many as its keypoints.

    COLMAP's guided matching and vocabulary trees refuse other numbers. A zero descriptor lies
    at a right angle to every other and as near to one other zero descriptor as to the next,
    so neither the limit of the distance nor that of its ratio lets it match.
    """
    if not columns(connection, "descriptors"):
        return
    row = connection.execute(
        "SELECT cols, data FROM descriptors WHERE image_id = ? AND rows = ? AND cols > 0",
        (image_id, num_present),
    ).fetchone()
    if row is not None:
        num_cols, data = row
        connection.execute(
            "UPDATE descriptors SET rows = ?, data = ? WHERE image_id = ?",
            (num_present + num_new, (data or b"") + bytes(num_new * num_cols), image_id),
        )

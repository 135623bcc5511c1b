"""Writing matches and two-view geometries of image pairs to a COLMAP database."""

from __future__ import annotations

import dataclasses
import sqlite3
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_av1.database.layout import columns
from colmap_av1.database.reading import matches_from_row, pair_id_from_image_ids
from colmap_av1.matching.two_view_geometry import TwoViewConfig, TwoViewGeometry


def order_pairs(image_ids: Sequence[int], pairs: NDArray[np.int32]) -> list[tuple[int, int, bool]]:
    """Rows (pair id, index of the pair, whether its images swap), by pair id.

    COLMAP's columns follow the smaller image id, whatever the order of the images.
    """
    rows = []
    for index, (i, j) in enumerate(pairs):
        ids = image_ids[i], image_ids[j]
        rows.append((pair_id_from_image_ids(*ids), index, ids[0] > ids[1]))
    rows.sort()
    if len({row[0] for row in rows}) != len(rows):
        raise ValueError("a pair of images is given twice")
    return rows


def append_pairs(
    connection: sqlite3.Connection,
    path: Path,
    order: Sequence[tuple[int, int, bool]],
    *,
    shifts: Sequence[NDArray[np.uint32]],
    matches: Sequence[NDArray[np.uint32]],
    geometries: Sequence[TwoViewGeometry],
) -> None:
    """Write pairs; those that have rows get the new matches and inliers after their own.

    Args:
        connection: the database.
        path: its path, for messages.
        order: the pairs' ids and indices, see `order_pairs`.
        shifts: for each pair, uint32 [2] number of its images' first new keypoints.
        matches: for each pair, uint32 [n, 2] matches, counted from these.
        geometries: for each pair, its geometry, likewise.
    """
    present = {
        row[0]
        for row in connection.execute(
            "SELECT pair_id FROM matches WHERE rows > 0 "
            "UNION SELECT pair_id FROM two_view_geometries WHERE rows > 0"
        )
    }
    there = columns(connection, "two_view_geometries")
    models = [name for name in ("F", "E", "H", "qvec", "tvec") if name in there]
    names = ["pair_id", "rows", "cols", "data", "config", *models]
    insert_geometry = (
        f"INSERT OR REPLACE INTO two_view_geometries ({', '.join(names)}) "
        f"VALUES ({', '.join('?' * len(names))})"
    )
    for pair_id, index, swap in order:
        geometry = _swap_images(geometries[index]) if swap else geometries[index]
        pair_matches = _swapped(matches[index] + shifts[index], swap)
        inliers = _swapped(geometry.inlier_matches + shifts[index], swap)
        if geometry.config == TwoViewConfig.DEGENERATE:
            inliers = inliers[:0]
        keeps_models = False
        if pair_id in present:
            their_matches, their_inliers, their_support = _read_pair(connection, path, pair_id)
            pair_matches = np.concatenate([their_matches, pair_matches])
            keeps_models = len(their_inliers) > 0 and their_support >= len(inliers)
            inliers = np.concatenate([their_inliers, inliers])
        connection.execute(
            "INSERT OR REPLACE INTO matches (pair_id, rows, cols, data) VALUES (?, ?, 2, ?)",
            (pair_id, len(pair_matches), pair_matches.astype("<u4").tobytes()),
        )
        if keeps_models:
            connection.execute(
                "UPDATE two_view_geometries SET rows = ?, data = ? WHERE pair_id = ?",
                (len(inliers), inliers.astype("<u4").tobytes(), pair_id),
            )
            continue
        blobs = (_float_blob(getattr(geometry, name)) for name in models)
        connection.execute(
            insert_geometry,
            (
                pair_id,
                len(inliers),
                2,
                inliers.astype("<u4").tobytes(),
                int(geometry.config),
                *blobs,
            ),
        )


def _read_pair(
    connection: sqlite3.Connection, path: Path, pair_id: int
) -> tuple[NDArray[np.uint32], NDArray[np.uint32], int]:
    """A pair's matches, its inliers, and how many inliers support its models.

    A geometry that was never estimated, as importers write it, and one of several models are
    supported by nothing. Inliers of a degenerate geometry or a watermark are none.
    """
    row = connection.execute(
        "SELECT rows, data FROM matches WHERE pair_id = ?", (pair_id,)
    ).fetchone()
    matches = matches_from_row(path, pair_id, *(row or (0, None)))
    row = connection.execute(
        "SELECT rows, data, config FROM two_view_geometries WHERE pair_id = ?", (pair_id,)
    ).fetchone()
    num_rows, data, config = row or (0, None, TwoViewConfig.UNDEFINED)
    inliers = matches_from_row(path, pair_id, num_rows, data)
    if len(matches) == 0:
        matches = inliers
    if config in (TwoViewConfig.DEGENERATE, TwoViewConfig.WATERMARK):
        inliers = inliers[:0]
    without_model = (TwoViewConfig.UNDEFINED, TwoViewConfig.MULTIPLE)
    return matches, inliers, 0 if config in without_model else len(inliers)


def _swapped(matches: NDArray[np.uint32], swap: bool) -> NDArray[np.uint32]:
    return matches[:, ::-1] if swap else matches


def _float_blob(values: NDArray[np.float64] | None) -> bytes | None:
    return None if values is None else np.asarray(values, dtype="<f8").tobytes()


def _swap_images(geometry: TwoViewGeometry) -> TwoViewGeometry:
    """The models of the same geometry from the second image to the first.

    The columns of `inlier_matches` stay as they are.
    """
    qvec = tvec = H = None
    if geometry.qvec is not None and geometry.tvec is not None:
        w, x, y, z = geometry.qvec
        qvec = np.array([w, -x, -y, -z])
        tvec = -_rotation(qvec) @ geometry.tvec
    if geometry.H is not None and np.linalg.cond(geometry.H) < 1 / np.finfo(np.float64).eps:
        H = np.asarray(np.linalg.inv(geometry.H), dtype=np.float64)
    return dataclasses.replace(
        geometry,
        E=None if geometry.E is None else geometry.E.T,
        F=None if geometry.F is None else geometry.F.T,
        H=H,
        qvec=qvec,
        tvec=tvec,
    )


def _rotation(qvec: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation matrix of a unit quaternion (w, x, y, z)."""
    w, (x, y, z) = qvec[0], qvec[1:]
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + 2 * w * cross + 2 * cross @ cross)

"""Writing images, keypoints, matches and two-view geometries to a database, all or nothing."""

from __future__ import annotations

import dataclasses
import os
import sqlite3
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_av1.database.file import is_new, write_existing, write_new
from colmap_av1.database.layout import columns, has_rows
from colmap_av1.database.reading import (
    SHAPES,
    WGS84,
    image_ids_from_pair_id,
    matches_from_row,
    pair_id_from_image_ids,
    read_keypoints,
)
from colmap_av1.errors import DatabaseError
from colmap_av1.matching.matched_images import MatchedImages
from colmap_av1.matching.pairs import ImageKeypoints
from colmap_av1.matching.two_view_geometry import TwoViewConfig, TwoViewGeometry
from colmap_av1.options import OnExisting
from colmap_av1.util.arrays import Floats

# COLMAP's SensorType of a camera.
_CAMERA_SENSOR = 0
# The layout of COLMAP 3.10 to 3.13. Later versions migrate it; earlier versions ignore the table.
_POSE_PRIORS = (
    "CREATE TABLE pose_priors (image_id INTEGER PRIMARY KEY NOT NULL, position BLOB, "
    "coordinate_system INTEGER NOT NULL, position_covariance BLOB, "
    "FOREIGN KEY(image_id) REFERENCES images(image_id) ON DELETE CASCADE)"
)
_UNKNOWN = np.full(9, np.nan, dtype="<f8")


def write_matches(
    database: str | os.PathLike[str],
    names: Sequence[str],
    cameras: Sequence[pycolmap.Camera] | None,
    matched: MatchedImages,
    on_existing: OnExisting = "error",
    *,
    places: Floats | None = None,
) -> None:
    """Write keypoints, matches and two-view geometries: all rows, or none.

    A file that is absent or empty is created. If the database lists no images, cameras and images
    are inserted. If it lists images, the rows are added to the images of the given names, whose
    cameras do not change. Empty rows of these images, which matchers leave for pairs that they
    could not match, are replaced. If the database has frames (COLMAP 3.12 and later), every image
    without a frame gets one, because the mappers refuse a mixture.

    `on_existing` determines what happens to the existing keypoints and matches of the images:

    - "error": the database is refused.
    - "append": the new keypoints follow the existing ones, which keep their indices, columns
      and matches. New keypoints get a neutral shape; if the existing ones have descriptors, the
      new ones get zero descriptors, which SIFT matchers never match. An existing pair gets both
      sets of matches and of inliers, and the models of the geometry with more inliers. Matches
      that were never verified stay unverified.
    - "replace": keypoints, descriptors, matches and geometries of these images are removed,
      including all their pairs. Other images keep theirs.

    With "append" and "replace", named images that the database does not list are inserted.

    Args:
        database: path of the file.
        names: name of each image, its path relative to the image folder.
        cameras: the camera of each image, where images may share the same object; may be None if
            the database lists the images.
        matched: the keypoints of the images, and the matches and geometries of their pairs.
        on_existing: what happens to existing keypoints and matches of the images.
        places: float64 [num_images, 3] latitude and longitude in degrees and altitude in metres of
            each image, NaN where unknown. They become pose priors of images that have none. None:
            no place is known.

    Raises:
        DatabaseError: the file is locked, not a COLMAP database, lists other images, already
            has keypoints or matches of these images although `on_existing` is "error", already has
            the same keypoints, or cannot be written (no space, no permission). The file is then
            unchanged.
    """
    path = Path(database)
    keypoints, pairs = matched.keypoints, matched.pairs
    matches, geometries = matched.matches, matched.geometries
    if not (len(names) == len(keypoints) and len(pairs) == len(matches) == len(geometries)):
        raise ValueError("give one name for each image, and matches and geometry for each pair")
    if len(set(names)) != len(names) or "" in names:
        raise DatabaseError("two images have the same name, or one has none: give unique names")

    for (i, j), pair_matches in zip(pairs, matches, strict=True):
        limits = (len(keypoints[i].xy), len(keypoints[j].xy))
        if len(pair_matches) and np.any(pair_matches.max(axis=0) >= limits):
            raise ValueError(f"matches of images {i} and {j} refer to keypoints that do not exist")

    def fill(connection: sqlite3.Connection) -> None:
        image_ids = _ids_of_images(connection, path, names, cameras, on_existing)
        if on_existing == "error":
            _check_nothing_lost(connection, path, dict(zip(image_ids, names, strict=True)))
        elif on_existing == "replace":
            _clear_images(connection, set(image_ids))
        firsts = _append_keypoints(connection, path, image_ids, keypoints)
        shifts = [np.array([firsts[i], firsts[j]], dtype=np.uint32) for i, j in pairs]
        _append_pairs(
            connection,
            path,
            _order_pairs(image_ids, pairs),
            shifts=shifts,
            matches=matches,
            geometries=geometries,
        )
        _complete_frames(connection, path)
        if places is not None:
            _write_places(connection, image_ids, places)

    if is_new(path):
        write_new(path, fill)
    else:
        write_existing(path, fill)


def check_writable(database: str | os.PathLike[str]) -> None:
    """Check that a database can be written or created, without changing its content.

    Like every opening for writing, this rolls back an interrupted write.

    Raises:
        DatabaseError: the file is locked, not a COLMAP database, or has rigs or frames but no
            images; or its folder does not exist or cannot be written.
    """
    path = Path(database)
    new = is_new(path)
    if not os.access(path.resolve().parent, os.W_OK | os.X_OK):
        raise DatabaseError(f"{path}: no permission to write a database there: give another path")

    def fill(connection: sqlite3.Connection) -> None:
        if not has_rows(connection, "images"):
            _check_no_lone_rigs(connection, path)

    if not new:
        write_existing(path, fill)


def _ids_of_images(
    connection: sqlite3.Connection,
    path: Path,
    names: Sequence[str],
    cameras: Sequence[pycolmap.Camera] | None,
    on_existing: OnExisting,
) -> list[int]:
    """Ids of the named images; images that the database does not list are inserted."""
    listed = dict(connection.execute("SELECT name, image_id FROM images").fetchall())
    absent = [name for name in names if name not in listed]
    if listed and absent and (on_existing == "error" or cameras is None):
        raise DatabaseError(
            f"{path} lists {len(listed)} images, but not {absent[0]!r}: use images with the names "
            "that it lists, or a new database"
        )
    if not listed:
        _check_no_lone_rigs(connection, path)
    if absent:
        if cameras is None:
            raise ValueError("give cameras: the database lists no images")
        camera_of = dict(zip(names, cameras, strict=True))
        listed |= _insert_images(connection, {name: camera_of[name] for name in absent})
    return [listed[name] for name in names]


def _check_no_lone_rigs(connection: sqlite3.Connection, path: Path) -> None:
    """Refuse a database that has rigs or frames, but no images."""
    for table in ("rigs", "frames"):
        if columns(connection, table) and has_rows(connection, table):
            raise DatabaseError(
                f"{path} has {table} but no images: import its images first, or use a new database"
            )


def _insert_images(
    connection: sqlite3.Connection, camera_of: Mapping[str, pycolmap.Camera]
) -> dict[str, int]:
    """Insert images by name, each with its camera; returns the image id of each name."""
    rows = list({id(camera): camera for camera in camera_of.values()}.values())
    row_of = {id(camera): row for row, camera in enumerate(rows)}
    (first_id,) = connection.execute(
        "SELECT COALESCE(MAX(camera_id), 0) + 1 FROM cameras"
    ).fetchone()
    connection.executemany(
        "INSERT INTO cameras (camera_id, model, width, height, params, prior_focal_length) "
        "VALUES (?, ?, ?, ?, ?, ?)",
        (
            (
                first_id + i,
                int(camera.model.value),
                int(camera.width),
                int(camera.height),
                np.asarray(camera.params, dtype="<f8").tobytes(),
                int(camera.has_prior_focal_length),
            )
            for i, camera in enumerate(rows)
        ),
    )
    (first_image_id,) = connection.execute(
        "SELECT COALESCE(MAX(image_id), 0) + 1 FROM images"
    ).fetchone()
    connection.executemany(
        "INSERT INTO images (image_id, name, camera_id) VALUES (?, ?, ?)",
        (
            (first_image_id + i, name, first_id + row_of[id(camera)])
            for i, (name, camera) in enumerate(camera_of.items())
        ),
    )
    return {name: first_image_id + i for i, name in enumerate(camera_of)}


def _check_nothing_lost(
    connection: sqlite3.Connection, path: Path, name_of_id: dict[int, str]
) -> None:
    """Refuse images that already have keypoints or matches."""
    remedy = "use a database without them, or on_existing append or replace"
    for (image_id,) in connection.execute("SELECT image_id FROM keypoints WHERE rows > 0"):
        if image_id in name_of_id:
            raise DatabaseError(
                f"{path} already has keypoints of image {name_of_id[image_id]!r}: {remedy}"
            )
    for (pair_id,) in connection.execute(
        "SELECT pair_id FROM matches WHERE rows > 0 "
        "UNION SELECT pair_id FROM two_view_geometries WHERE rows > 0"
    ):
        for image_id in image_ids_from_pair_id(pair_id):
            if image_id in name_of_id:
                raise DatabaseError(
                    f"{path} already has matches of image {name_of_id[image_id]!r}: {remedy}"
                )


def _clear_images(connection: sqlite3.Connection, image_ids: set[int]) -> None:
    """Remove all features and matches of the given images."""
    for table in ("keypoints", "descriptors"):
        if columns(connection, table):
            connection.executemany(
                f"DELETE FROM {table} WHERE image_id = ?", ((i,) for i in sorted(image_ids))
            )
    for table in ("matches", "two_view_geometries"):
        pair_ids = connection.execute(f"SELECT pair_id FROM {table}").fetchall()
        connection.executemany(
            f"DELETE FROM {table} WHERE pair_id = ?",
            (row for row in pair_ids if not image_ids.isdisjoint(image_ids_from_pair_id(row[0]))),
        )


def _append_keypoints(
    connection: sqlite3.Connection,
    path: Path,
    image_ids: Sequence[int],
    keypoints: Sequence[ImageKeypoints],
) -> list[int]:
    """Append keypoints to existing ones; returns the index of each image's first new keypoint."""
    firsts = [0] * len(image_ids)
    all_present = any(len(k.xy) for k in keypoints)
    for index in np.argsort(np.asarray(image_ids, dtype=np.int64)):
        image_id, xy = image_ids[index], keypoints[index].xy.astype("<f4")
        present = read_keypoints(connection, path, image_id)
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
            f"{path} already has the same keypoints, from an earlier run: there is nothing to "
            "append, or use on_existing replace to write them again"
        )
    return firsts


def _append_descriptors(
    connection: sqlite3.Connection, image_id: int, num_present: int, num_new: int
) -> None:
    """Append zero descriptors, if the image has descriptors, to match its number of keypoints.

    COLMAP's guided matching and vocabulary trees refuse images whose numbers of descriptors and
    keypoints differ. A zero descriptor never matches: it is orthogonal to every other descriptor,
    beyond the distance threshold, and equally distant from all zero descriptors, so it fails the
    ratio test.
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


def _order_pairs(image_ids: Sequence[int], pairs: NDArray[np.int32]) -> list[tuple[int, int, bool]]:
    """(pair id, index of the pair, whether its images are swapped), ordered by pair id.

    COLMAP stores the column of the smaller image id first.
    """
    rows = []
    for index, (i, j) in enumerate(pairs):
        ids = image_ids[i], image_ids[j]
        rows.append((pair_id_from_image_ids(*ids), index, ids[0] > ids[1]))
    rows.sort()
    if len({row[0] for row in rows}) != len(rows):
        raise ValueError("a pair of images is given twice")
    return rows


def _append_pairs(
    connection: sqlite3.Connection,
    path: Path,
    order: Sequence[tuple[int, int, bool]],
    *,
    shifts: Sequence[NDArray[np.uint32]],
    matches: Sequence[NDArray[np.uint32]],
    geometries: Sequence[TwoViewGeometry],
) -> None:
    """Write pairs; the matches and inliers of existing pairs are extended.

    Args:
        connection: the database.
        path: its path, for messages.
        order: the ids and indices of the pairs, see `_order_pairs`.
        shifts: for each pair, uint32 [2] index of the first new keypoint of its two images.
        matches: for each pair, uint32 [n, 2] matches, counted from these first keypoints.
        geometries: for each pair, its geometry, with inliers counted in the same way.
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
            existing_matches, existing_inliers, existing_support = _read_pair(
                connection, path, pair_id
            )
            pair_matches = np.concatenate([existing_matches, pair_matches])
            keeps_models = len(existing_inliers) > 0 and existing_support >= len(inliers)
            inliers = np.concatenate([existing_inliers, inliers])
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
    """A pair's matches, its inliers, and the number of inliers that support its models.

    No inliers support a geometry that was never estimated, as importers write it, or one with
    several models. The inliers of a degenerate geometry or a watermark are discarded.
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


def _float_blob(values: Floats | None) -> bytes | None:
    return None if values is None else np.asarray(values, dtype="<f8").tobytes()


def _swap_images(geometry: TwoViewGeometry) -> TwoViewGeometry:
    """The geometry with its models inverted, from the second image to the first.

    The columns of `inlier_matches` are not swapped.
    """
    qvec = tvec = H = None
    if geometry.qvec is not None and geometry.tvec is not None:
        rotation = pycolmap.Rotation3d(np.roll(geometry.qvec, -1))
        inverse = pycolmap.Rigid3d(rotation, geometry.tvec).inverse()
        qvec, tvec = np.roll(inverse.rotation.quat, 1), inverse.translation
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


def _complete_frames(connection: sqlite3.Connection, path: Path) -> None:
    """Give every image a frame if the database has rigs or frames.

    COLMAP creates missing rigs and frames only if a database has none at all.
    """
    tables = ("rigs", "rig_sensors", "frames", "frame_data")
    if not all(columns(connection, table) for table in tables):
        return
    if not (has_rows(connection, "rigs") or has_rows(connection, "frames")):
        return
    rig_of_camera = dict(
        connection.execute(
            "SELECT ref_sensor_id, rig_id FROM rigs WHERE ref_sensor_type = ?", (_CAMERA_SENSOR,)
        ).fetchall()
    )
    in_larger_rig = {
        row[0]
        for row in connection.execute(
            "SELECT sensor_id FROM rig_sensors WHERE sensor_type = ?", (_CAMERA_SENSOR,)
        )
    }
    unframed = connection.execute(
        "SELECT image_id, name, camera_id FROM images WHERE image_id NOT IN "
        "(SELECT data_id FROM frame_data WHERE sensor_type = ?) ORDER BY image_id",
        (_CAMERA_SENSOR,),
    ).fetchall()
    for image_id, name, camera_id in unframed:
        if camera_id not in rig_of_camera:
            if camera_id in in_larger_rig:
                raise DatabaseError(
                    f"{path}: image {name!r} has no frame, and its camera is one of several in a "
                    "rig: run COLMAP's rig_configurator on the database first"
                )
            rig_of_camera[camera_id] = connection.execute(
                "INSERT INTO rigs (ref_sensor_id, ref_sensor_type) VALUES (?, ?)",
                (camera_id, _CAMERA_SENSOR),
            ).lastrowid
        frame_id = connection.execute(
            "INSERT INTO frames (rig_id) VALUES (?)", (rig_of_camera[camera_id],)
        ).lastrowid
        connection.execute(
            "INSERT INTO frame_data (frame_id, data_id, sensor_id, sensor_type) "
            "VALUES (?, ?, ?, ?)",
            (frame_id, image_id, camera_id, _CAMERA_SENSOR),
        )


def _write_places(connection: sqlite3.Connection, image_ids: Sequence[int], places: Floats) -> None:
    """Write pose priors for images that have none.

    A database of COLMAP 3.8 or 3.9 also gets them in the columns that these versions read.

    Args:
        connection: the open database.
        image_ids: the images.
        places: float64 [n, 3] latitude and longitude in degrees and altitude in metres; NaN where
            unknown.
    """
    known = [(i, p) for i, p in zip(image_ids, places, strict=True) if np.isfinite(p).all()]
    if not known:
        return
    if not columns(connection, "pose_priors"):
        connection.execute(_POSE_PRIORS)
    if "pose_prior_id" in columns(connection, "pose_priors"):
        _write_newer(connection, known)
    else:
        connection.executemany(
            "INSERT OR IGNORE INTO pose_priors (image_id, position, coordinate_system, "
            "position_covariance) VALUES (?, ?, ?, ?)",
            ((i, p.astype("<f8").tobytes(), WGS84, _UNKNOWN.tobytes()) for i, p in known),
        )
    if "prior_tx" in columns(connection, "images"):
        connection.executemany(
            "UPDATE images SET prior_tx = ?, prior_ty = ?, prior_tz = ? "
            "WHERE image_id = ? AND prior_tx IS NULL",
            ((*map(float, p), i) for i, p in known),
        )


def _write_newer(connection: sqlite3.Connection, known: Sequence[tuple[int, Floats]]) -> None:
    """Write pose priors in the layout of COLMAP 4.0 and later."""
    camera_of = dict(connection.execute("SELECT image_id, camera_id FROM images").fetchall())
    connection.executemany(
        "INSERT OR IGNORE INTO pose_priors (corr_data_id, corr_sensor_id, corr_sensor_type, "
        "position, position_covariance, gravity, coordinate_system) VALUES (?, ?, ?, ?, ?, ?, ?)",
        (
            (
                i,
                camera_of[i],
                _CAMERA_SENSOR,
                p.astype("<f8").tobytes(),
                _UNKNOWN.tobytes(),
                _UNKNOWN[:3].tobytes(),
                WGS84,
            )
            for i, p in known
        ),
    )

"""The layout of a COLMAP database: its tables, columns and value ranges, and a check for them.

A new database has the layout of COLMAP 3.8, the oldest version still in use. Later versions read
and migrate it; older versions cannot read the layouts of later ones.
"""

from __future__ import annotations

import sqlite3
from pathlib import Path

from colmap_av1.errors import DatabaseError

# COLMAP's kMaxNumImages: image ids stay below it, and pair ids are multiples of it plus an id.
MAX_NUM_IMAGES = 2147483647
USER_VERSION = 3800

SCHEMA = (
    "CREATE TABLE cameras (camera_id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, "
    "model INTEGER NOT NULL, width INTEGER NOT NULL, height INTEGER NOT NULL, params BLOB, "
    "prior_focal_length INTEGER NOT NULL)",
    "CREATE TABLE images (image_id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, "
    "name TEXT NOT NULL UNIQUE, camera_id INTEGER NOT NULL, "
    "prior_qw REAL, prior_qx REAL, prior_qy REAL, prior_qz REAL, "
    "prior_tx REAL, prior_ty REAL, prior_tz REAL, "
    f"CONSTRAINT image_id_check CHECK(image_id >= 0 and image_id < {MAX_NUM_IMAGES}), "
    "FOREIGN KEY(camera_id) REFERENCES cameras(camera_id))",
    "CREATE UNIQUE INDEX index_name ON images(name)",
    "CREATE TABLE keypoints (image_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL, "
    "cols INTEGER NOT NULL, data BLOB, "
    "FOREIGN KEY(image_id) REFERENCES images(image_id) ON DELETE CASCADE)",
    "CREATE TABLE descriptors (image_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL, "
    "cols INTEGER NOT NULL, data BLOB, "
    "FOREIGN KEY(image_id) REFERENCES images(image_id) ON DELETE CASCADE)",
    "CREATE TABLE matches (pair_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL, "
    "cols INTEGER NOT NULL, data BLOB)",
    "CREATE TABLE two_view_geometries (pair_id INTEGER PRIMARY KEY NOT NULL, "
    "rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB, config INTEGER NOT NULL, "
    "F BLOB, E BLOB, H BLOB, qvec BLOB, tvec BLOB)",
)

# Type or range of each column that is read. SQLite itself stores any value in any column.
_COUNT = (0, (1 << 31) - 1)
_ID = (0, (1 << 32) - 2)  # COLMAP's ids are uint32; the largest value means "invalid".
_ANY = (-(1 << 31), (1 << 31) - 1)
_IMAGE_ID = (0, MAX_NUM_IMAGES - 1)
_PAIR_ID = (0, MAX_NUM_IMAGES * MAX_NUM_IMAGES - 1)
_SIZE = (0, (1 << 63) - 1)
_TEXT, _BLOB = "text", "blob"  # A blob may be NULL.
_Kind = tuple[int, int] | str

# The first column of each table is its key. A COLMAP database has all required tables and columns.
# Optional columns are checked if they are present.
_REQUIRED: dict[str, dict[str, _Kind]] = {
    "cameras": {
        "camera_id": _ID,
        "model": _ANY,
        "width": _SIZE,
        "height": _SIZE,
        "params": _BLOB,
        "prior_focal_length": _ANY,
    },
    "images": {"image_id": _IMAGE_ID, "name": _TEXT, "camera_id": _ID},
    "keypoints": {"image_id": _IMAGE_ID, "rows": _COUNT, "cols": _COUNT, "data": _BLOB},
    "matches": {"pair_id": _PAIR_ID, "rows": _COUNT, "cols": _COUNT, "data": _BLOB},
    "two_view_geometries": {
        "pair_id": _PAIR_ID,
        "rows": _COUNT,
        "cols": _COUNT,
        "data": _BLOB,
        "config": _ANY,
    },
}
_OPTIONAL: dict[str, dict[str, _Kind]] = {
    "descriptors": {"image_id": _IMAGE_ID, "rows": _COUNT, "cols": _COUNT, "data": _BLOB},
    "two_view_geometries": dict.fromkeys(("F", "E", "H", "qvec", "tvec"), _BLOB),
    "pose_priors": {},
    "rigs": {"rig_id": _ID, "ref_sensor_id": _ID, "ref_sensor_type": _ANY},
    "rig_sensors": {"rig_id": _ID, "sensor_id": _ID, "sensor_type": _ANY},
    "frames": {"frame_id": _ID, "rig_id": _ID},
    "frame_data": {"frame_id": _ID, "data_id": _SIZE, "sensor_id": _ID, "sensor_type": _ANY},
}


def columns(connection: sqlite3.Connection, table: str) -> set[str]:
    """Names of a table's columns; empty if the file has no such table."""
    return {row[1] for row in connection.execute(f"PRAGMA table_info({table})")}


def has_rows(connection: sqlite3.Connection, table: str) -> bool:
    """Whether a table has at least one row."""
    return connection.execute(f"SELECT 1 FROM {table} LIMIT 1").fetchone() is not None


def check_layout(connection: sqlite3.Connection, path: Path) -> None:
    """Refuse a file that is not a COLMAP database, or that has damaged rows.

    Afterwards every value that this package reads has its column's type, and counts and ids
    are in their ranges. Blobs are not read, so their lengths may still contradict the counts.

    Args:
        connection: the open file.
        path: its path, for messages.

    Raises:
        DatabaseError: the file is not a COLMAP database, has triggers, has a view instead of a
            table, or has a damaged row.
    """
    try:
        _check_tables(connection, path)
        for table in {**_REQUIRED, **_OPTIONAL}:
            _check_values(connection, path, table)
        _check_names(connection, path)
    except UnicodeDecodeError as error:  # SQLite's text for a damaged layout may be invalid.
        raise DatabaseError(
            f"{path}: its layout is damaged: restore it from a copy, or give another path"
        ) from error


def _check_tables(connection: sqlite3.Connection, path: Path) -> None:
    no_database = f"{path}: it is not a COLMAP database"
    for table in {**_REQUIRED, **_OPTIONAL}:
        required = _REQUIRED.get(table, {})
        # A virtual table has root page 0.
        made = connection.execute(
            "SELECT type = 'table' AND rootpage > 0 FROM sqlite_master WHERE type <> 'trigger' "
            "AND LOWER(name) = ?",
            (table,),
        ).fetchall()
        present = {row[1]: row[5] for row in connection.execute(f"PRAGMA table_info({table})")}
        missing = sorted(required.keys() - present.keys())
        if missing:
            what = "table" if len(missing) == len(required) else f"{missing[0]!r} in table"
            raise DatabaseError(f"{no_database} (no {what} {table!r}): give another path")
        if made not in ([], [(1,)]):
            raise DatabaseError(f"{no_database} ({table!r} is not a table): give another path")
        if required and present[next(iter(required))] != 1:
            raise DatabaseError(
                f"{no_database} ({next(iter(required))!r} is not the key of table {table!r}): "
                "give another path"
            )
    if connection.execute("SELECT 1 FROM sqlite_master WHERE type = 'trigger'").fetchone():
        raise DatabaseError(
            f"{path}: has triggers, which COLMAP never creates and which could change written "
            "rows: drop them, or give another path"
        )


def _check_values(connection: sqlite3.Connection, path: Path, table: str) -> None:
    """Refuse a table with a value that its column cannot hold."""
    present = columns(connection, table)
    kinds = _REQUIRED.get(table, {}) | _OPTIONAL.get(table, {})
    faults = [
        f"WHEN NOT ({_holds(column, kind)}) THEN '{column}'"
        for column, kind in kinds.items()
        if column in present
    ]
    if not faults:
        return
    key = next(iter(kinds))
    row = connection.execute(
        f"SELECT CASE {' '.join(faults)} END AS fault, CAST({key} AS TEXT) FROM {table} "
        "NOT INDEXED WHERE fault IS NOT NULL LIMIT 1"
    ).fetchone()
    if row is not None:
        raise DatabaseError(
            f"{path}: table '{table}' is damaged ({row[0]!r} of row {row[1]!r} is "
            "invalid): restore the file from a copy"
        )


def _holds(column: str, kind: _Kind) -> str:
    """SQL expression that tests whether a column's value has the given type or range."""
    if kind == _BLOB:
        return f"TYPEOF({column}) IN ('blob', 'null')"
    if isinstance(kind, str):
        return f"TYPEOF({column}) = '{kind}'"
    return f"TYPEOF({column}) = 'integer' AND {column} BETWEEN {kind[0]} AND {kind[1]}"


def _check_names(connection: sqlite3.Connection, path: Path) -> None:
    """Refuse images with the same name, which are possible if the index of names is damaged."""
    row = connection.execute(
        "SELECT name FROM images NOT INDEXED GROUP BY name HAVING COUNT(*) > 1 LIMIT 1"
    ).fetchone()
    if row is not None:
        raise DatabaseError(f"{path}: lists two images {row[0]!r}: restore the file from a copy")

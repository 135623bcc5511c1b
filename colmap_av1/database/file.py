"""The file of a COLMAP database: its layout, opening it, writing all of it or nothing.

A new file has the layout of COLMAP 3.8, the oldest still in use: later versions read it and
migrate it, while older ones refuse what later ones make. SQLite is used directly, because
opening a file with pycolmap migrates it.
"""

from __future__ import annotations

import contextlib
import glob
import secrets
import sqlite3
from collections.abc import Callable, Iterator
from pathlib import Path

from colmap_av1.errors import DatabaseError, cannot_write

# COLMAP's kMaxNumImages: image ids stay below it, and it spreads pair ids.
MAX_NUM_IMAGES = 2147483647

_USER_VERSION = 3800
# Seconds to wait for another writer: one that is only closing a file is soon done.
_BUSY_TIMEOUT = 2.0

_SCHEMA = (
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

# Columns without which a file is not a COLMAP database; others are written where present.
_REQUIRED_COLUMNS = {
    "cameras": {"camera_id", "model", "width", "height", "params", "prior_focal_length"},
    "images": {"image_id", "name", "camera_id"},
    "keypoints": {"image_id", "rows", "cols", "data"},
    "matches": {"pair_id", "rows", "cols", "data"},
    "two_view_geometries": {"pair_id", "rows", "cols", "data", "config"},
}


def is_new(path: Path) -> bool:
    """Whether the file is absent or empty, so that making it loses nothing.

    Raises:
        DatabaseError: it can be no database: its folder is missing, or it is no plain file.
    """
    if path.is_dir():
        raise DatabaseError(f"{path} is a folder: give the path of a database file")
    target = _target(path)
    if path.exists() and path.stat().st_size > 0:
        return False
    if not target.parent.is_dir():
        raise DatabaseError(f"{path}: the folder does not exist: make it first")
    for suffix in ("-journal", "-wal"):
        # SQLite would replay such a file into whatever database appears beside it.
        leftover = path.with_name(path.name + suffix)
        if leftover.exists():
            raise DatabaseError(f"{leftover} is left from another database: remove it first")
    return True


def _target(path: Path) -> Path:
    """The file that a path, which may be a link, stands for.

    A new one would take the place of a device, such as /dev/null, and a pipe has no end.
    """
    if path.exists() and not path.is_file():
        raise DatabaseError(f"{path} is not a regular file: give the path of a database file")
    try:
        return path.resolve()
    except (OSError, RuntimeError) as error:
        raise DatabaseError(f"{path} is a link that leads nowhere: give another path") from error


def open_database(
    path: Path, named: Path | None = None
) -> contextlib.AbstractContextManager[sqlite3.Connection]:
    """Open an existing file, to read or write it, and close it at the end.

    Args:
        path: file to open.
        named: path that messages name, where it differs.
    """
    return _connect(path, "mode=rw", named if named is not None else path)


def open_unaltered(path: Path) -> contextlib.AbstractContextManager[sqlite3.Connection]:
    """Open an existing file to read it, without leaving a trace in it or beside it."""
    # Without a log beside it the file is all there is, and SQLite needs no lock of its own.
    target = _target(path)
    logs = [target.with_name(target.name + end) for end in ("-journal", "-wal")]
    busy = any(log.exists() and log.stat().st_size > 0 for log in logs)
    return _connect(path, "mode=ro" if busy else "mode=ro&immutable=1", path)


def copy_database(path: Path, copy: Path) -> None:
    """Copy a database with everything committed to it, without a trace in it or beside it.

    Args:
        path: the database.
        copy: file that is made.
    """
    with (
        open_unaltered(path) as source,
        contextlib.closing(sqlite3.connect(copy)) as target,
    ):
        source.backup(target)


@contextlib.contextmanager
def _connect(path: Path, how: str, named: Path) -> Iterator[sqlite3.Connection]:
    """Open a file with the given parameters of SQLite's URI; its errors become ours."""
    try:
        with contextlib.closing(
            sqlite3.connect(
                f"{_target(path).as_uri()}?{how}",
                uri=True,
                timeout=_BUSY_TIMEOUT,
                isolation_level=None,
            )
        ) as connection:
            yield connection
    except sqlite3.Error as error:
        raise DatabaseError(_explain(named, error, reading="mode=ro" in how)) from error


def _explain(path: Path, error: sqlite3.Error, reading: bool) -> str:
    text = str(error)
    if reading and "readonly" in text:
        return (
            f"{path}: a write to it was interrupted: open it once with COLMAP or the sqlite3 "
            "command, which undoes that write, and run again"
        )
    causes = {
        "locked": "it is in use by another process: wait until that is done, or end it",
        "busy": "it is in use by another process: wait until that is done, or end it",
        "not a database": "it is not a COLMAP database: give another path",
        "malformed": "it is damaged: restore it from a copy, or give another path",
        "full": "the disk is full: free some space",
        "disk I/O error": "it cannot be read or written: free some space, or use another disk",
        "readonly": "it may not be written: change its permissions, or give another path",
        "unable to open": "it cannot be opened: check the path and its permissions",
    }
    for sign, cause in causes.items():
        if sign in text:
            return f"{path}: {cause}"
    return f"{path}: SQLite refuses: {text}: restore it from a copy, or give another path"


def write_new(path: Path, fill: Callable[[sqlite3.Connection], None]) -> None:
    """Make a database under another name in the same folder, then give it its own."""
    target = _target(path)
    _remove_leftovers(target)
    partial = target.with_name(f".{target.name}.{secrets.token_hex(8)}.partial")
    try:
        partial.touch(exist_ok=False)
        with open_database(partial, named=path) as connection:
            # The file is thrown away on any failure: nothing needs to be rolled back.
            connection.execute("PRAGMA journal_mode = OFF")
            connection.execute("BEGIN EXCLUSIVE")
            if not partial.exists():  # taken for a leftover before it was locked
                raise DatabaseError(f"{path} is made by another process: run again")
            for statement in _SCHEMA:
                connection.execute(statement)
            connection.execute(f"PRAGMA user_version = {_USER_VERSION}")
            fill(connection)
            connection.execute("COMMIT")
        if not is_new(path):
            raise DatabaseError(f"{path} was made by another process meanwhile: run again")
        partial.replace(target)
    except OSError as error:
        raise DatabaseError(cannot_write(path, error)) from error
    finally:
        partial.unlink(missing_ok=True)


def _remove_leftovers(target: Path) -> None:
    """Remove what killed processes left of this file while they made it.

    A process that still makes it holds a lock on its own.
    """
    pattern = f".{glob.escape(target.name)}.{'[0-9a-f]' * 16}.partial"
    for name in glob.glob(pattern, root_dir=target.parent):
        leftover = target.parent / name
        with (
            contextlib.suppress(OSError, sqlite3.Error),
            contextlib.closing(
                sqlite3.connect(f"{leftover.as_uri()}?mode=rw", uri=True, timeout=0)
            ) as connection,
        ):
            try:
                connection.execute("BEGIN EXCLUSIVE")
            except sqlite3.DatabaseError as error:
                if "locked" in str(error):
                    continue
            leftover.unlink()


def write_existing(path: Path, fill: Callable[[sqlite3.Connection], None]) -> None:
    """Add to a database in one transaction."""
    with open_database(path) as connection:
        connection.execute("BEGIN IMMEDIATE")
        try:
            check_layout(connection, path)
            fill(connection)
            connection.execute("COMMIT")
        except BaseException:
            if connection.in_transaction:
                connection.execute("ROLLBACK")
            raise


def columns(connection: sqlite3.Connection, table: str) -> set[str]:
    """Names of a table's columns; none where the file has no such table."""
    return {row[1] for row in connection.execute(f"PRAGMA table_info({table})")}


def has_rows(connection: sqlite3.Connection, table: str) -> bool:
    """Whether a table of the file has any row."""
    return connection.execute(f"SELECT 1 FROM {table} LIMIT 1").fetchone() is not None


def check_layout(connection: sqlite3.Connection, path: Path) -> None:
    """Refuse a file that is not a COLMAP database."""
    for table, required in _REQUIRED_COLUMNS.items():
        missing = required - columns(connection, table)
        if missing:
            what = "table" if missing == required else f"{sorted(missing)[0]!r} in table"
            raise DatabaseError(
                f"{path}: it is not a COLMAP database (no {what} {table!r}): give another path"
            )

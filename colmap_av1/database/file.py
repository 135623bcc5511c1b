"""The file of a COLMAP database: opening it, writing all of it or nothing.

SQLite is used directly, because opening a file with pycolmap migrates it. A file may come from
anywhere: it is opened so that nothing in it is run, and read only if it has COLMAP's layout.
"""

from __future__ import annotations

import contextlib
import itertools
import sqlite3
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from colmap_av1.database.layout import SCHEMA, USER_VERSION, check_layout
from colmap_av1.errors import DatabaseError, cannot_write
from colmap_av1.util.files import remove_leftovers, whole_file

# Seconds to wait for another writer: one that is only closing a file is soon done.
_BUSY_TIMEOUT = 2.0
# Instructions of SQLite's virtual machine that reading a file may take: so many, and so many for
# each of its bytes, of which `check` takes 3 where all rows are empty and less elsewhere. Only
# pages that refer to each other over and over take more.
_BUDGET, _BUDGET_PER_BYTE = 2_000_000, 20
_BUDGET_STEP = 10_000


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
    for leftover in _logs(path):
        # SQLite would replay such a file into whatever database appears beside it.
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


def open_database(path: Path) -> contextlib.AbstractContextManager[sqlite3.Connection]:
    """Open an existing COLMAP database and close it at the end.

    Raises:
        DatabaseError: it is no COLMAP database, is damaged, or SQLite fails in the body.
    """
    return _open_checked(path, "mode=rw")


def open_unaltered(path: Path) -> contextlib.AbstractContextManager[sqlite3.Connection]:
    """As `open_database`, to read it without leaving a trace in it or beside it."""
    # Without a log beside it the file is all there is, and SQLite needs no lock of its own.
    busy = any(log.exists() and log.stat().st_size > 0 for log in _logs(_target(path)))
    return _open_checked(path, "mode=ro" if busy else "mode=ro&immutable=1")


@contextlib.contextmanager
def _open_checked(path: Path, how: str) -> Iterator[sqlite3.Connection]:
    with _connect(path, how, path) as connection:
        check_layout(connection, path)
        yield connection


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


def _logs(target: Path) -> list[Path]:
    return [target.with_name(target.name + end) for end in ("-journal", "-wal")]


@contextlib.contextmanager
def _connect(path: Path, how: str, named: Path) -> Iterator[sqlite3.Connection]:
    """Open a file with the given parameters of SQLite's URI; its errors become ours."""
    target = _target(path)
    try:
        with contextlib.closing(
            sqlite3.connect(
                f"{target.as_uri()}?{how}",
                uri=True,
                timeout=_BUSY_TIMEOUT,
                isolation_level=None,
            )
        ) as connection:
            _run_nothing(connection)
            _bound_reading(connection, target)
            yield connection
    except sqlite3.Error as error:
        raise DatabaseError(_explain(named, error, reading="mode=ro" in how)) from error


def _run_nothing(connection: sqlite3.Connection) -> None:
    """Let SQLite run nothing that the file's layout asks for; where it can, no triggers and views.

    What it cannot forbid, `check_layout` refuses.
    """
    connection.execute("PRAGMA trusted_schema = OFF")
    connection.execute("PRAGMA cell_size_check = ON")
    if sys.version_info >= (3, 12):
        connection.setconfig(sqlite3.SQLITE_DBCONFIG_DEFENSIVE, True)
        connection.setconfig(sqlite3.SQLITE_DBCONFIG_ENABLE_TRIGGER, False)
        connection.setconfig(sqlite3.SQLITE_DBCONFIG_ENABLE_VIEW, False)


def _bound_reading(connection: sqlite3.Connection, target: Path) -> None:
    """End what takes longer than a sound file can: SQLite then says that it was interrupted."""
    size = sum(file.stat().st_size for file in (target, *_logs(target)) if file.exists())
    steps = (_BUDGET + _BUDGET_PER_BYTE * size) // _BUDGET_STEP
    # No Python runs in this, so signals wait for the statement's end: here they would be lost.
    ends = itertools.chain(itertools.repeat(0, steps), itertools.repeat(1))
    connection.set_progress_handler(ends.__next__, _BUDGET_STEP)


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
        "interrupted": "it is damaged, reading it comes to no end: restore it from a copy",
        "decode": "it has text that is not UTF-8: rename its images so, or give another path",
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
    remove_leftovers(target.parent, target.name)
    try:
        with whole_file(target) as partial:
            with _connect(partial, "mode=rw", path) as connection:
                connection.set_progress_handler(None, 0)  # there is nothing to read yet
                # The file is thrown away on any failure: nothing needs to be rolled back.
                connection.execute("PRAGMA journal_mode = OFF")
                connection.execute("BEGIN EXCLUSIVE")
                for statement in SCHEMA:
                    connection.execute(statement)
                connection.execute(f"PRAGMA user_version = {USER_VERSION}")
                fill(connection)
                connection.execute("COMMIT")
            if not is_new(path):
                raise DatabaseError(f"{path} was made by another process meanwhile: run again")
    except OSError as error:
        raise DatabaseError(cannot_write(path, error)) from error


def write_existing(path: Path, fill: Callable[[sqlite3.Connection], None]) -> None:
    """Add to a database in one transaction."""
    with _connect(path, "mode=rw", path) as connection:
        connection.execute("BEGIN IMMEDIATE")
        try:
            check_layout(connection, path)
            connection.set_progress_handler(None, 0)  # what is written has no bound
            fill(connection)
            connection.execute("COMMIT")
        except BaseException:
            if connection.in_transaction:
                connection.execute("ROLLBACK")
            raise

"""Opening a COLMAP database safely, and writing to it all or nothing.

SQLite is used directly because pycolmap migrates a database when it opens it. A database may come
from an untrusted source: SQL code stored in it is never run, and it is read only if it has COLMAP's
layout.
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
from colmap_av1.util.memory import check_memory

# Seconds to wait for another writer. A process that is only closing the file finishes sooner.
_BUSY_TIMEOUT = 2.0
# Limit on the instructions of SQLite's virtual machine that reading a file may take: a constant,
# plus a number for each byte of the file. `check` takes at most 3 for each byte. Only a damaged
# file, whose pages refer to each other in a cycle, takes more.
_BUDGET, _BUDGET_PER_BYTE = 2_000_000, 20
_BUDGET_STEP = 10_000


def is_new(path: Path) -> bool:
    """Whether the file is absent or empty, so that creating a database there loses nothing.

    Raises:
        DatabaseError: the path cannot be a database: its folder is missing, it is not a regular
            file, or the journal of another database lies next to it.
    """
    if path.is_dir():
        raise DatabaseError(f"{path} is a folder: give the path of a database file")
    target = _target(path)
    if path.exists() and path.stat().st_size > 0:
        return False
    if not target.parent.is_dir():
        raise DatabaseError(f"{path}: the folder does not exist: create it first")
    for leftover in _logs(target):
        # SQLite would replay such a journal into a new database of the same name.
        if leftover.exists():
            raise DatabaseError(f"{leftover} is left from another database: remove it first")
    return True


def _target(path: Path) -> Path:
    """The file that a path refers to, with links resolved.

    Devices and pipes are refused: a new file would replace a device such as /dev/null, and reading
    a pipe may never end.
    """
    if path.exists() and not path.is_file():
        raise DatabaseError(f"{path} is not a regular file: give the path of a database file")
    try:
        return path.resolve()
    except (OSError, RuntimeError) as error:
        raise DatabaseError(f"{path} is a broken link: give another path") from error


@contextlib.contextmanager
def open_unaltered(path: Path) -> Iterator[sqlite3.Connection]:
    """Open an existing COLMAP database for reading, without changing the file or its folder.

    Raises:
        DatabaseError: the file is not a COLMAP database or is damaged, or SQLite fails in the body
            of the `with` statement.
    """
    # Without a journal the file is complete, so SQLite can read it without a lock file.
    busy = any(log.exists() and log.stat().st_size > 0 for log in _logs(_target(path)))
    with _connect(path, "mode=ro" if busy else "mode=ro&immutable=1", path) as connection:
        check_layout(connection, path)
        yield connection


def copy_database(path: Path, copy: Path) -> None:
    """Copy a database with all committed transactions, without changing the original.

    Args:
        path: the database.
        copy: the file to create.
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
    """Open a file with the given SQLite URI parameters, and translate SQLite's errors."""
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
    except MemoryError as error:
        if error.args:  # not of SQLite
            raise
        check_memory(error)
        raise DatabaseError(
            f"{named}: it is damaged: restore it from a copy, or give another path"
        ) from error


def _run_nothing(connection: sqlite3.Connection) -> None:
    """Keep SQLite from running code stored in the file, such as triggers and views.

    Older versions of Python cannot turn these off; `check_layout` refuses files that have them.
    """
    connection.execute("PRAGMA trusted_schema = OFF")
    connection.execute("PRAGMA cell_size_check = ON")
    if sys.version_info >= (3, 12):
        connection.setconfig(sqlite3.SQLITE_DBCONFIG_DEFENSIVE, True)
        connection.setconfig(sqlite3.SQLITE_DBCONFIG_ENABLE_TRIGGER, False)
        connection.setconfig(sqlite3.SQLITE_DBCONFIG_ENABLE_VIEW, False)


def _bound_reading(connection: sqlite3.Connection, target: Path) -> None:
    """Interrupt a statement that takes longer than any valid file of this size needs."""
    size = sum(file.stat().st_size for file in (target, *_logs(target)) if file.exists())
    steps = (_BUDGET + _BUDGET_PER_BYTE * size) // _BUDGET_STEP
    # A C-level iterator as the handler: Python code here could swallow a signal's exception.
    ends = itertools.chain(itertools.repeat(0, steps), itertools.repeat(1))
    connection.set_progress_handler(ends.__next__, _BUDGET_STEP)


def _explain(path: Path, error: sqlite3.Error, reading: bool) -> str:
    text = str(error)
    if reading and "readonly" in text:
        return (
            f"{path}: a write to it was interrupted: open it once with COLMAP or the sqlite3 "
            "command to roll the write back, then run again"
        )
    causes = {
        "locked": "it is in use by another process: wait until that process ends, or end it",
        "busy": "it is in use by another process: wait until that process ends, or end it",
        "interrupted": "it is damaged, reading it never ends: restore it from a copy",
        "decode": "it has text that is not UTF-8: rename its images, or give another path",
        "not a database": "it is not a COLMAP database: give another path",
        "malformed": "it is damaged: restore it from a copy, or give another path",
        "full": "the disk is full: free some space",
        "disk I/O error": "it cannot be read or written: free some space, or use another disk",
        "readonly": "it is read-only: change its permissions, or give another path",
        "unable to open": "it cannot be opened: check the path and its permissions",
    }
    for sign, cause in causes.items():
        if sign in text:
            return f"{path}: {cause}"
    return f"{path}: SQLite reports: {text}: restore it from a copy, or give another path"


def write_new(path: Path, fill: Callable[[sqlite3.Connection], None]) -> None:
    """Create a database under a temporary name in the same folder, then rename it."""
    target = _target(path)
    remove_leftovers(target.parent, target.name)
    try:
        with whole_file(target) as partial:
            with _connect(partial, "mode=rw", path) as connection:
                connection.set_progress_handler(None, 0)  # The limit applies to reading only.
                # The file is discarded on any failure, so a rollback journal is not needed.
                connection.execute("PRAGMA journal_mode = OFF")
                connection.execute("BEGIN EXCLUSIVE")
                for statement in SCHEMA:
                    connection.execute(statement)
                connection.execute(f"PRAGMA user_version = {USER_VERSION}")
                fill(connection)
                connection.execute("COMMIT")
            if not is_new(path):
                raise DatabaseError(f"{path} was created by another process meanwhile: run again")
    except OSError as error:
        raise DatabaseError(cannot_write(path, error)) from error


def write_existing(path: Path, fill: Callable[[sqlite3.Connection], None]) -> None:
    """Add to a database in one transaction."""
    with _connect(path, "mode=rw", path) as connection:
        connection.execute("BEGIN IMMEDIATE")
        try:
            check_layout(connection, path)
            connection.set_progress_handler(None, 0)  # The limit applies to reading only.
            fill(connection)
            connection.execute("COMMIT")
        except BaseException:
            if connection.in_transaction:
                connection.execute("ROLLBACK")
            raise

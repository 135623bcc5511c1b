"""The videos of a batch and what became of them, on disk: lists may be long."""

from __future__ import annotations

import os
import pickle
import sqlite3
from collections.abc import Iterable, Iterator
from pathlib import Path, PurePosixPath

from colmap_av1.batch.files import absolute
from colmap_av1.batch.inputs import Named
from colmap_av1.batch.jobs import Job, Needs, Row, Source
from colmap_av1.batch.outputs import HIDDEN, PAGE, ROWS
from colmap_av1.errors import OptionError

_PAGE = 256
_TAKEN = {HIDDEN, PAGE}
_LONGEST_PART = 240  # bytes of a file name, with room for a suffix

_LAYOUT = """
PRAGMA journal_mode = OFF;
PRAGMA synchronous = OFF;
CREATE TABLE videos (position INTEGER PRIMARY KEY, name BLOB UNIQUE, address BLOB, member BLOB,
  start INTEGER, length INTEGER, row BLOB);
CREATE TABLE folders (name BLOB PRIMARY KEY) WITHOUT ROWID;
"""


class Index:
    """A file with the videos in their order and the rows that are there.

    Attributes:
        num_videos: videos.
        num_duplicates: videos that were given again under the same name, and count once.
    """

    def __init__(self, file: Path) -> None:
        self._database = sqlite3.connect(file, isolation_level=None)
        self._database.executescript(_LAYOUT)
        self.num_videos = 0
        self.num_duplicates = 0

    def close(self) -> None:
        """Close the file."""
        self._database.close()

    def add(self, videos: Iterable[Named]) -> None:
        """Add videos in their order.

        Raises:
            OptionError: a name cannot be that of a folder, or belongs to two videos.
        """
        self._database.execute("BEGIN")
        for name, source in videos:
            _check_name(name, source)
            self._add(name, source)
        self._database.execute("COMMIT")
        self._refuse_nested()

    def jobs(self, part: tuple[int, int], needs: Needs) -> Iterator[Job]:
        """The videos of a shard (number from 1, count), in their order."""
        number, count = part
        query = (
            "SELECT position, name, address, member, start, length FROM videos "
            "WHERE position > ? AND position % ? = ? ORDER BY position LIMIT ?"
        )
        last = -1
        while page := self._database.execute(query, (last, count, number - 1, _PAGE)).fetchall():
            for position, name, address, member, start, length in page:
                source = Source(os.fsdecode(address), os.fsdecode(member), start, length)
                yield Job(position, os.fsdecode(name), source, needs)
            last = page[-1][0]

    def record(self, position: int, row: Row) -> None:
        """Keep what became of a video."""
        words = (pickle.dumps(row), position)
        self._database.execute("UPDATE videos SET row = ? WHERE position = ?", words)

    def rows(self) -> Iterator[Row]:
        """What became of the videos so far, in their order."""
        query = (
            "SELECT position, row FROM videos WHERE position > ? AND row NOT NULL "
            "ORDER BY position LIMIT ?"
        )
        last = -1
        while page := self._database.execute(query, (last, _PAGE)).fetchall():
            for _, row in page:
                yield pickle.loads(row)
            last = page[-1][0]

    def _add(self, name: str, source: Source) -> None:
        key, address = os.fsencode(name), os.fsencode(absolute(source.address))
        member = os.fsencode(source.member)
        values = (self.num_videos, key, address, member, source.start, source.length)
        added = self._database.execute(
            "INSERT OR IGNORE INTO videos VALUES (?, ?, ?, ?, ?, ?, NULL)", values
        )
        if added.rowcount:
            self.num_videos += 1
            if "/" in name:
                above = ((os.fsencode(str(p)),) for p in PurePosixPath(name).parents if p.name)
                self._database.executemany("INSERT OR IGNORE INTO folders VALUES (?)", above)
            return
        query = "SELECT address, member FROM videos WHERE name = ?"
        there = self._database.execute(query, (key,)).fetchone()
        if there != (address, member):
            first = Source(os.fsdecode(there[0]), os.fsdecode(there[1]))
            raise OptionError(
                f"{first} and {source} would both be '{name}' in the output: give a list with a "
                "tab and a name of its own after each"
            )
        self.num_duplicates += 1

    def _refuse_nested(self) -> None:
        """Refuse a name that is the folder of another: it would be in the folder of a video."""
        query = "SELECT name FROM videos JOIN folders USING (name) ORDER BY position LIMIT 1"
        found = self._database.execute(query).fetchone()
        if found is not None:
            name = os.fsdecode(found[0])
            raise OptionError(
                f"'{name}' is a video and the folder of others, which would be in its output: "
                "give a list with a tab and a name of its own after each"
            )


def _check_name(name: str, source: Source) -> None:
    parts = name.split("/")
    unfit = {"", ".", ".."} & set(parts) or parts[0] in _TAKEN or parts[0].startswith(f"{ROWS}.")
    if unfit or any(len(os.fsencode(part)) > _LONGEST_PART for part in parts) or "\n" in name:
        raise OptionError(
            f"{source}: '{name}' cannot be the name of its folder: give another after a tab in a "
            "list"
        )

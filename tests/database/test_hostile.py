"""Damaged and malicious databases: a one-line error within a second, and an unchanged file."""

from __future__ import annotations

import itertools
import re
import sqlite3
import struct
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import PROJECT
from existing_database import (
    CAMERA,
    CAMERAS,
    LAYOUTS,
    NAMES,
    NUM_IMAGES,
    OURS,
    alter,
    make_existing,
    make_layout,
    sift_keypoints,
)
from track_metrics import database_tracks

from colmap_av1.check.database import check_database
from colmap_av1.cli import main
from colmap_av1.database.file import copy_database
from colmap_av1.database.reading import read_cameras, read_images
from colmap_av1.database.writing import write_matches
from colmap_av1.errors import ColmapAv1Error, DatabaseError
from colmap_av1.interop.hloc import export_hloc
from colmap_av1.view import view_database

PAIR = 2147483647 * 3 + 4


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A small database with images, keypoints and matches, in one file."""
    path = tmp_path_factory.mktemp("sound") / "a.db"
    make_existing(path, "3.8", "sift")
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("PRAGMA journal_mode = DELETE")
    return path.read_bytes()


def change_schema(path: Path, change: str) -> None:
    """Change the text of the schema directly, without the checks of SQLite."""
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("PRAGMA writable_schema = ON")
        connection.execute(change)


def write_endless_pages(path: Path) -> None:
    """Give a table pages that each refer to the next page many times, for about 70 ** 17 rows."""
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        (root,) = connection.execute(
            "SELECT rootpage FROM sqlite_master WHERE name = 'matches'"
        ).fetchone()
        (size,) = connection.execute("PRAGMA page_size").fetchone()
    data = bytearray(path.read_bytes())

    def page(child: int) -> bytes:
        # An interior page of a table, section 1.6 of the SQLite file format.
        cells = [struct.pack(">IB", child, key) for key in range(1, 70)]
        starts = [size - 5 * (i + 1) for i in range(len(cells))]
        head = struct.pack(">BHHHBI", 5, 0, len(cells), starts[-1], 0, child)
        head += b"".join(struct.pack(">H", start) for start in starts)
        return head.ljust(starts[-1], b"\0") + b"".join(reversed(cells))

    count = len(data) // size
    leaf = count + 1
    data += data[(root - 1) * size : root * size]  # the former root, with the rows
    for child in range(leaf, leaf + 16):
        data += page(child)
    data[(root - 1) * size : root * size] = page(leaf + 16)
    struct.pack_into(">I", data, 28, len(data) // size)
    path.write_bytes(data)


ENDLESS = (
    "CREATE VIEW {0} AS WITH RECURSIVE n({1}) AS (SELECT 1, 1, 2, X'0000000000000000' UNION ALL "
    "SELECT {2} + 1, rows, cols, data FROM n) SELECT * FROM n"
)
# Changes, a pattern that the error of `check` matches, and whether every reader and writer fails.
SQL = {
    "schema not in UTF-8": (
        [
            "PRAGMA writable_schema = ON",
            "UPDATE sqlite_master SET sql = CAST(REPLACE(CAST(sql AS BLOB), 'params', X'FF6172') "
            "AS TEXT) WHERE name = 'cameras'",
        ],
        "UTF-8|layout|COLMAP",
        False,
    ),
    "schema not SQL": (
        [
            "PRAGMA writable_schema = ON",
            "UPDATE sqlite_master SET sql = CAST(X'FFFEFD' AS TEXT) WHERE name = 'cameras'",
        ],
        "damaged",
        False,
    ),
    "name not in UTF-8": (
        ["UPDATE images SET name = CAST(X'FF2E706E67' AS TEXT) WHERE image_id = 1"],
        "UTF-8",
        False,
    ),
    "name a blob": (
        ["UPDATE images SET name = X'612E706E67' WHERE image_id = 1"],
        "'name'",
        True,
    ),
    "name a number": (
        [
            "CREATE TABLE other AS SELECT * FROM images",
            "DROP TABLE images",
            "CREATE TABLE images (image_id INTEGER PRIMARY KEY, name, camera_id INTEGER)",
            "INSERT INTO images SELECT image_id, image_id, camera_id FROM other",
        ],
        "'name'",
        True,
    ),
    "no primary key": (
        [
            "CREATE TABLE other AS SELECT * FROM matches",
            "DROP TABLE matches",
            "ALTER TABLE other RENAME TO matches",
        ],
        "'pair_id'",
        False,
    ),
    "two images with one name": (
        [
            "CREATE TABLE other AS SELECT * FROM images",
            "DROP TABLE images",
            "CREATE TABLE images (image_id INTEGER PRIMARY KEY, name TEXT, camera_id INTEGER)",
            "INSERT INTO images SELECT image_id, 'a.png', camera_id FROM other",
        ],
        r"'a\.png'",
        False,
    ),
    "parameters of 1 byte": (["UPDATE cameras SET params = X'00'"], "parameters", False),
    "parameters as text": (["UPDATE cameras SET params = '1,2,3'"], "'cameras'", True),
    "unknown model": (["UPDATE cameras SET model = 99"], "99", False),
    "negative size": (["UPDATE cameras SET width = -5"], "'width'", True),
    "negative rows": (["UPDATE keypoints SET rows = -1"], "'rows'", True),
    "too many rows": (
        ["UPDATE matches SET rows = 4000000000"],
        "'rows'",
        True,
    ),
    "rows as text": (["UPDATE matches SET rows = 'many'"], "'rows'", True),
    "more rows than data": (
        [f"UPDATE {t} SET rows = rows + 1" for t in ("keypoints", "matches")]
        + ["UPDATE two_view_geometries SET rows = rows + 1"],
        "damaged",
        False,
    ),
    "negative camera id": (
        ["UPDATE images SET camera_id = -1"],
        "'camera_id'",
        True,
    ),
    "config as text": (
        ["UPDATE two_view_geometries SET config = 'calibrated'"],
        "'config'",
        True,
    ),
    "endless view": (
        [
            "DROP TABLE keypoints",
            ENDLESS.format("keypoints", "image_id, rows, cols, data", "image_id"),
        ],
        "'keypoints'",
        True,
    ),
    "endless view of matches": (
        ["DROP TABLE matches", ENDLESS.format("Matches", "pair_id, rows, cols, data", "pair_id")],
        "'matches'",
        True,
    ),
    "virtual table": (
        [
            "DROP TABLE descriptors",
            "CREATE VIRTUAL TABLE descriptors USING fts5(image_id, rows, cols, data)",
        ],
        "'descriptors'|no such module",
        True,
    ),
    "trigger": (
        [
            "CREATE TRIGGER t AFTER UPDATE ON images BEGIN DELETE FROM images; END",
            "CREATE TRIGGER u AFTER INSERT ON keypoints BEGIN DELETE FROM images; END",
        ],
        "triggers",
        True,
    ),
}


WRITERS = ("write", "replace")


def readers_and_writers(path: Path, folder: Path) -> list[tuple[str, Callable[[], object]]]:
    """All functions of the package that open a database, by name."""
    return [
        ("check", lambda: check_database(path)),
        ("images", lambda: read_images(path)),
        ("cameras", lambda: read_cameras(path)),
        ("write", lambda: write_matches(path, NAMES, CAMERAS, OURS, on_existing="append")),
        ("replace", lambda: write_matches(path, NAMES, CAMERAS, OURS, on_existing="replace")),
        ("export", lambda: export_hloc(path, folder / "hloc")),
        ("view", lambda: view_database(path, folder)),
        ("copy", lambda: copy_database(path, folder / "copy.db")),
        ("tracks", lambda: database_tracks(path, NUM_IMAGES)),
    ]


def messages(path: Path, folder: Path) -> dict[str, str]:
    """Error messages of the readers and writers that fail, by name.

    Readers and failing writers must not change the file.
    """
    found = {}
    for name, run in readers_and_writers(path, folder):
        before = path.read_bytes()
        start = time.process_time()
        try:
            run()
        except ColmapAv1Error as error:
            found[name] = str(error)
        if name in found or name not in WRITERS:
            assert path.read_bytes() == before, name
        assert not path.with_name(f"{path.name}-journal").exists()
        assert "\n" not in found.get(name, "")
        assert time.process_time() - start < 1, name
    return found


@pytest.mark.parametrize(("changes", "pattern", "by_all"), SQL.values(), ids=SQL.keys())
def test_malicious_database_is_refused_in_one_line(
    tmp_path: Path, sound: bytes, changes: list[str], pattern: str, by_all: bool
) -> None:
    path = tmp_path / "a.db"
    path.write_bytes(sound)
    with closing(sqlite3.connect(path)) as connection, connection:
        for sql in changes:
            connection.execute(sql)
    found = messages(path, tmp_path)
    assert "check" in found
    assert re.search(pattern, found["check"]), found
    # Functions that do not read the damaged part may succeed.
    if by_all:
        assert len(found) == len(readers_and_writers(path, tmp_path)), found.keys()


def test_pages_that_refer_to_each_other_are_refused(tmp_path: Path, sound: bytes) -> None:
    path = tmp_path / "a.db"
    path.write_bytes(sound)
    write_endless_pages(path)
    found = messages(path, tmp_path)
    assert len(found) == len(readers_and_writers(path, tmp_path)), found.keys()
    assert all("end" in text for text in found.values()), found


def test_schema_that_sqlite_cannot_allocate_is_reported_as_damage(tmp_path: Path) -> None:
    """SQLite reports a lack of memory for this schema."""
    content = bytearray((PROJECT / "tests" / "data" / "seeds" / "database" / "4.2.db").read_bytes())
    start = content.index(b"CREATE TABLE sqlite_")
    content[start : start + 55] = b"\xff" * 55
    path = tmp_path / "a.db"
    path.write_bytes(content)
    with pytest.raises(DatabaseError, match="damaged"):
        check_database(path)


def test_functions_in_the_schema_are_not_called(tmp_path: Path, sound: bytes) -> None:
    """A default value calls a function with side effects when a row is inserted."""
    path = tmp_path / "a.db"
    path.write_bytes(sound)
    change_schema(
        path,
        "UPDATE sqlite_master SET sql = REPLACE(sql, 'cols INTEGER NOT NULL', "
        "'cols INTEGER NOT NULL, more TEXT DEFAULT (LOAD_EXTENSION(''x''))') "
        "WHERE name = 'matches'",
    )
    before = path.read_bytes()
    with pytest.raises(DatabaseError):
        write_matches(path, NAMES, CAMERAS, OURS, on_existing="append")
    assert path.read_bytes() == before


def nan_keypoints(image_id: int, num: int) -> tuple[str, bytes, int]:
    """A change of the first keypoints of an image to NaN."""
    keypoints = sift_keypoints(NUM_IMAGES - image_id).copy()
    keypoints[:num, :2] = np.nan
    return "UPDATE keypoints SET data = ? WHERE image_id = ?", keypoints.tobytes(), image_id


def changed_params(change: Callable[[float], float]) -> tuple[str, bytes]:
    """A change of all camera parameters."""
    values = np.array([change(p) for p in CAMERA.params])
    return "UPDATE cameras SET params = ?", values.tobytes()


# Problems that stop mappers are errors, problems that mappers ignore are warnings.
FOUND = {
    "NaN keypoints": (nan_keypoints(3, 5), "error", "keypoints"),
    "NaN parameters": (changed_params(lambda _: np.nan), "error", "parameters"),
    "negative focal length": (changed_params(lambda p: -p), "error", "focal length"),
    "size 0": (("UPDATE cameras SET width = 0",), "error", "size"),
    "huge size": (("UPDATE cameras SET width = 1 << 40",), "error", "size"),
    "size smaller than the images": (
        ("UPDATE cameras SET width = 100, height = 100",),
        "warning",
        "outside",
    ),
    "matches of missing keypoints": (
        (
            "UPDATE matches SET data = CAST(X'ffffff7f' || SUBSTR(data, 5) AS BLOB) "
            "WHERE pair_id = ?",
            PAIR,
        ),
        "warning",
        "keypoints",
    ),
    "empty name": (("UPDATE images SET name = '' WHERE image_id = 2",), "error", "name"),
    "name with a null character": (
        ("UPDATE images SET name = 'a' || CHAR(0) || 'b.png' WHERE image_id = 2",),
        "error",
        "name",
    ),
    "name in the parent folder": (
        ("UPDATE images SET name = '../a.png' WHERE image_id = 2",),
        "error",
        "../a.png",
    ),
    "absolute name": (
        ("UPDATE images SET name = '/etc/a.png' WHERE image_id = 2",),
        "error",
        "/etc/a.png",
    ),
    "pair of an image with itself": (
        ("UPDATE two_view_geometries SET pair_id = ? WHERE pair_id = ?", PAIR - 1, PAIR),
        "warning",
        "itself",
    ),
    "pair with the larger id first": (
        (
            "UPDATE two_view_geometries SET pair_id = ? WHERE pair_id = ?",
            2147483647 * 4 + 3,
            PAIR,
        ),
        "warning",
        "larger",
    ),
    "keypoints of deleted images": (
        ("DELETE FROM images WHERE image_id < 7",),
        "error",
        "not listed",
    ),
    "no cameras": (("DELETE FROM cameras",), "error", "8 images"),
}


@pytest.mark.parametrize(("change", "severity", "text"), FOUND.values(), ids=FOUND.keys())
def test_strict_check_reports_the_problem(  # noqa: PLR0917
    tmp_path: Path,
    sound: bytes,
    capsys: pytest.CaptureFixture[str],
    change: tuple[Any, ...],
    severity: str,
    text: str,
) -> None:
    path = tmp_path / "a.db"
    path.write_bytes(sound)
    assert main(["check", "--database", str(path), "--strict"]) == 0
    capsys.readouterr()
    alter(path, *change)
    assert main(["check", "--database", str(path), "--strict"]) == 1
    rows = [line.split("\t") for line in capsys.readouterr().out.splitlines()]
    assert any(name == severity and text in value for name, value in rows), rows
    assert rows[-1][0] == "for mapping"
    assert rows[-1][1] != "good"
    messages(path, tmp_path)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_is_read_and_written(tmp_path: Path, layout: str) -> None:
    make_layout(tmp_path / "a.db", layout)
    write_matches(tmp_path / "a.db", NAMES, CAMERAS, OURS)
    assert check_database(tmp_path / "a.db").mappable


def test_large_database_is_not_taken_for_an_endless_one(tmp_path: Path) -> None:
    """The limit on the number of rows grows with the size of the file."""
    path = tmp_path / "a.db"
    make_layout(path, "3.8")
    pairs = itertools.combinations(range(1, 301), 2)
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.executemany(
            "INSERT INTO images (image_id, name, camera_id) VALUES (?, ?, 1)",
            ((i, f"{i}.png") for i in range(1, 301)),
        )
        connection.executemany(
            "INSERT INTO matches VALUES (?, 0, 2, NULL)",
            ((2147483647 * i + j,) for i, j in pairs),
        )
        connection.execute(
            "INSERT INTO two_view_geometries (pair_id, rows, cols, config) "
            "SELECT pair_id, 0, 2, 1 FROM matches"
        )
    assert check_database(path).num_empty_pairs == 300 * 299 // 2
    assert len(read_images(path)) == 300

"""Random damage to COLMAP databases: errors are one line and do not change the file.

COLMAP_AV1_EXAMPLES sets the number of random sequences of steps.
"""

from __future__ import annotations

import os
import shutil
import sqlite3
import tempfile
import time
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import numpy as np
from existing_database import CAMERA, LAYOUTS, make_layout, query
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule
from track_metrics import database_tracks

from colmap_av1.check.database import check_database
from colmap_av1.database.file import copy_database
from colmap_av1.database.reading import read_cameras, read_images
from colmap_av1.database.writing import write_matches
from colmap_av1.errors import ColmapAv1Error
from colmap_av1.interop.hloc import export_hloc
from colmap_av1.matching.matched_images import MatchedImages
from colmap_av1.matching.pairs import ImageKeypoints
from colmap_av1.matching.two_view_geometry import TwoViewConfig, TwoViewGeometry
from colmap_av1.view import view_database

EXAMPLES = os.environ.get("COLMAP_AV1_EXAMPLES")
NAMES = ["f0.png", "f1.png", "f2.png"]
CAMERAS = [CAMERA] * len(NAMES)
NUM_KEYPOINTS = 20
# Largest CPU time of a step, in seconds.
LIMIT = 2.0
TABLES = {
    "cameras": ("camera_id", "model", "width", "height", "params", "prior_focal_length"),
    "images": ("image_id", "name", "camera_id"),
    "keypoints": ("image_id", "rows", "cols", "data"),
    "descriptors": ("image_id", "rows", "cols", "data"),
    "matches": ("pair_id", "rows", "cols", "data"),
    "two_view_geometries": ("pair_id", "rows", "cols", "data", "config", "F", "E", "H"),
    "rigs": ("rig_id", "ref_sensor_id", "ref_sensor_type"),
    "frames": ("frame_id", "rig_id"),
    "frame_data": ("frame_id", "data_id", "sensor_id", "sensor_type"),
}
COLUMNS = [(table, column) for table, names in TABLES.items() for column in names]
VALUES = (
    st.none()
    | st.sampled_from([0, 1, 2, 3, 4, 6, 7, 77, 2147483647, 2147483649, 1 << 40, -1, -(1 << 63)])
    | st.integers(-(1 << 63), (1 << 63) - 1)
    | st.floats()
    | st.binary(max_size=80)
    | st.sampled_from([NAMES[0], "", "../x.png", "/x.png", "a\0b", "a b.png", "\ud7ff", "1", "-1"])
    | st.text(max_size=8)
)
SCHEMA_CHANGES = st.sampled_from(
    [
        *(f"DROP TABLE {table}" for table in TABLES),
        *(f"ALTER TABLE {table} RENAME TO other" for table in TABLES),
        *(f"ALTER TABLE {t} RENAME COLUMN {c} TO other" for t, c in COLUMNS),
        *(
            f"CREATE TRIGGER t_{t} AFTER INSERT ON {t} BEGIN DELETE FROM images; END"
            for t in TABLES
        ),
        *(
            f"CREATE VIEW {table} AS WITH RECURSIVE n({', '.join(names)}) AS (SELECT "
            f"{', '.join('1' for _ in names)} UNION ALL SELECT {', '.join(names)} FROM n) "
            "SELECT * FROM n"
            for table, names in TABLES.items()
        ),
        "DROP INDEX index_name",
        "CREATE INDEX more ON keypoints(rows + randomblob(9))",
        "PRAGMA encoding = 'UTF-16'",
        "PRAGMA user_version = -1",
        "PRAGMA journal_mode = WAL",
        "VACUUM",
        "DELETE FROM images",
        "DELETE FROM cameras",
        "DELETE FROM keypoints",
    ]
)


def new_rows(seed: int) -> MatchedImages:
    """Keypoints, matches and geometries of the three images."""
    rng = np.random.default_rng(seed)
    keypoints = [
        ImageKeypoints(
            xy=rng.uniform(0, 100, (NUM_KEYPOINTS, 2)).astype(np.float32),
            track=np.arange(NUM_KEYPOINTS, dtype=np.int64),
        )
        for frame in range(len(NAMES))
    ]
    matches = np.repeat(np.arange(NUM_KEYPOINTS, dtype=np.uint32)[:, None], 2, axis=1)
    geometry = TwoViewGeometry(
        config=TwoViewConfig.CALIBRATED, inlier_matches=matches, E=rng.normal(size=(3, 3))
    )
    pairs = np.array([[0, 1], [0, 2], [1, 2]], dtype=np.int32)
    each = len(pairs)
    return MatchedImages(
        keypoints, pairs, [matches] * each, [geometry] * each, forward_motion=False
    )


class Databases(RuleBasedStateMachine):
    """A database that is written, damaged, and read by all functions that read databases."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = Path(tempfile.mkdtemp())
        self.path = self.folder / "a.db"
        self.seed = 0

    def teardown(self) -> None:
        shutil.rmtree(self.folder)

    def attempt(self, run: Callable[[], object], *, writes: bool = False) -> None:
        """Run a function, which must succeed or fail with a one-line error.

        If it fails or does not write, the file must not change.
        """
        before = self.path.read_bytes()
        start = time.process_time()
        message = None
        try:
            run()
        except ColmapAv1Error as error:
            message = str(error)
        assert time.process_time() - start < LIMIT
        assert "\n" not in (message or "")
        if message is not None or not writes:
            assert self.path.read_bytes() == before

    @initialize(layout=st.sampled_from(LAYOUTS), fills=st.booleans())
    def make(self, layout: str, fills: bool) -> None:
        make_layout(self.path, layout)
        query(self.path, "PRAGMA journal_mode = DELETE")
        if fills:
            write_matches(self.path, NAMES, CAMERAS, new_rows(0))

    @rule(mode=st.sampled_from(["error", "append", "replace"]))
    def write(self, mode: Any) -> None:
        self.seed += 1
        rows = new_rows(self.seed)
        self.attempt(
            lambda: write_matches(self.path, NAMES, CAMERAS, rows, on_existing=mode), writes=True
        )

    @rule(where=st.sampled_from(COLUMNS), value=VALUES, which=st.integers(0, 2))
    def change_value(self, where: tuple[str, str], value: object, which: int) -> None:
        table, column = where
        key = TABLES[table][0]
        self.execute(
            f"UPDATE OR REPLACE {table} SET {column} = ? WHERE {key} = "
            f"(SELECT {key} FROM {table} LIMIT 1 OFFSET ?)",
            value,
            which,
        )

    @rule(change=SCHEMA_CHANGES)
    def change_schema(self, change: str) -> None:
        self.execute(change)

    def execute(self, sql: str, *values: object) -> None:
        with (
            suppress(sqlite3.Error, UnicodeError),
            closing(sqlite3.connect(self.path, isolation_level=None)) as connection,
        ):
            connection.execute(sql, values)

    @rule(
        places=st.lists(
            st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)),
            min_size=1,
            max_size=4,
        ),
        at_start=st.booleans(),
    )
    def change_bytes(self, places: list[tuple[float, int]], at_start: bool) -> None:
        data = bytearray(self.path.read_bytes())
        for place, value in places if data else ():
            # The first page holds the schema, so half of the changes are there.
            data[int(place * (min(4096, len(data)) if at_start else len(data)))] = value
        self.path.write_bytes(data)

    @rule(share=st.floats(0, 1))
    def cut_off(self, share: float) -> None:
        os.truncate(self.path, int(share * self.path.stat().st_size))

    @invariant()
    def all_functions_read_it(self) -> None:
        if not self.path.exists():  # invariants are also checked before `make`
            return
        self.attempt(lambda: check_database(self.path))
        self.attempt(lambda: read_images(self.path))
        self.attempt(lambda: read_cameras(self.path))
        self.attempt(lambda: export_hloc(self.path, self.folder / "hloc"))
        self.attempt(lambda: view_database(self.path, self.folder))
        self.attempt(lambda: database_tracks(self.path, len(NAMES)))
        (self.folder / "copy.db").unlink(missing_ok=True)
        self.attempt(lambda: copy_database(self.path, self.folder / "copy.db"))


Databases.TestCase.settings = settings(
    max_examples=int(EXAMPLES or "40"),
    derandomize=EXAMPLES is None,
    stateful_step_count=8,
    deadline=None,
    print_blob=True,
    suppress_health_check=list(HealthCheck),
)
TestDatabases = Databases.TestCase

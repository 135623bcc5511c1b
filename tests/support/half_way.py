"""A process that is killed while it writes to a database."""

from __future__ import annotations

import signal
import subprocess
import sys
import textwrap
from pathlib import Path

from conftest import TEST_PATHS

_WAITING = """
    import dataclasses, os, sys, time
    sys.path[:0] = sys.argv[2].split(os.pathsep)
    import importlib
    from colmap_av1.database import file as database_file
    from colmap_av1.database import writing as database

    data = importlib.import_module(sys.argv[3])
    new_rows = getattr(data, sys.argv[4])

    class Waiting(list):
        def __getitem__(self, index):
            if index == len(self) - 1:
                print("half-way", flush=True)
                time.sleep(60)
            return super().__getitem__(index)

    # With a small cache, SQLite writes pages of the open transaction to the disk.
    connect = database_file.sqlite3.connect
    def connect_small(*args, **kwargs):
        connection = connect(*args, **kwargs)
        connection.execute("PRAGMA cache_size = 5")
        return connection
    database_file.sqlite3.connect = connect_small
    new_rows = dataclasses.replace(new_rows, geometries=Waiting(new_rows.geometries))
    images = (data.NAMES, data.CAMERAS)
    database.write_matches(sys.argv[1], *images, new_rows, on_existing=sys.argv[5])
"""


def start_writing(
    path: Path, mode: str, module: str = "existing_database", rows: str = "OURS"
) -> subprocess.Popen[str]:
    """Start a process that writes most rows and then waits inside its transaction.

    `module` is a module of the tests with NAMES, CAMERAS and the rows, in a variable named `rows`.
    """
    script = textwrap.dedent(_WAITING)
    process = subprocess.Popen(
        [sys.executable, "-c", script, path, TEST_PATHS, module, rows, mode],
        stdout=subprocess.PIPE,
        text=True,
        cwd=path.parent,  # in the checkout, its package would hide the installed one
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "half-way\n"
    return process


def kill(process: subprocess.Popen[str]) -> None:
    """Kill the process."""
    with process:
        process.send_signal(signal.SIGKILL)

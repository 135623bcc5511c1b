"""A process that is killed while it writes to a database."""

from __future__ import annotations

import signal
import subprocess
import sys
import textwrap
from pathlib import Path

from conftest import TEST_PATHS

_WAITING = """
    import os, sys, time
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

    # A small cache makes SQLite write pages of the open transaction to the disk.
    connect = database_file.sqlite3.connect
    def connect_small(*args, **kwargs):
        connection = connect(*args, **kwargs)
        connection.execute("PRAGMA cache_size = 5")
        return connection
    database_file.sqlite3.connect = connect_small
    new_rows = {**new_rows, "geometries": Waiting(new_rows["geometries"])}
    images = (data.NAMES, data.CAMERA)
    database.write_matches(sys.argv[1], *images, **new_rows, on_existing=sys.argv[5])
"""


def start_writing(
    path: Path, mode: str, module: str = "existing_database", rows: str = "OURS"
) -> subprocess.Popen[str]:
    """A process that has written most rows and then waits inside its transaction.

    `module` of the tests holds the rows, under that name, with NAMES and CAMERA.
    """
    script = textwrap.dedent(_WAITING)
    process = subprocess.Popen(
        [sys.executable, "-c", script, path, TEST_PATHS, module, rows, mode],
        stdout=subprocess.PIPE,
        text=True,
        cwd=path.parent,  # else the checkout would hide the installed package
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "half-way\n"
    return process


def kill(process: subprocess.Popen[str]) -> None:
    """End it at once."""
    with process:
        process.send_signal(signal.SIGKILL)

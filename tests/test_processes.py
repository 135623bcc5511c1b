from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import pytest

from colmap_av1.processes import bound

BOUND = """
import subprocess, sys, time
from colmap_av1.processes import bound
child = "import os, time; print(os.getpid(), flush=True); time.sleep(60)"
subprocess.Popen(bound([sys.executable, "-c", child]))
time.sleep(60)
"""
BINDING = """
import os, subprocess, sys, time
child = (
    "import os, sys, time; from colmap_av1.processes import bind; "
    "bind(int(sys.argv[1])); print(os.getpid(), flush=True); time.sleep(60)"
)
subprocess.Popen([sys.executable, "-c", child, str(os.getpid())])
time.sleep(60)
"""


def is_running(process: int) -> bool:
    try:  # what has ended and is not waited for has no words left
        return Path(f"/proc/{process}/cmdline").read_bytes() != b""
    except OSError:
        return False


def test_a_bound_process_is_the_one_asked_for() -> None:
    program = "import sys; print(sys.argv[1:]); sys.exit(3)"
    words = ["a b", "", "-c", "'", "$x"]
    run = subprocess.run(
        bound([sys.executable, "-c", program, *words]), capture_output=True, text=True, check=False
    )
    assert run.stdout == f"{words}\n"
    assert run.returncode == 3


def test_a_program_without_a_folder_is_looked_for() -> None:
    run = subprocess.run(bound(["echo", "here"]), capture_output=True, text=True, check=True)
    assert run.stdout == "here\n"


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux ends the children of the killed")
@pytest.mark.parametrize("program", [BOUND, BINDING], ids=["bound", "binding"])
def test_a_bound_process_ends_with_a_killed_one(program: str, tmp_path: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, text=True, cwd=tmp_path
    ) as starter:
        assert starter.stdout is not None
        child = int(starter.stdout.readline())
        assert is_running(child)
        starter.kill()
    deadline = time.monotonic() + 10
    while is_running(child):
        assert time.monotonic() < deadline
        time.sleep(0.01)

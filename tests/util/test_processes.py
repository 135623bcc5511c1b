from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import pytest

from colmap_av1.util.processes import bound, bound_group

BOUND = """
import subprocess, sys, time
from colmap_av1.util.processes import bound
child = "import os, time; print(os.getpid(), flush=True); time.sleep(60)"
subprocess.Popen(bound([sys.executable, "-c", child]))
time.sleep(60)
"""
BINDING = """
import os, subprocess, sys, time
child = (
    "import os, sys, time; from colmap_av1.util.processes import bind; "
    "bind(int(sys.argv[1])); print(os.getpid(), flush=True); time.sleep(60)"
)
subprocess.Popen([sys.executable, "-c", child, str(os.getpid())])
time.sleep(60)
"""
GROUP = """
import shlex, subprocess, sys, time
from colmap_av1.util.processes import bound_group
child = "import os, time; print(os.getpid(), flush=True); time.sleep(60)"
command = f"{shlex.join([sys.executable, '-c', child])} && echo not reached"
subprocess.Popen(bound_group(["sh", "-c", command]))
time.sleep(60)
"""
linux = pytest.mark.skipif(
    sys.platform != "linux", reason="only Linux can end children with their parent"
)


def is_running(process: int) -> bool:
    try:  # a zombie has an empty command line
        return Path(f"/proc/{process}/cmdline").read_bytes() != b""
    except OSError:
        return False


def test_bound_process_runs_the_command() -> None:
    program = "import sys; print(sys.argv[1:]); sys.exit(3)"
    words = ["a b", "", "-c", "'", "$x"]
    run = subprocess.run(
        bound([sys.executable, "-c", program, *words]), capture_output=True, text=True, check=False
    )
    assert run.stdout == f"{words}\n"
    assert run.returncode == 3


def test_bound_program_is_searched_in_the_path() -> None:
    run = subprocess.run(bound(["echo", "here"]), capture_output=True, text=True, check=True)
    assert run.stdout == "here\n"


@linux
def test_bound_group_runs_the_command() -> None:
    words = bound_group(["sh", "-c", "echo \"$1\" '$1' && exit 3", "sh", "a  b; $(echo no)"])
    run = subprocess.run(words, capture_output=True, text=True, check=False)
    assert run.stdout == "a  b; $(echo no) $1\n"
    assert run.returncode == 3
    killed = subprocess.run(bound_group(["sh", "-c", "kill -KILL $$"]), check=False)
    assert killed.returncode == 137
    run = subprocess.run(bound_group(["./no such"]), capture_output=True, text=True, check=False)
    assert (run.returncode, run.stderr) == (1, "./no such: No such file or directory\n")


@linux
def test_children_of_a_bound_group_end_with_it() -> None:
    words = bound_group(["sh", "-c", "sleep 60 & echo $!"])
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as shell:
        assert shell.stdout is not None
        left = int(shell.stdout.readline())
        assert shell.wait(timeout=30) == 0
    wait_for_end(left)


def wait_for_end(process: int) -> None:
    deadline = time.monotonic() + 10
    while is_running(process):
        assert time.monotonic() < deadline
        time.sleep(0.01)


@linux
@pytest.mark.parametrize("program", [BOUND, BINDING, GROUP], ids=["bound", "binding", "group"])
def test_bound_process_ends_when_its_parent_is_killed(program: str, tmp_path: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, text=True, cwd=tmp_path
    ) as starter:
        assert starter.stdout is not None
        child = int(starter.stdout.readline())
        assert is_running(child)
        starter.kill()
    wait_for_end(child)

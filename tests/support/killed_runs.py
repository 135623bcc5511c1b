"""Processes that are killed while they write or replace an output."""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
from pathlib import Path

_WHILE_WRITING = """
import os, signal, sys
from pathlib import Path
from colmap_av1.util import files
with getattr(files, sys.argv[1])(Path(sys.argv[2])) as partial:
    (partial if partial.is_file() else partial / "points").write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
"""
_WHILE_REPLACING = """
import os, re, signal, sys
from pathlib import Path
from colmap_av1.util.files import whole_folder
left = int(sys.argv[2])
def counted(call):
    def counting(*args, **how):
        global left
        left -= 1
        if left < 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return call(*args, **how)
    return counting
with whole_folder(Path(sys.argv[1]), re.compile(".*")) as partial:
    for name in ("a", "c"):
        (partial / name).write_text("new")
    for name in ("mkdir", "rename", "rmdir", "replace"):
        setattr(Path, name, counted(getattr(Path, name)))
"""


def kill_while_writing(how: str, path: Path) -> None:
    """Kill a process while it writes a file or folder."""
    assert _ended(_WHILE_WRITING, how, path) == -signal.SIGKILL


def kill_while_replacing(folder: Path, steps: int) -> None:
    """Kill a process after some steps of replacing a folder's files with new files a and c.

    With more steps than replacing takes, it exits normally.
    """
    assert _ended(_WHILE_REPLACING, folder, steps) in (-signal.SIGKILL, 0)


def _ended(program: str, *words: object) -> int:
    """Exit status of a program, run outside the checkout, which hides the installed package."""
    command = [sys.executable, "-c", program, *map(str, words)]
    with tempfile.TemporaryDirectory() as folder:
        return subprocess.run(command, cwd=folder, check=False).returncode

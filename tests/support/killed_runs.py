"""Processes that are killed while they write or replace an output."""

from __future__ import annotations

import subprocess
import sys
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
import os, signal, sys
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
with whole_folder(Path(sys.argv[1]), overwrite=True) as partial:
    for name in ("a", "c"):
        (partial / name).write_text("new")
    for name in ("mkdir", "rename", "rmdir", "replace"):
        setattr(Path, name, counted(getattr(Path, name)))
"""


def kill_while_writing(how: str, path: Path) -> None:
    """Let a process die while it writes a file or folder."""
    subprocess.run([sys.executable, "-c", _WHILE_WRITING, how, str(path)], check=False)


def kill_while_replacing(folder: Path, steps: int) -> None:
    """Let a process die after some steps of replacing a folder's files by new ones, a and c."""
    command = [sys.executable, "-c", _WHILE_REPLACING, str(folder), str(steps)]
    subprocess.run(command, check=False)

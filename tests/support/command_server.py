"""A process that runs commands in copies of itself, which are there at once, and may kill them."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

_SERVER = """
import json, os, signal, sys, time
from colmap_av1.cli import main
from colmap_av1.util.signals import ENDING, end_at_once

def run(task, said):
    os.chdir(task["folder"])
    os.setpgid(0, 0)
    os.dup2(said, 1)
    os.dup2(said, 2)
    try:
        status = main(task["words"])
    except SystemExit as end:
        status = end.code or 0
    except BaseException as error:
        sys.excepthook(type(error), error, error.__traceback__)
        status = 1
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)

for number in ENDING:  # before the copies are made, which are programs that have just started
    signal.signal(number, end_at_once)
for line in sys.stdin:
    task = json.loads(line)
    said = os.memfd_create("said")
    start = time.monotonic()
    child = os.fork()
    if child == 0:
        run(task, said)
    if task["number"]:
        time.sleep(task["after"])
        os.kill(child, task["number"])
    _, status = os.waitpid(child, 0)
    seconds = time.monotonic() - start
    size = os.lseek(said, 0, os.SEEK_END)
    text = os.pread(said, size, 0).decode(errors="replace")
    os.close(said)
    answer = [os.waitstatus_to_exitcode(status), text, seconds]
    print(json.dumps(answer), flush=True)
"""


@dataclass(frozen=True)
class Outcome:
    """How a command ended.

    Attributes:
        status: its exit status; below 0: the signal that killed it.
        said: what it printed.
        seconds: how long it ran.
    """

    status: int
    said: str
    seconds: float


class CommandServer:
    """Runs commands; a context manager that ends with its process."""

    def __init__(self) -> None:
        self._process: Any = subprocess.Popen(
            [sys.executable, "-c", _SERVER],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=os.sep,  # else the checkout would hide the installed package
        )

    def __enter__(self) -> CommandServer:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()

    def run(
        self, folder: Path, words: str, number: signal.Signals | None = None, after: float = 0.0
    ) -> Outcome:
        """Run a command in a folder; with a number, send it that signal after some seconds."""
        task = {
            **{"folder": str(folder), "words": words.split()},
            **{"number": int(number or 0), "after": after},
        }
        self._process.stdin.write(json.dumps(task) + "\n")
        self._process.stdin.flush()
        return Outcome(*json.loads(self._process.stdout.readline()))

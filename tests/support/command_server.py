"""A process that runs commands in forks of itself, which start fast, and can kill them."""

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

def run(task, output):
    os.chdir(task["folder"])
    os.setpgid(0, 0)
    os.dup2(output, 1)
    os.dup2(output, 2)
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

for number in ENDING:  # so that forks behave like programs that have just started
    signal.signal(number, end_at_once)
for line in sys.stdin:
    task = json.loads(line)
    output = os.memfd_create("output")
    start = time.monotonic()
    child = os.fork()
    if child == 0:
        run(task, output)
    if task["number"]:
        time.sleep(task["after"])
        os.kill(child, task["number"])
    _, status = os.waitpid(child, 0)
    seconds = time.monotonic() - start
    size = os.lseek(output, 0, os.SEEK_END)
    text = os.pread(output, size, 0).decode(errors="replace")
    os.close(output)
    answer = [os.waitstatus_to_exitcode(status), text, seconds]
    print(json.dumps(answer), flush=True)
"""


@dataclass(frozen=True)
class Outcome:
    """How a command ended.

    Attributes:
        status: its exit status; the negative signal number if a signal killed it.
        output: standard output and error.
        seconds: how long it ran.
    """

    status: int
    output: str
    seconds: float


class CommandServer:
    """Runs commands; a context manager that ends the process on exit."""

    def __init__(self) -> None:
        self._process: Any = subprocess.Popen(
            [sys.executable, "-c", _SERVER],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=os.sep,  # in the checkout, its package would hide the installed one
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
        """Run a command in a folder; if `number` is given, send this signal `after` seconds."""
        task = {
            **{"folder": str(folder), "words": words.split()},
            **{"number": int(number or 0), "after": after},
        }
        self._process.stdin.write(json.dumps(task) + "\n")
        self._process.stdin.flush()
        return Outcome(*json.loads(self._process.stdout.readline()))

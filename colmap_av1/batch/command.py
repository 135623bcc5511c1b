"""Our command in a process of its own, and what it reported."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from colmap_av1.util.failures import Failure
from colmap_av1.util.plain import plain
from colmap_av1.util.processes import bound
from colmap_av1.util.remote import without_secrets

_WARNING = re.compile(r"^colmap-av1: warning: (.*)$", re.MULTILINE)
_ERROR = re.compile(r"^colmap-av1: error: (.*)$", re.MULTILINE)
_MOST_SAID = 1 << 16  # bytes of what a process printed last
# Statuses of a process that the system or an operator has ended: by a signal, or in order after it.
_SENT = (signal.SIGTERM, signal.SIGINT, getattr(signal, "SIGKILL", signal.SIGTERM))
_ENDED = {*(-number for number in _SENT), *(128 + number for number in _SENT)}
_END = 5.0  # seconds


class Processes:
    """Runs processes, one for each thread that asks for one, and can stop them all."""

    def __init__(self) -> None:
        self._running: set[subprocess.Popen[bytes]] = set()
        self._lock = threading.Lock()
        self.stopped = False

    def run(self, words: list[str], folder: Path, log: Path, timeout: float | None) -> int | None:
        """The exit status of our command, negative for a signal; None where it took too long."""
        # Not the working folder, in which another version of the package may lie.
        path = os.pathsep.join([str(Path(__file__).resolve().parents[2]), *filter(None, sys.path)])
        with log.open("wb") as said, self._lock:
            if self.stopped:
                return -signal.SIGTERM
            process = subprocess.Popen(
                bound([sys.executable, "-m", "colmap_av1", *words]),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=said,
                cwd=folder,
                env={**os.environ, "PYTHONPATH": path},
                # The interrupt of a terminal is for the driver, which ends the others in order.
                start_new_session=True,
            )
            self._running.add(process)
        try:
            return process.wait(timeout)
        except subprocess.TimeoutExpired:
            return None
        finally:
            with self._lock:
                self._running.discard(process)
            _signal(process, "SIGKILL")
            process.wait()

    def stop(self) -> None:
        """End all processes, in order if they heed that in time, and let no further one start."""
        with self._lock:
            self.stopped = True
            running = list(self._running)
        for process in running:
            _signal(process, "SIGTERM")
        end = time.monotonic() + _END
        for process in running:
            with suppress(subprocess.TimeoutExpired):
                process.wait(max(0.0, end - time.monotonic()))
            _signal(process, "SIGKILL")


def _signal(process: subprocess.Popen[bytes], name: str) -> None:
    """Send a signal to a process that runs, and to those that it has started."""
    if process.poll() is not None:
        return
    with suppress(ProcessLookupError, PermissionError):
        if os.name == "posix":
            os.killpg(process.pid, signal.Signals[name])
        else:
            process.kill()


class CommandFailedError(Exception):
    """Our command has failed.

    Attributes:
        failure: why.
    """

    def __init__(self, failure: Failure) -> None:
        super().__init__(failure.message)
        self.failure = failure


def run_command(
    words: list[str],
    scratch: Path,
    names: Mapping[str, str],
    timeout: float | None,
    processes: Processes,
) -> tuple[dict[str, Any], list[str]]:
    """Run our command and read its report.

    Args:
        words: the command and its options.
        scratch: the folder it is started in.
        names: paths of unfinished work, and what they are called afterwards.
        timeout: seconds after which it is stopped; None: never.
        processes: runs it.

    Returns:
        What --report_json wrote, and the warnings.

    Raises:
        CommandFailedError: it failed.
    """

    def renamed(text: str) -> str:
        for path, name in names.items():
            text = text.replace(path, name)
        return without_secrets(text)

    log, written = scratch / "log", scratch / "report.json"
    status = processes.run([*words, f"--report_json={written}"], scratch, log, timeout)
    with log.open("rb") as file:
        file.seek(max(0, log.stat().st_size - _MOST_SAID))
        said = renamed(file.read().decode("utf-8", "backslashreplace"))
    facts: Any = {}
    with suppress(OSError, ValueError):
        facts = plain(json.loads(written.read_bytes()), renamed)
    if status == 0 and "report" in facts:
        return facts, _WARNING.findall(said)
    if status is None:
        text = f"stopped after {timeout:g} seconds: give a longer --timeout"
        raise CommandFailedError(Failure("timeout", text, transient=True))
    if status in _ENDED:
        number = -status if status < 0 else status - 128
        text = f"its process was ended by {signal.Signals(number).name}"
        raise CommandFailedError(Failure("killed", text, transient=True))
    if "failure" in facts:
        raise CommandFailedError(Failure(**facts["failure"]))
    if status < 0:
        text = f"its process ended by signal {-status}: please report the video"
        raise CommandFailedError(Failure("crashed", text))
    errors = _ERROR.findall(said)
    if errors:  # the report of it could not be written
        raise CommandFailedError(Failure("reading or writing", errors[-1], transient=True))
    last = said.strip().rpartition("\n")[2]
    raise CommandFailedError(Failure("defect", last or f"its process ended with status {status}"))

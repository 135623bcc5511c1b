"""Running a `colmap-av1` command in a separate process, and reading its report."""

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
_MOST_PRINTED = 1 << 16  # Bytes of the end of a process's log that are read.
# Exit statuses of a process that the system or an operator ended: by the signal itself, or by an
# orderly exit after it.
_SENT = (signal.SIGTERM, signal.SIGINT, getattr(signal, "SIGKILL", signal.SIGTERM))
_ENDED = {*(-number for number in _SENT), *(128 + number for number in _SENT)}
_END = 5.0  # Seconds that a process gets to end after SIGTERM.


class Processes:
    """Runs processes from several threads, and can stop all of them."""

    def __init__(self) -> None:
        self._running: set[subprocess.Popen[bytes]] = set()
        self._lock = threading.Lock()
        self.stopped = False

    def run(self, words: list[str], folder: Path, log: Path, timeout: float | None) -> int | None:
        """Run a command; returns its exit status, negative for a signal, or None after a timeout.

        Args:
            words: the command and its options.
            folder: its working folder.
            log: file that gets its standard error.
            timeout: seconds; None: no limit.
        """
        # Without the working folder, which may hold another version of the package.
        path = os.pathsep.join([str(Path(__file__).resolve().parents[2]), *filter(None, sys.path)])
        with log.open("wb") as printed, self._lock:
            if self.stopped:
                return -signal.SIGTERM
            process = subprocess.Popen(
                bound([sys.executable, "-m", "colmap_av1", *words]),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=printed,
                cwd=folder,
                env={**os.environ, "PYTHONPATH": path},
                # An interrupt from the terminal must reach the parent only, which then ends the
                # other processes in an orderly way.
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
        """Terminate all processes, kill those that do not end in time, and start no more."""
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
    """Send a signal to a running process and the processes that it started."""
    if process.poll() is not None:
        return
    with suppress(ProcessLookupError, PermissionError):
        if os.name == "posix":
            os.killpg(process.pid, signal.Signals[name])
        else:
            process.kill()


class CommandFailedError(Exception):
    """A `colmap-av1` command failed.

    Attributes:
        failure: the reason.
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
    """Run a `colmap-av1` command and read its report.

    Args:
        words: the command and its options.
        scratch: its working folder.
        names: paths of unfinished work, and the names that replace them in texts.
        timeout: seconds after which the command is stopped; None: never.
        processes: runs the command.

    Returns:
        The content of --report_json, and the warnings.

    Raises:
        CommandFailedError: the command failed.
    """

    def renamed(text: str) -> str:
        for path, name in names.items():
            text = text.replace(path, name)
        return without_secrets(text)

    log, written = scratch / "log", scratch / "report.json"
    status = processes.run([*words, f"--report_json={written}"], scratch, log, timeout)
    with log.open("rb") as file:
        file.seek(max(0, log.stat().st_size - _MOST_PRINTED))
        printed = renamed(file.read().decode("utf-8", "backslashreplace"))
    facts: Any = {}
    with suppress(OSError, ValueError):
        facts = plain(json.loads(written.read_bytes()), renamed)
    if status == 0 and "report" in facts:
        return facts, _WARNING.findall(printed)
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
    errors = _ERROR.findall(printed)
    if errors:  # The command could not write its report.
        raise CommandFailedError(Failure("reading or writing", errors[-1], transient=True))
    last = printed.strip().rpartition("\n")[2]
    raise CommandFailedError(Failure("defect", last or f"its process ended with status {status}"))

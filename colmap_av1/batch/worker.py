"""A process that attempts one video after another; what ends it ends no other."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from colmap_av1.batch.attempt import attempt
from colmap_av1.batch.files import without_secrets
from colmap_av1.batch.jobs import Ended, Job, Outcome, Row, Work
from colmap_av1.batch.outputs import remove_unused_scratch, scratch_of_process
from colmap_av1.util.memory import resident_memory
from colmap_av1.util.processes import bound

# A process is replaced after so many videos, for what libraries do not give back.
_READY = "ready"
_VIDEOS_OF_PROCESS = 100
_LOOK = 0.25  # seconds between looks at its memory
_END = 5.0  # seconds
_CHILD = """
import sys
sys.path[:] = filter(None, sys.path)
from colmap_av1.batch.worker import serve
serve(sys.argv[1])
"""
# What the system or an operator sends, in contrast to what a process does to itself.
_SENT = (signal.SIGTERM, getattr(signal, "SIGKILL", signal.SIGTERM))


class Worker:
    """Runs attempts in a process of its own, which is started again where it ended."""

    def __init__(self, scratch: str) -> None:
        self._scratch = scratch
        self._process: subprocess.Popen[bytes] | None = None
        self._num_videos = 0
        self._closed = False

    def run(self, work: Work, job: Job) -> Outcome:
        """Attempt a video; whatever happens to the process is a row."""
        start = time.perf_counter()
        stopped: list[str] = []
        try:
            process = self._running()
            assert process.stdin is not None
            assert process.stdout is not None
            with _watched(process, work, job, stopped):
                pickle.dump((work, job), process.stdin)
                process.stdin.flush()
                outcome: Outcome = pickle.load(process.stdout)
        except (EOFError, OSError, pickle.UnpicklingError) as error:
            row = Row(job.name, without_secrets(str(job.source)), "failed")
            ended = self._fault(error, stopped, work, row)
            seconds = round(time.perf_counter() - start, 3)
            return Ended(_with_seconds(ended.row, seconds), False, ended.passing, ended.starved)
        self._num_videos += 1
        if self._num_videos >= _VIDEOS_OF_PROCESS or (isinstance(outcome, Ended) and outcome.spent):
            self._end()
        return outcome

    def close(self) -> None:
        """End the process at once; an attempt that runs ends as a failure."""
        self._closed = True
        self._end()

    def _running(self) -> subprocess.Popen[bytes]:
        if self._closed:
            raise EOFError
        if self._process is None or not _answers(self._process):
            self._end()
            path = os.pathsep.join([str(Path(__file__).resolve().parents[2]), *sys.path])
            self._process = subprocess.Popen(
                bound([sys.executable, "-c", _CHILD, self._scratch]),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                env={**os.environ, "PYTHONPATH": path},
                # The interrupt of a terminal is for the driver, and programs that an attempt runs
                # end with it.
                start_new_session=True,
            )
            self._num_videos = 0
        return self._process

    def _fault(self, error: Exception, stopped: list[str], work: Work, row: Row) -> Ended:
        """What became of an attempt whose process ended."""
        process, status = self._process, None
        if process is not None:
            with suppress(subprocess.TimeoutExpired):
                status = process.wait(_END)
        self._end()
        if "timeout" in stopped:
            text = f"stopped after {work.timeout:g} seconds: give a longer --timeout"
            return Ended(_failed(row, "timeout", text), passing=True)
        if "memory" in stopped:
            text = "stopped, as it took more memory than was reserved: give more --memory"
            return Ended(_failed(row, "memory", text), passing=work.memory is None, starved=True)
        if isinstance(error, OSError) and status is None:
            return Ended(_failed(row, "killed", f"no process can be started: {error}"), True)
        if status is not None and -status in _SENT:
            name = signal.Signals(-status).name
            return Ended(_failed(row, "killed", f"its process was ended by {name}"), passing=True)
        how = f"by signal {-status}" if status is not None and status < 0 else f"({status})"
        return Ended(_failed(row, "crashed", f"its process ended {how}: please report the video"))

    def _end(self) -> None:
        process, self._process = self._process, None
        if process is None:
            return
        _kill(process)
        process.wait()
        remove_unused_scratch(self._scratch)


def serve(scratch: str) -> None:
    """Attempt the videos that come on standard input; outcomes go to standard output."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    channel = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # libraries may print
    with scratch_of_process(scratch) as folder:
        for given in _requests(sys.stdin.buffer):
            pickle.dump(_READY if given is None else attempt(*given, folder), channel)
            channel.flush()


def _requests(file: BinaryIO) -> Iterator[tuple[Work, Job] | None]:
    """What is to be attempted; None where it is only asked whether the process is there."""
    while True:
        try:
            yield pickle.load(file)
        except EOFError:
            return


def _answers(process: subprocess.Popen[bytes]) -> bool:
    """Whether a process that waits for a video is still there: one killed meanwhile is no fault."""
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        pickle.dump(None, process.stdin)
        process.stdin.flush()
        return bool(pickle.load(process.stdout) == _READY)
    except (EOFError, OSError, pickle.UnpicklingError):
        return False


@contextmanager
def _watched(
    process: subprocess.Popen[bytes], work: Work, job: Job, stopped: list[str]
) -> Iterator[None]:
    """End the process where the body takes too long, or the process too much memory.

    Args:
        process: the process.
        work: says how long that is.
        job: says how much memory was reserved.
        stopped: gets the reason.
    """
    finished = threading.Event()
    most = work.memory if work.memory is not None else 2 * job.needs.memory
    end = time.monotonic() + work.timeout if work.timeout is not None else float("inf")

    def watch() -> None:
        while not finished.wait(min(_LOOK, max(0.0, end - time.monotonic()))):
            late = time.monotonic() >= end
            if late or resident_memory(process.pid) > most:
                stopped.append("timeout" if late else "memory")
                _kill(process)
                return

    watching = threading.Thread(target=watch, daemon=True)
    watching.start()
    try:
        yield
    finally:
        finished.set()
        watching.join()


def _kill(process: subprocess.Popen[bytes]) -> None:
    """End a process and the programs that it runs."""
    if process.poll() is not None and os.name != "posix":
        return
    with suppress(ProcessLookupError, PermissionError):
        if os.name == "posix":
            os.killpg(process.pid, signal.SIGKILL)
        else:
            process.kill()


def _failed(row: Row, reason: str, text: str) -> Row:
    return Row(row.name, row.input, "failed", reason, error=text)


def _with_seconds(row: Row, seconds: float) -> Row:
    return Row(row.name, row.input, row.state, row.reason, seconds, error=row.error)

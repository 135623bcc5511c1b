"""Measuring the time and memory of a function call in a separate process."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, Generic, TypeVar

from colmap_av1.errors import ColmapAv1Error, EvaluationError
from colmap_av1.util.cpus import cpu_seconds
from colmap_av1.util.processes import bind
from colmap_av1.util.signals import held_back, let_through

_Result = TypeVar("_Result")


@dataclass(frozen=True)
class Measured(Generic[_Result]):
    """Result and cost of a call.

    Attributes:
        result: the return value.
        seconds: wall time.
        cpu_seconds: CPU time of all threads and of all child processes that have ended.
        peak_memory: largest resident memory in bytes of the process or of one of these children,
            including the interpreter and libraries; None if the system does not report it.
    """

    result: _Result
    seconds: float
    cpu_seconds: float
    peak_memory: int | None


def run_measured(function: Callable[..., _Result], *args: Any, log: Path) -> Measured[_Result]:
    """Call a function in a new process, so that its figures include nothing else.

    Args:
        function: a function; it, its arguments and its result must be picklable.
        args: its arguments.
        log: file that gets the output of the function and its libraries.

    Raises:
        ColmapAv1Error: the function raised it.
        EvaluationError: the function raised another error or its process died; see the log.
    """
    # Spawned, not forked: a forked process inherits locks and the peak memory of its parent.
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_call, args=(os.getpid(), sender, log, function, args))
    if os.name == "posix":
        resource_tracker.ensure_running()  # Starting it later would unblock signals.
    try:
        with held_back():  # An interrupt would make the starting process print a traceback.
            process.start()
        sender.close()
        outcome = receiver.recv()
    except EOFError:
        outcome = None
    except BaseException:
        _end(process)
        raise
    finally:
        if process.pid is not None:
            process.join()
        receiver.close()
    if isinstance(outcome, ColmapAv1Error):
        raise outcome
    if not isinstance(outcome, Measured):
        what = outcome or f"its process ended with status {process.exitcode}"
        raise EvaluationError(f"{what}: see {log}")
    return outcome


def _end(process: BaseProcess) -> None:
    """Kill a process and the processes that it started."""
    if process.pid is None:
        return
    if hasattr(os, "killpg"):
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
    process.kill()  # pycolmap prints a stack trace on SIGTERM.


def _call(
    starter: int,
    sender: Connection,
    log: Path,
    function: Callable[..., Any],
    args: tuple[Any, ...],
) -> None:
    bind(starter)
    if hasattr(os, "setpgid"):
        os.setpgid(0, 0)
    # pycolmap would also log to files in the temporary folder. It is not imported for this, because
    # the function may import torch, and the two crash in one process.
    pycolmap = sys.modules.get("pycolmap")
    if pycolmap is not None:
        pycolmap.logging.logtostderr = True
    with log.open("ab") as file:
        # C++ libraries write to the file descriptors, not to sys.stdout and sys.stderr.
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    let_through()
    outcome: Measured[Any] | ColmapAv1Error | str
    start, cpu = time.perf_counter(), cpu_seconds()
    try:
        result = function(*args)
        outcome = Measured(result, time.perf_counter() - start, cpu_seconds() - cpu, _peak_memory())
    except ColmapAv1Error as error:
        outcome = error
    except Exception as error:
        sys.excepthook(type(error), error, error.__traceback__)
        outcome = f"{type(error).__name__}: {error}"
    sender.send(outcome)
    sender.close()


def _peak_memory() -> int | None:
    # On Linux, ru_maxrss includes the peak of the parent process, VmHWM does not.
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                # A child's peak is at least the size of this process when it started the child.
                return max(int(line.split()[1]), _peak_of_children()) * 1024
    if sys.platform == "darwin":
        import resource  # noqa: PLC0415 - not available on Windows

        own = int(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
        return max(own, _peak_of_children())
    return None


def _peak_of_children() -> int:
    import resource  # noqa: PLC0415 - not available on Windows

    return int(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)

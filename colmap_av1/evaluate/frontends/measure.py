"""Time and memory of a call, in a process of its own."""

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
    """What a call returned and what it took.

    Attributes:
        result: what it returned.
        seconds: wall time.
        cpu_seconds: CPU time of all its threads and of the processes it waited for.
        peak_memory: largest resident memory of its process, or of one it waited for, in bytes,
            the interpreter and its libraries included; None where the system does not report it.
    """

    result: _Result
    seconds: float
    cpu_seconds: float
    peak_memory: int | None


def run_measured(function: Callable[..., _Result], *args: Any, log: Path) -> Measured[_Result]:
    """Call a function in a fresh process, so that nothing else counts towards its figures.

    Args:
        function: a function that can be pickled, as its arguments and its result can.
        args: its arguments.
        log: file that gets what it and its libraries print.

    Raises:
        ColmapAv1Error: the one the function raised.
        EvaluationError: it failed otherwise, or its process died; the log says more.
    """
    # Fresh, not forked: a fork has the parent's threads' locks and its peak memory.
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_call, args=(os.getpid(), sender, log, function, args))
    if os.name == "posix":
        resource_tracker.ensure_running()  # its start lets interrupts through
    try:
        with held_back():  # while it starts an interrupt would be answered by a trace of its own
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
    """End a process, and those it started."""
    if process.pid is None:
        return
    if hasattr(os, "killpg"):
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
    process.kill()  # pycolmap would answer SIGTERM with a stack trace


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
    with log.open("ab") as file:
        # Libraries write to the descriptors, not to sys.stdout and sys.stderr.
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
    # Linux's ru_maxrss keeps the peak of the process that started this one.
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                # A process it waited for counts from this one's size at its start, not below.
                return max(int(line.split()[1]), _peak_of_children()) * 1024
    if sys.platform == "darwin":
        import resource  # noqa: PLC0415 - there is none on Windows

        own = int(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
        return max(own, _peak_of_children())
    return None


def _peak_of_children() -> int:
    import resource  # noqa: PLC0415 - there is none on Windows

    return int(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)

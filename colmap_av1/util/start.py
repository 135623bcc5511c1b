"""The first instants of the program: signals end it at once, and standard streams are open.

The package imports this first, and it imports little itself: until then Python answers an
interrupt with a trace. It does nothing to other programs that import the package.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

_SCRIPTS = ("colmap-av1", "colmap-av1.exe")
_MODULE = "colmap_av1"
# Some systems have no SIGHUP.
ENDING = [getattr(signal, n) for n in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, n)]
# As OpenBLAS reads it when it is loaded.
BLAS_THREADS = "OPENBLAS_NUM_THREADS"
# What is ignored, as nohup asks for, stays ignored.
HEEDED = (signal.SIG_DFL, signal.default_int_handler)


def end_at_once(number: int, _: object) -> None:
    """A handler that ends the process."""
    os._exit(128 + number)


def is_program() -> bool:
    """Whether this process is the command line: a process that it starts is none."""
    first = next(iter(getattr(sys, "argv", ())), "")
    if first == "-m":  # as long as the module is looked for
        return _MODULE in sys.orig_argv
    return os.path.basename(first) in _SCRIPTS and first in sys.orig_argv


@contextmanager
def held_back() -> Iterator[None]:
    """Let signals that end the process wait until the body is done.

    Processes that are started meanwhile hold them back, too, until they call `let_through`.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def handlers_kept() -> Iterator[None]:
    """Undo what the body does to the handlers of signals that end a process."""
    before = {number: signal.getsignal(number) for number in ENDING}
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            for number, handler in before.items():
                signal.signal(number, handler)


def let_through() -> None:
    """Take the signals that the process which started this one held back."""
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDING)


@contextmanager
def _one_blas_thread() -> Iterator[None]:
    """Let NumPy, if it is loaded in the body, start one thread for its matrix products."""
    if BLAS_THREADS in os.environ:
        yield
        return
    os.environ[BLAS_THREADS] = "1"
    try:
        yield
    finally:
        del os.environ[BLAS_THREADS]  # programs that are started have their own


def import_pycolmap() -> None:
    """Import pycolmap, and take back the signals for which it installs a handler of its own.

    That one prints a stack trace of C++, and may hang. NumPy's threads would wait in a loop.
    """
    with held_back(), handlers_kept(), _one_blas_thread():
        import numpy as np  # noqa: F401, PLC0415 - before pycolmap
        import pycolmap  # noqa: F401, PLC0415


def open_closed_streams() -> None:
    """Open standard streams that are closed, so that no file of a user gets their descriptors.

    What libraries print would end in it. Output that is closed stays one that cannot be written,
    messages go nowhere.
    """
    for name, how in (("stdin", os.O_RDONLY), ("stdout", os.O_RDONLY), ("stderr", os.O_WRONLY)):
        if getattr(sys, name) is None:
            descriptor = os.open(os.devnull, how)  # the lowest that is free
            os.set_inheritable(descriptor, True)
            mode = "r" if name == "stdin" else "w"
            stream = os.fdopen(descriptor, mode, encoding="utf-8", closefd=False)
            setattr(sys, name, stream)


if is_program():
    for _number in ENDING:
        if signal.getsignal(_number) in HEEDED:
            signal.signal(_number, end_at_once)
    open_closed_streams()

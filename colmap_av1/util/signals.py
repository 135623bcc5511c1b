"""Signals that end the program: at once while it starts and leaves, in order while it works.

The package imports this first. It does nothing to other programs that import the package.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import types
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn

_SCRIPTS = ("colmap-av1", "colmap-av1.exe")
_MODULE = "colmap_av1"
_INTERRUPT = int(signal.SIGINT)
# Some systems have no SIGHUP.
_NUMBERS = [getattr(signal, n) for n in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, n)]
# What is ignored, as nohup asks for, stays ignored.
_HEEDED = (signal.SIG_DFL, signal.default_int_handler)


@contextmanager
def ending_in_order() -> Iterator[None]:
    """Let the signals that end a process unwind the body, so that nothing half-written is left.

    Raises:
        KeyboardInterrupt: the process is interrupted.
        SystemExit: a signal ends it.
    """
    before = {}
    if threading.current_thread() is threading.main_thread():
        heeded = (*_HEEDED, _end_at_once)
        handlers = {number: signal.getsignal(number) for number in _NUMBERS}
        before = {number: old for number, old in handlers.items() if old in heeded}
    for number in before:
        signal.signal(number, signal.default_int_handler if number == _INTERRUPT else _unwind)
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)


def _unwind(number: int, _: types.FrameType | None) -> NoReturn:
    raise SystemExit(128 + number)


def _end_at_once(number: int, _: types.FrameType | None) -> NoReturn:
    os._exit(128 + number)


def _is_program() -> bool:
    """Whether this process is the command line: a process that it starts is none."""
    first = next(iter(getattr(sys, "argv", ())), "")
    if first == "-m":  # as long as the module is looked for
        return _MODULE in sys.orig_argv
    return os.path.basename(first) in _SCRIPTS and first in sys.orig_argv


if _is_program():
    for _number in _NUMBERS:
        if signal.getsignal(_number) in _HEEDED:
            signal.signal(_number, _end_at_once)

"""Signals that end a process: held back, kept from libraries, and turned into exceptions."""

from __future__ import annotations

import os
import signal
import threading
import types
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn

# Some systems have no SIGHUP.
ENDING = [getattr(signal, n) for n in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, n)]
# Handlers that may be replaced. A signal that is ignored, as nohup asks for, stays ignored.
HEEDED = (signal.SIG_DFL, signal.default_int_handler)
_INTERRUPT = int(signal.SIGINT)


def end_at_once(number: int, _: object) -> None:
    """A handler that ends the process."""
    os._exit(128 + number)


@contextmanager
def ending_in_order() -> Iterator[None]:
    """Let the signals that end a process unwind the body, so that nothing half-written is left.

    Raises:
        KeyboardInterrupt: the process is interrupted.
        SystemExit: a signal ends it.
    """
    before = {}
    if threading.current_thread() is threading.main_thread():
        heeded = (*HEEDED, end_at_once)
        handlers = {number: signal.getsignal(number) for number in ENDING}
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


def let_through() -> None:
    """Take the signals that the process which started this one held back."""
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDING)


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

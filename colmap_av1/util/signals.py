"""Signals that end a process: delay them, keep libraries from handling them, raise exceptions."""

from __future__ import annotations

import os
import signal
import threading
import types
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn

# Windows has no SIGHUP.
ENDING = [getattr(signal, n) for n in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, n)]
# Handlers that may be replaced. A signal that is ignored, as by nohup, stays ignored.
HEEDED = (signal.SIG_DFL, signal.default_int_handler)
_INTERRUPT = int(signal.SIGINT)


def end_at_once(number: int, _: object) -> None:
    """A signal handler that ends the process immediately."""
    os._exit(128 + number)


@contextmanager
def ending_in_order() -> Iterator[None]:
    """Let signals that end the process raise exceptions, so that the body can clean up.

    Raises:
        KeyboardInterrupt: the process was interrupted.
        SystemExit: another signal ends the process.
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
    """Delay signals that end the process until the body is done.

    Processes that the body starts delay them, too, until they call `let_through`.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)
    # Another thread may still receive them, and the main thread then calls their handlers.
    received: list[int] = []
    handlers = {}
    if threading.current_thread() is threading.main_thread():
        found = {number: signal.getsignal(number) for number in ENDING}
        handlers = {number: handler for number, handler in found.items() if callable(handler)}
    for number in handlers:
        signal.signal(number, lambda number, _: received.append(number))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for number in received[:1]:
            signal.raise_signal(number)


def let_through() -> None:
    """Receive signals again after the parent process started this one in `held_back`."""
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDING)


@contextmanager
def handlers_kept() -> Iterator[None]:
    """Restore the handlers of signals that end the process after the body has changed them."""
    before = {number: signal.getsignal(number) for number in ENDING}
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            for number, handler in before.items():
                signal.signal(number, handler)

"""Signals that end the program in order while it works; `start` ends it before and after."""

from __future__ import annotations

import signal
import threading
import types
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn

from colmap_av1.util.start import ENDING, HEEDED, end_at_once

_INTERRUPT = int(signal.SIGINT)


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

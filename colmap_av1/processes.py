"""Processes that end with the one that started them."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from collections.abc import Sequence

_SET_PARENT_DEATH_SIGNAL = 1  # PR_SET_PDEATHSIG of prctl(2)
# A program that becomes another. Linux then ends that one with the process that started it, even
# where that is killed and cannot.
_BOUND = """
import ctypes, os, signal, sys
starter, *command = sys.argv[1:]
ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
if os.getppid() == int(starter):
    os.execvp(command[0], command)
"""


def bound(command: Sequence[str]) -> list[str]:
    """The words of a process that ends with this one, even where this one is killed.

    The thread that starts it must not end before it. Only Linux can do that; elsewhere these are
    the words given.
    """
    if sys.platform != "linux" or not sys.executable:
        return list(command)
    return [sys.executable, "-I", "-S", "-c", _BOUND, str(os.getpid()), *command]


def bind(starter: int) -> None:
    """End this process with the one that started it, even where that one is killed.

    Args:
        starter: its process id. The thread of it that started this one must not end before.
    """
    if sys.platform != "linux":
        return
    ctypes.CDLL(None).prctl(_SET_PARENT_DEATH_SIGNAL, signal.SIGKILL)
    if os.getppid() != starter:
        os.kill(os.getpid(), signal.SIGKILL)

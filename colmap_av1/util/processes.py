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
# A program that runs a command and ends with the process that started it, as does all that the
# command started: the system would only end the command.
_GROUP = """
import ctypes, os, signal, subprocess, sys
starter, *command = sys.argv[1:]
def end(*_):
    os.killpg(0, signal.SIGKILL)
os.setpgid(0, 0)
signal.signal(signal.SIGTERM, end)
ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG
if os.getppid() != int(starter):
    end()
try:
    status = subprocess.call(command)
except OSError as error:
    sys.exit(f"{command[0]}: {error.strerror}")
signal.signal(signal.SIGTERM, signal.SIG_IGN)
os.killpg(0, signal.SIGTERM)  # what the command left in the background
sys.exit(status if status >= 0 else 128 - status)
"""


def bound(command: Sequence[str]) -> list[str]:
    """The words of a process that ends with this one, even where this one is killed.

    The thread that starts it must not end before it. Only Linux can do that; elsewhere these are
    the words given.
    """
    if not _can_bind():
        return list(command)
    return [sys.executable, "-I", "-S", "-c", _BOUND, str(os.getpid()), *command]


def bound_group(command: Sequence[str]) -> list[str]:
    """The same, for a command and all that it starts, which ends with the command, too."""
    if not _can_bind():
        return list(command)
    return [sys.executable, "-I", "-S", "-c", _GROUP, str(os.getpid()), *command]


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


def _can_bind() -> bool:
    return sys.platform == "linux" and bool(sys.executable)

"""Child processes that end when their parent process ends."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from collections.abc import Sequence

_SET_PARENT_DEATH_SIGNAL = 1  # PR_SET_PDEATHSIG of prctl(2)
# A program that asks Linux to end it with its parent, even if the parent is killed, and then
# becomes the command.
_BOUND = """
import ctypes, os, signal, sys
starter, *command = sys.argv[1:]
signal.pthread_sigmask(signal.SIG_SETMASK, [])  # signals may be blocked while a process starts
ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
if os.getppid() == int(starter):
    os.execvp(command[0], command)
"""
# A program that runs a command in a process group and ends the whole group with its parent. The
# system alone would only end the command, not what the command started.
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
    """A command line that ends with this process, even if this process is killed.

    The thread that starts it must not end before it. Only Linux can do that; on other systems the
    command is returned unchanged.
    """
    if not _can_bind():
        return list(command)
    return [sys.executable, "-I", "-S", "-c", _BOUND, str(os.getpid()), *command]


def bound_group(command: Sequence[str]) -> list[str]:
    """Like `bound`, for a command and all processes that it starts.

    What the command left running ends when the command ends.
    """
    if not _can_bind():
        return list(command)
    return [sys.executable, "-I", "-S", "-c", _GROUP, str(os.getpid()), *command]


def bind(starter: int) -> None:
    """End this process when the process that started it ends, even if that is killed.

    Args:
        starter: ID of that process. The thread that started this process must not end before it.
    """
    if sys.platform != "linux":
        return
    ctypes.CDLL(None).prctl(_SET_PARENT_DEATH_SIGNAL, signal.SIGKILL)
    if os.getppid() != starter:
        os.kill(os.getpid(), signal.SIGKILL)


def _can_bind() -> bool:
    return sys.platform == "linux" and bool(sys.executable)

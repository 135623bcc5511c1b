"""Memory that this process may use."""

from __future__ import annotations

import ctypes
import os
from contextlib import suppress
from pathlib import Path

_CGROUPS = Path("/sys/fs/cgroup")
_UNKNOWN = 8 << 30
_SPARE = 1 << 26  # bytes


def usable_memory() -> int:
    """Bytes of memory that this process and its child processes may use together.

    Containers and cluster queues may allow less than the machine has.
    """
    limits = [_machine_memory()]
    with suppress(OSError):
        for line in Path("/proc/self/cgroup").read_text().splitlines():
            _, controllers, path = line.split(":", 2)
            group = _CGROUPS / (controllers and "memory") / path.lstrip("/")
            name = "memory.limit_in_bytes" if controllers else "memory.max"
            if controllers and "memory" not in controllers.split(","):
                continue
            for folder in (group, *group.parents):
                if folder.is_relative_to(_CGROUPS):
                    with suppress(OSError, ValueError):
                        limits.append(int((folder / name).read_text()))
    return min(limits)


def _machine_memory() -> int:
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):  # Windows
        return _UNKNOWN


def check_memory(error: BaseException) -> None:
    """Check that an error of a library that reads a file is not for a lack of memory.

    FFmpeg and SQLite give the same error for a damaged file that declares an impossible size.

    Raises:
        MemoryError: little memory is left.
    """
    if isinstance(error, MemoryError):
        bytearray(_SPARE)


def give_back_free_memory() -> None:
    """Return freed memory to the system, which the GNU C library does not do on its own.

    It keeps the memory of freed arrays of up to 32 MiB, which can be more than the memory in use.
    """
    # Other C libraries have no malloc_trim.
    with suppress(OSError, TypeError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)

"""Memory use of processes."""

from __future__ import annotations

import platform
import subprocess
import sys
from pathlib import Path

import pytest

from colmap_av1.util.memory import give_back_free_memory

_MEGABYTE = 1 << 20
# Frees every second of some arrays of 1 MB after larger ones; the C library keeps such memory.
_FREED = """
import os
from pathlib import Path
from colmap_av1.util.memory import give_back_free_memory
def resident_memory():
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
large = bytearray(30 << 20)
del large
held = [bytearray(os.urandom(1 << 20)) for _ in range(200)]
last = bytearray(1000)
small = held[1::2]
del held
before = resident_memory()
give_back_free_memory()
print(before - resident_memory())
"""


@pytest.mark.skipif(
    platform.libc_ver()[0] != "glibc", reason="other C libraries return memory themselves"
)
def test_free_memory_is_returned_to_the_system(tmp_path: Path) -> None:
    run = [sys.executable, "-c", _FREED]
    # Run in another folder, because the sources in the working folder lack the extension.
    done = subprocess.run(run, capture_output=True, text=True, check=True, cwd=tmp_path)
    assert int(done.stdout) > 50 * _MEGABYTE
    give_back_free_memory()  # does nothing if there is none

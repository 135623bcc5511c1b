"""Memory of processes."""

from __future__ import annotations

import platform
import subprocess
import sys
from pathlib import Path

import pytest

from colmap_av1.util.memory import give_back_free_memory

_MEGABYTE = 1 << 20
# Arrays of a megabyte, every second of which is freed once larger ones have been: C keeps them.
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


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries do it themselves")
def test_free_memory_goes_back(tmp_path: Path) -> None:
    run = [sys.executable, "-c", _FREED]
    # From elsewhere: the sources in the working folder have no core.
    done = subprocess.run(run, capture_output=True, text=True, check=True, cwd=tmp_path)
    assert int(done.stdout) > 50 * _MEGABYTE
    give_back_free_memory()  # nothing to give back is no error

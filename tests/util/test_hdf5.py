from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from colmap_av1.util.hdf5 import new_hdf5

FILL_THE_DISK = """
import resource, sys
import numpy as np
from pathlib import Path
from colmap_av1.util.hdf5 import new_hdf5
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
rng = np.random.default_rng(0)
try:
    with new_hdf5(Path(sys.argv[1])) as write:
        for i in range(1000):
            write(f"{i}/a", rng.random(int(sys.argv[2])), compression="gzip")
except OSError as error:
    print(i, error.strerror)
"""


def test_hdf5_groups_and_datasets_are_written(tmp_path: Path) -> None:
    for name in ("a", "b"):
        with new_hdf5(tmp_path / name) as write:
            write("x/y/z", np.arange(70_000)).attrs["unit"] = 2.0
            write("x/one", 3)
    with h5py.File(tmp_path / "a") as file:
        assert file["x/y/z"][-1] == 69_999
        assert file["x/y/z"].attrs["unit"] == 2
        assert file["x/one"][()] == 3
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


@pytest.mark.skipif(sys.platform == "win32", reason="file sizes cannot be limited there")
@pytest.mark.parametrize("size", [2, 50, 5000, 100_000])
def test_full_disk_is_reported(size: int, tmp_path: Path) -> None:
    command = [sys.executable, "-c", FILL_THE_DISK, str(tmp_path / "a"), str(size)]
    run = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert run.returncode == 0
    assert run.stdout.endswith("File too large\n")
    assert run.stderr == ""

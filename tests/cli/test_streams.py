"""Standard streams that are closed, full or not read: one line or none, and status 2 or 141."""

from __future__ import annotations

import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from colmap_av1.motion.motion_file import export_motion

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="other shells and devices there")

# Exit status and number of lines of errors.
CASES = {
    "--version >&-": (2, 1),
    "--version >/dev/full": (2, 1),
    "--version 2>&- >&- <&-": (2, 0),
    "match --help-all | true": (141, 0),
    "info --video none.mp4 2>/dev/full": (2, 0),
    "info --vdeo none.mp4 2>/dev/full": (2, 0),
    "motion --video v.mp4 --output m.npz --quiet <&- >&- 2>&-": (0, 0),
}


def test_broken_streams(clip: Path, tmp_path: Path) -> None:
    """All at once: each takes longer to start than to run."""
    shutil.copyfile(clip, tmp_path / "v.mp4")
    program = shlex.join([sys.executable, "-m", "colmap_av1"])
    started = {}
    for case in CASES:
        line = f"set -o pipefail; {program} {case}"
        started[case] = subprocess.Popen(
            ["bash", "-c", line],
            cwd=tmp_path,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
    found = {}
    for case, process in started.items():
        _, said = process.communicate(timeout=120)
        assert "Traceback" not in said
        found[case] = (process.returncode, said.count("\n"))
    assert found == CASES
    # What a library printed would have ended in a file that got a closed stream's number.
    export_motion(clip, tmp_path / "again.npz")
    assert (tmp_path / "m.npz").read_bytes() == (tmp_path / "again.npz").read_bytes()

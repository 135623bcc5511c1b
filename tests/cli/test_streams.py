"""With closed, full or unread standard streams, commands print at most one line and fail."""

from __future__ import annotations

import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from colmap_av1.motion.motion_file import export_motion

pytestmark = pytest.mark.skipif(
    sys.platform != "linux", reason="shells and devices are different there"
)

# Exit status and number of error lines.
CASES = {
    "--version >&-": (2, 1),
    "--version >/dev/full": (2, 1),
    "--version 2>&- >&- <&-": (2, 0),
    "match --help-all | true": (141, 0),
    "info --video none.mp4 2>/dev/full": (2, 0),
    "info --vdeo none.mp4 2>/dev/full": (2, 0),
    "motion --video v.mp4 --output m.npz --quiet <&- >&- 2>&-": (0, 0),
}


def test_broken_streams_give_at_most_one_line(clip: Path, tmp_path: Path) -> None:
    """The commands run in parallel, because starting takes most of the time."""
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
        _, error = process.communicate(timeout=120)
        assert "Traceback" not in error
        found[case] = (process.returncode, error.count("\n"))
    assert found == CASES
    # Output of a library could end up in a file that got the number of a closed stream.
    export_motion(clip, tmp_path / "again.npz")
    assert (tmp_path / "m.npz").read_bytes() == (tmp_path / "again.npz").read_bytes()

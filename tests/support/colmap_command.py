"""Runs the colmap command, if it is installed."""

from __future__ import annotations

import os
import shutil
import subprocess

import pytest

COLMAP = shutil.which("colmap")
needs_colmap = pytest.mark.skipif(COLMAP is None, reason="no colmap command on PATH")


def colmap(*words: object) -> None:
    """Run the command with these arguments, without a display."""
    subprocess.run(
        [str(COLMAP), *map(str, words)],
        check=True,
        capture_output=True,
        env={**os.environ, "QT_QPA_PLATFORM": "offscreen"},
    )

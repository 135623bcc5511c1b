"""Renders pages in headless Chromium, without a network."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

_PROGRAM = shutil.which("chromium")
_SIZE = (1400, 2000)


@dataclass(frozen=True)
class Shown:
    """A page rendered by Chromium.

    Attributes:
        picture: uint8 [height, width, 3] BGR screenshot.
        errors: lines of the console, except a harmless one.
    """

    picture: NDArray[np.uint8]
    errors: list[str]


def show(page: Path, folder: Path) -> Shown:
    """Render a page; skips the test if Chromium is missing.

    Args:
        page: the HTML file.
        folder: for the browser's own files.
    """
    if _PROGRAM is None:
        pytest.skip("needs chromium (Debian: apt install chromium)")
    screenshot = folder / "screenshot.png"
    words = [
        *(_PROGRAM, "--headless", "--no-sandbox", f"--user-data-dir={folder / 'profile'}"),
        *("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--hide-scrollbars"),
        # Resolve no names, so that pages cannot use the network.
        *("--host-resolver-rules=MAP * ~NOTFOUND", "--enable-logging=stderr"),
        *(f"--window-size={_SIZE[0]},{_SIZE[1]}", "--virtual-time-budget=3000"),
    ]
    done = subprocess.run(
        [*words, f"--screenshot={screenshot}", page.as_uri()],
        capture_output=True,
        text=True,
        check=True,
        timeout=600,
    )
    console = [line for line in done.stderr.splitlines() if ":CONSOLE" in line]
    harmless = "willReadFrequently"  # a performance hint about reading a canvas
    return Shown(
        picture=np.asarray(cv2.imread(str(screenshot)), np.uint8),
        errors=[line for line in console if harmless not in line],
    )

"""Reads databases with pycolmap."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray


def keypoints_of(database: Path) -> dict[str, NDArray[np.float32]]:
    """Keypoints [n, 2] in pixels by image name, in order of image ids."""
    with tempfile.TemporaryDirectory() as folder:
        # pycolmap migrates the database that it opens.
        copy = shutil.copyfile(database, Path(folder) / "copy.db")
        with pycolmap.Database.open(copy) as opened:
            images = sorted(opened.read_all_images(), key=lambda image: int(image.image_id))
            return {i.name: opened.read_keypoints(i.image_id)[:, :2] for i in images}

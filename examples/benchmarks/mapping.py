"""Map databases with pycolmap's incremental mapper and the options that `match` prints."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np  # noqa: F401 - before pycolmap: the other order breaks writing PNG files later
import pycolmap


def map_incrementally(database: Path, images: Path, output: Path, command: str = "") -> None:
    """Make models in a new folder, numbered from 0 in the order in which the mapper makes them.

    Args:
        database: the database; pycolmap migrates it to its own schema.
        images: folder of the images.
        output: the new folder.
        command: a command line for COLMAP's mapper, whose options are used.
    """
    output.mkdir()
    pycolmap.set_random_seed(0)
    how = pycolmap.IncrementalPipelineOptions(random_seed=0)
    for name, value in re.findall(r"--Mapper\.(\S+) (\S+)", command):
        own = how if hasattr(how, name) else how.mapper
        setattr(own, name, type(getattr(own, name))(float(value)))
    pycolmap.incremental_mapping(database, images, output, options=how)

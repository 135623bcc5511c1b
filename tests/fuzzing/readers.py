"""Fuzz targets of the file readers: containers, HDF5, models, databases.

`with_atheris` runs them with coverage guidance; the tests run all of them on damaged seeds.
"""

from __future__ import annotations

import struct
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path

from colmap_av1.check.database import check_database
from colmap_av1.errors import ColmapAv1Error
from colmap_av1.geometry.colmap_model import read_model
from colmap_av1.interop.hloc import read_hloc
from colmap_av1.motion.reading import read_motion
from colmap_av1.options import ReadOptions

_MODEL = ("cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin")


def container(data: bytes, folder: Path) -> None:
    """Read the bytes as a video file, in any format that FFmpeg detects."""
    path = folder / "video"
    path.write_bytes(data)
    options = ReadOptions(num_threads=1, max_frame_size=256 * 256)
    for _ in read_motion(path, options):
        pass


def hdf5(data: bytes, folder: Path) -> None:
    """Read the bytes as a file of features followed by a file of matches."""
    paths = [folder / "features.h5", folder / "matches.h5"]
    for path, part in zip(paths, split(data, 2), strict=True):
        path.write_bytes(part)
    read_hloc(*paths)


def model(data: bytes, folder: Path) -> None:
    """Read the bytes as the five files of a model."""
    for name, part in zip(_MODEL, split(data, len(_MODEL)), strict=True):
        (folder / name).write_bytes(part)
    read_model(folder)


def database(data: bytes, folder: Path) -> None:
    """Read the bytes as a database."""
    path = folder / "a.db"
    path.write_bytes(data)
    check_database(path)
    assert path.read_bytes() == data


TARGETS: dict[str, Callable[[bytes, Path], None]] = {
    "container": container,
    "hdf5": hdf5,
    "model": model,
    "database": database,
}


def joined(parts: list[bytes]) -> bytes:
    """Join files to one input; each is preceded by its length in four bytes."""
    return b"".join(struct.pack("<I", len(part)) + part for part in parts)


def split(data: bytes, count: int) -> list[bytes]:
    """The files of an input; a length beyond the end means the rest."""
    parts = []
    for _ in range(count):
        (length,) = struct.unpack("<I", data[:4].ljust(4, b"\0"))
        parts.append(data[4 : 4 + length])
        data = data[4 + length :]
    return parts


def run(target: str, data: bytes) -> str | None:
    """Run a target; returns its error message of one line, or None if it accepts the input."""
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            TARGETS[target](data, Path(folder))
        except ColmapAv1Error as error:
            message = str(error)
        else:
            return None
    assert "\n" not in message
    return message

"""The layout of the binary files of COLMAP models, and whether these are complete."""

from __future__ import annotations

import mmap
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np

# Records of the files, little-endian and packed.
OBSERVATION = np.dtype([("xy", "<f8", 2), ("point3D_id", "<i8")])
ELEMENT = np.dtype([("image_id", "<u4"), ("point2D_idx", "<u4")])
CAMERA_HEAD = 24
# Sizes in bytes of other parts.
_COUNT = struct.Struct("<Q")
_SHORT_COUNT = struct.Struct("<I")
_SMALLEST_CAMERA = CAMERA_HEAD + 2 * 8  # EQUIRECTANGULAR of COLMAP 4.2: width and height
_IMAGE_HEAD, _POINT_HEAD = 64, 43
_RIG_HEAD, _SENSOR, _POSE = 8, 8, 56
_FRAME_HEAD, _DATA_ID = 8 + _POSE, 16


def are_whole(model: Path) -> bool:
    """Whether a model's binary files contain all records that their counts declare.

    Args:
        model: folder with cameras.bin, images.bin and points3D.bin; rigs.bin and frames.bin of
            COLMAP 3.12 and later are checked if they exist.

    Raises:
        OSError: a file cannot be read.
    """
    files: dict[str, Callable[[mmap.mmap], bool]] = {
        "cameras.bin": _cameras,
        "images.bin": _images,
        "points3D.bin": _points,
        "rigs.bin": _rigs,
        "frames.bin": _frames,
    }
    return all(
        _is_whole(model / name, holds) for name, holds in files.items() if (model / name).exists()
    )


def _is_whole(path: Path, holds: Callable[[mmap.mmap], bool]) -> bool:
    with path.open("rb") as file:
        if path.stat().st_size < _COUNT.size:
            return False
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            try:
                return holds(data)
            except struct.error:  # The file ends before a count.
                return False


def _cameras(data: mmap.mmap) -> bool:
    # The length of a record depends on the camera model; pycolmap checks it.
    (count,) = _COUNT.unpack_from(data)
    return bool(_COUNT.size + count * _SMALLEST_CAMERA <= len(data))


def _images(data: mmap.mmap) -> bool:
    (count,) = _COUNT.unpack_from(data)
    position = _COUNT.size
    for _ in range(count):
        end_of_name = data.find(b"\0", position + _IMAGE_HEAD)
        if end_of_name < 0:
            return False
        (num_points,) = _COUNT.unpack_from(data, end_of_name + 1)
        position = end_of_name + 1 + _COUNT.size + num_points * OBSERVATION.itemsize
        if position > len(data):
            return False
    return True


def _points(data: mmap.mmap) -> bool:
    (count,) = _COUNT.unpack_from(data)
    position, end, each = _COUNT.size, len(data), ELEMENT.itemsize
    unpack = _COUNT.unpack_from  # Saves the look-up for millions of points.
    for _ in range(count):
        (length,) = unpack(data, position + _POINT_HEAD)
        position += _POINT_HEAD + _COUNT.size + length * each
        if position > end:
            return False
    return True


def _rigs(data: mmap.mmap) -> bool:
    (count,) = _COUNT.unpack_from(data)
    position = _COUNT.size
    for _ in range(count):
        (num_sensors,) = _SHORT_COUNT.unpack_from(data, position + _RIG_HEAD - _SHORT_COUNT.size)
        position += _RIG_HEAD + (_SENSOR if num_sensors else 0)
        if position + (num_sensors - 1) * (_SENSOR + 1) > len(data):
            return False
        for _ in range(num_sensors - 1):
            has_pose = data[position + _SENSOR : position + _SENSOR + 1] != b"\0"
            position += _SENSOR + 1 + (_POSE if has_pose else 0)
        if position > len(data):
            return False
    return True


def _frames(data: mmap.mmap) -> bool:
    (count,) = _COUNT.unpack_from(data)
    position = _COUNT.size
    for _ in range(count):
        (num_ids,) = _SHORT_COUNT.unpack_from(data, position + _FRAME_HEAD)
        position += _FRAME_HEAD + _SHORT_COUNT.size + num_ids * _DATA_ID
        if position > len(data):
            return False
    return True

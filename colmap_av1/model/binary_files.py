"""Whether COLMAP's binary model files hold what they declare, before they are read."""

from __future__ import annotations

import mmap
import struct
from collections.abc import Callable
from pathlib import Path

_COUNT = struct.Struct("<Q")
_SHORT_COUNT = struct.Struct("<I")
# Sizes of records in bytes, as COLMAP writes them, packed.
_CAMERA = 24 + 3 * 8  # with the parameters of the smallest model
_IMAGE_HEAD, _OBSERVATION = 64, 24
_POINT_HEAD, _ELEMENT = 43, 8
_RIG_HEAD, _SENSOR, _POSE = 8, 8, 56
_FRAME_HEAD, _DATA_ID = 8 + _POSE, 16

_Data = mmap.mmap


def are_whole(model: Path) -> bool:
    """Whether every count in a model's binary files is of records that are there.

    Args:
        model: folder with cameras.bin, images.bin and points3D.bin; rigs.bin and frames.bin of
            COLMAP 3.12 and later are looked at where they are.

    Raises:
        OSError: a file cannot be read.
    """
    files: dict[str, Callable[[_Data], bool]] = {
        "cameras.bin": _cameras,
        "images.bin": _images,
        "points3D.bin": _points,
        "rigs.bin": _rigs,
        "frames.bin": _frames,
    }
    return all(
        _is_whole(model / name, holds) for name, holds in files.items() if (model / name).exists()
    )


def _is_whole(path: Path, holds: Callable[[_Data], bool]) -> bool:
    with path.open("rb") as file:
        if path.stat().st_size < _COUNT.size:
            return False
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            try:
                return holds(data)
            except struct.error:  # a count lies behind the end
                return False


def _cameras(data: _Data) -> bool:
    # Their lengths depend on their models, which pycolmap checks.
    (count,) = _COUNT.unpack_from(data)
    return bool(_COUNT.size + count * _CAMERA <= len(data))


def _images(data: _Data) -> bool:
    (count,) = _COUNT.unpack_from(data)
    position = _COUNT.size
    for _ in range(count):
        end_of_name = data.find(b"\0", position + _IMAGE_HEAD)
        if end_of_name < 0:
            return False
        (num_points,) = _COUNT.unpack_from(data, end_of_name + 1)
        position = end_of_name + 1 + _COUNT.size + num_points * _OBSERVATION
        if position > len(data):
            return False
    return True


def _points(data: _Data) -> bool:
    (count,) = _COUNT.unpack_from(data)
    position, end = _COUNT.size, len(data)
    unpack = _COUNT.unpack_from  # there may be millions
    for _ in range(count):
        (length,) = unpack(data, position + _POINT_HEAD)
        position += _POINT_HEAD + _COUNT.size + length * _ELEMENT
        if position > end:
            return False
    return True


def _rigs(data: _Data) -> bool:
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


def _frames(data: _Data) -> bool:
    (count,) = _COUNT.unpack_from(data)
    position = _COUNT.size
    for _ in range(count):
        (num_ids,) = _SHORT_COUNT.unpack_from(data, position + _FRAME_HEAD)
        position += _FRAME_HEAD + _SHORT_COUNT.size + num_ids * _DATA_ID
        if position > len(data):
            return False
    return True

"""GoPro's telemetry (GPMF) in the packets of a container: positions and the direction of gravity.

A payload is a tree of items. An item is a key of four letters, a type, the size of an element, the
number of elements, and the elements, padded to 32 bits, all big-endian
(https://github.com/gopro/gpmf-parser). PyAV reads the packets; only a few of the hundreds of GPMF
streams are used here.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_av1.util.arrays import Floats

_HEADER = struct.Struct(">4sBBH")
_NESTED = 0
_COMPLEX = ord("?")
# NumPy types of GPMF's type letters.
_NUMBERS = {
    **{"b": "i1", "B": "u1", "s": ">i2", "S": ">u2", "l": ">i4", "L": ">u4"},
    **{"f": ">f4", "d": ">f8", "j": ">i8", "J": ">u8"},
}
# Limit of nested items; cameras nest two levels, streams in a device.
_MAX_DEPTH = 8
# GPSF, and the last number of GPS9, give the dimensions of the fix, 2 or 3; 0 without a fix.
_MIN_FIX = 2
_NUM_COORDINATES = 3  # latitude, longitude, altitude


@dataclass(frozen=True)
class Payload:
    """The values in a packet.

    Attributes:
        positions: float64 [n, 3] latitude and longitude in degrees, altitude in metres; NaN
            without a fix. They are evenly spaced over the duration of the packet.
        gravity: float64 [m, 3] direction of gravity in camera axes, spaced in the same way.
        read_out: time in seconds from the first row of a picture to the last; None if not given.
    """

    positions: Floats
    gravity: Floats
    read_out: float | None


def read_payload(data: bytes) -> Payload:
    """Read a packet; damaged and truncated items are ignored."""
    positions, gravity = np.empty((0, 3)), np.empty((0, 3))
    read_out: float | None = None
    for stream in _streams(data):
        named = dict(stream)
        for key, values in stream:
            if key == "GPS5":
                positions = _with_fix(_scaled(values, named)[:, :_NUM_COORDINATES], named)
            elif key == "GPS9":
                scaled = _scaled(values, named)
                positions = scaled[:, :_NUM_COORDINATES].copy()
                positions[scaled[:, -1] < _MIN_FIX] = np.nan
            elif key == "GRAV":
                gravity = _scaled(values, named)
            elif key == "SROT" and values.size:  # milliseconds
                read_out = float(values.flat[0]) / 1000
    return Payload(positions, gravity, read_out)


_Stream = list[tuple[str, Floats]]


def _streams(data: bytes, depth: int = 0) -> Iterator[_Stream]:
    """For each innermost item that contains items, their keys and numbers in order."""
    if depth > _MAX_DEPTH:
        return
    found: _Stream = []
    type_of: str | None = None
    for key, kind, size, body in _items(data):
        if kind == _NESTED:
            yield from _streams(body, depth + 1)
        elif key == "TYPE":  # the element types of the next complex item
            type_of = body.rstrip(b"\0").decode("latin1")
        else:
            letters = type_of if kind == _COMPLEX else chr(kind)
            values = _numbers(body, letters, size)
            if values is not None:
                found.append((key, values))
    if found:
        yield found


def _items(data: bytes) -> Iterator[tuple[str, int, int, bytes]]:
    """Key, type, element size and content of each item, up to the first truncated one."""
    at = 0
    while at + _HEADER.size <= len(data):
        key, kind, size, count = _HEADER.unpack_from(data, at)
        at += _HEADER.size
        if at + size * count > len(data):
            return
        yield key.decode("latin1"), kind, size, data[at : at + size * count]
        at += -(-size * count // 4) * 4


def _numbers(body: bytes, letters: str | None, size: int) -> Floats | None:
    """float64 [n, k], n elements of k numbers; None if the elements are not numbers."""
    if not letters or size == 0 or any(letter not in _NUMBERS for letter in letters):
        return None
    kinds = [np.dtype(_NUMBERS[letter]) for letter in letters]
    width = sum(kind.itemsize for kind in kinds)
    if width == 0 or size % width:
        return None
    element = np.dtype([(f"f{i}", kind) for i, kind in enumerate(kinds * (size // width))])
    rows: Any = np.frombuffer(body, dtype=element)
    columns: Sequence[NDArray[Any]] = [
        rows[name].astype(np.float64) for name in element.names or ()
    ]
    return np.column_stack(columns)


def _scaled(values: Floats, named: dict[str, Floats]) -> Any:
    """The numbers in their units: divided by SCAL, which has one divisor or one per column."""
    scale = named.get("SCAL", np.ones(1)).ravel()
    if len(scale) not in (1, values.shape[1]) or not scale.all():
        return np.empty((0, values.shape[1]))
    return values / scale


def _with_fix(positions: Floats, named: dict[str, Floats]) -> Any:
    fix = named.get("GPSF")
    has_fix = fix is None or (fix.size > 0 and fix.flat[-1] >= _MIN_FIX)
    return positions if has_fix else np.full_like(positions, np.nan)

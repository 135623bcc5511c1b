"""Elements of a container that end after the file does: demuxers leave them out silently."""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

_SIMPLE_BLOCK, _BLOCK = b"\xa3", b"\xa1"
# Elements whose content is read as elements of the same level: Segment, Cluster, BlockGroup.
_ENTERED = (b"\x18\x53\x80\x67", b"\x1f\x43\xb6\x75", b"\xa0")
_LONGEST_ID, _LONGEST_SIZE = 4, 8


def is_matroska_cut(path: Path, payload: int) -> bool:
    """Whether a Matroska file ends inside an element after a block.

    Args:
        path: the file.
        payload: position of the payload of the block, as FFmpeg gives it with a packet.
    """
    with path.open("rb") as file:
        size = file.seek(0, 2)
        at = _end_of_block(file, payload)
        while at is not None and at < size:
            file.seek(at)
            head = file.read(_LONGEST_ID + _LONGEST_SIZE)
            length = _vint_length(head, _LONGEST_ID)
            name, rest = head[:length], head[length:]
            if length == 0:
                return False  # no element: nothing is known
            width = _vint_length(rest, _LONGEST_SIZE)
            if len(rest) < max(width, 1):
                return True
            if width == 0:
                return False
            at += length + width
            content = _vint(rest[:width])
            if name in _ENTERED:
                continue
            if content is None:
                return False
            at += content
        return at is not None and at > size


def _end_of_block(file: BinaryIO, payload: int) -> int | None:
    """Where the block with this payload ends; None where there is none."""
    start = max(payload - _LONGEST_SIZE - 1, 0)
    file.seek(start)
    before = file.read(payload - start)
    for width in range(1, min(_LONGEST_SIZE + 1, len(before))):
        size = before[-width:]
        if _vint_length(size, _LONGEST_SIZE) == width and before[-width - 1 : -width] in {
            _SIMPLE_BLOCK,
            _BLOCK,
        }:
            content = _vint(size)
            return None if content is None else payload + content
    return None


def _vint_length(data: bytes, longest: int) -> int:
    """Bytes of the number of variable length that data begins with; 0: it is none."""
    length = 9 - data[0].bit_length() if data else 0
    return length if length <= longest else 0


def _vint(data: bytes) -> int | None:
    """The number of variable length in its bytes; None: unknown."""
    bits = 7 * len(data)
    value = int.from_bytes(data, "big") & ((1 << bits) - 1)
    return None if value == (1 << bits) - 1 else value


def is_fragmented_mp4_cut(path: Path) -> bool:
    """Whether an MP4 file in fragments ends inside a box; a single box `moov` lists its samples."""
    with path.open("rb") as file:
        size = file.seek(0, 2)
        at = 0
        is_fragmented = False
        while at < size:
            file.seek(at)
            head = file.read(16)
            length = int.from_bytes(head[:4], "big")
            is_fragmented |= head[4:8] == b"moof"
            if length == 1:
                length = int.from_bytes(head[8:16], "big")
            if len(head) < 8 or at + length > size:
                return is_fragmented
            if length < 8:  # up to the end of the file, or damaged
                return False
            at += length
        return False

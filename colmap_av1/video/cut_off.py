"""Detect files that end inside an element of their container, which demuxers skip silently."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

_SIMPLE_BLOCK, _BLOCK = b"\xa3", b"\xa1"
# Elements that contain elements: Segment, Cluster, BlockGroup.
_PARENTS = (b"\x18\x53\x80\x67", b"\x1f\x43\xb6\x75", b"\xa0")
_LONGEST_ID, _LONGEST_SIZE = 4, 8


def is_matroska_cut(path: Path, payload: int, packet_size: int) -> bool:
    """Whether a Matroska file ends inside a block or an element after it.

    Args:
        path: the file.
        payload: position in the file of the block's payload, which FFmpeg gives with a packet.
        packet_size: size of that packet in bytes.
    """
    with path.open("rb") as file:
        size = file.seek(0, 2)
        at = _end_of_block(file, payload, packet_size)
        while at is not None and at < size:
            file.seek(at)
            head = file.read(_LONGEST_ID + _LONGEST_SIZE)
            length = _vint_length(head, _LONGEST_ID)
            name, rest = head[:length], head[length:]
            if length == 0:
                return False  # not a Matroska element, so the end cannot be judged
            width = _vint_length(rest, _LONGEST_SIZE)
            if len(rest) < max(width, 1):
                return True
            if width == 0:
                return False
            at += length + width
            content = _vint(rest[:width])
            if name in _PARENTS:
                continue
            if content is None:
                return False
            at += content
        return at is not None and at > size


def _end_of_block(file: BinaryIO, payload: int, packet_size: int) -> int | None:
    """The position where the block with this payload ends; None if no block is found.

    The header is read backwards, so that bytes of its size may look like the beginning of another
    header. The packet's size tells them apart, although a compressed packet may be a little longer
    or shorter than its block.
    """
    start = max(payload - _LONGEST_SIZE - 1, 0)
    file.seek(start)
    before = file.read(payload - start)
    contents = [
        content
        for width in range(1, min(_LONGEST_SIZE + 1, len(before)))
        if before[-width - 1 : -width] in {_SIMPLE_BLOCK, _BLOCK}
        and _vint_length(before[-width:], _LONGEST_SIZE) == width
        and (content := _vint(before[-width:])) is not None
    ]
    if not contents:
        return None
    return payload + min(contents, key=lambda content: abs(content - packet_size))


def _vint_length(data: bytes, longest: int) -> int:
    """Length in bytes of the variable-length integer at the start of `data`; 0 if it is invalid."""
    length = 9 - data[0].bit_length() if data else 0
    return length if length <= longest else 0


def _vint(data: bytes) -> int | None:
    """The value of a variable-length integer; None for the reserved value "unknown"."""
    bits = 7 * len(data)
    value = int.from_bytes(data, "big") & ((1 << bits) - 1)
    return None if value == (1 << bits) - 1 else value


def is_fragmented_mp4(path: Path) -> bool:
    """Whether an MP4 file has fragments, whose samples its index does not list."""
    return any(name == b"moof" for name, _ in _boxes(path))


def is_fragmented_mp4_cut(path: Path) -> bool:
    """Whether a fragmented MP4 file ends inside a box.

    Other MP4 files list their samples in the box `moov`, so missing packets can be counted.
    """
    boxes = list(_boxes(path))
    end = boxes[-1][1] if boxes else None
    is_fragmented = any(name == b"moof" for name, _ in boxes)
    return is_fragmented and end is not None and end > path.stat().st_size


def is_mp4_without_index(path: Path) -> bool:
    """Whether an MP4 file ends before the box that lists its samples, which cameras write last."""
    names = {name for name, _ in _boxes(path)}
    return b"mdat" in names and not names & {b"moov", b"meta"}


def _boxes(path: Path) -> Iterator[tuple[bytes, int | None]]:
    """Type and end of each box of an MP4 file outside other boxes.

    The end is None if the box extends to the end of the file or has an invalid size. It lies behind
    the end of a file that is cut off inside the box.
    """
    with path.open("rb") as file:
        size = file.seek(0, 2)
        at = 0
        while at < size:
            file.seek(at)
            head = file.read(16)
            length = int.from_bytes(head[:4], "big")
            if length == 1:
                length = int.from_bytes(head[8:16], "big")
            if len(head) < 8:
                yield b"", size + 1
                return
            yield head[4:8], at + length if length >= 8 else None
            if length < 8:
                return
            at += length

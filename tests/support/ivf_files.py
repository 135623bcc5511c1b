"""IVF files made of the packets of a clip."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import av

from colmap_av1.video.container import Packet, open_stream


def packets(video: Path) -> Iterator[Packet]:
    """The packets of a video file."""
    with open_stream(video) as stream:
        yield from stream.packets()


def ivf_of(clip: Path) -> bytes:
    found = list(packets(clip))
    body = b"".join(struct.pack("<IQ", len(p.data), p.index) + bytes(p.data) for p in found)
    with av.open(str(clip)) as container:
        size = container.streams.video[0].width, container.streams.video[0].height
    head = struct.pack("<4sHH4sHHIIII", b"DKIF", 0, 32, b"AV01", *size, 25, 1, len(found), 0)
    return head + body


def frame_headers(ivf: bytes | bytearray) -> list[tuple[int, int]]:
    """Position of each frame's header, and its time."""
    found, at = [], 32
    while at < len(ivf):
        size, pts = struct.unpack_from("<IQ", ivf, at)
        found.append((at, pts))
        at += 12 + size
    return found


def with_repeats(
    clip: Path, output: Path, kept: Iterable[int], repeats: Sequence[tuple[int, int, int]]
) -> Path:
    """A stream that shows some pictures again.

    Args:
        clip: a clip.
        output: the IVF file.
        kept: frames of the clip.
        repeats: (frame, slot, count): after the frame, the picture in the slot is shown `count`
            times.
    """
    data = ivf_of(clip)
    starts = [start for start, _ in frame_headers(data)]
    units: list[bytes] = []
    for frame in kept:
        end = starts[frame + 1] if frame + 1 < len(starts) else len(data)
        units.append(data[starts[frame] + 12 : end])
        for after, slot, count in repeats:
            # A temporal delimiter, and a frame header that shows the frame in the slot.
            again = bytes([0x12, 0x00, 0x1A, 0x01, 0x88 | slot << 4])
            units += [again] * (count if after == frame else 0)
    body = b"".join(struct.pack("<IQ", len(u), i) + u for i, u in enumerate(units))
    output.write_bytes(data[:32] + body)
    return output

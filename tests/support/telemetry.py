"""Containers with positions, in the formats of GoPro and DJI cameras."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

_LETTERS = {"l": "i", "s": "h", "S": "H", "f": "f", "L": "I"}


def gpmf(key: bytes, letters: str, rows: object) -> bytes:
    """A GPMF item of numbers, with one type letter for all columns or one for each column."""
    table = np.atleast_2d(np.asarray(rows))
    each = letters * table.shape[1] if len(letters) == 1 else letters
    layout = ">" + "".join(_LETTERS[letter] for letter in each)
    values = [
        [float(x) if c == "f" else round(x) for x, c in zip(row, each, strict=True)]
        for row in table
    ]
    kind = letters if len(letters) == 1 else "?"
    body = b"".join(struct.pack(layout, *row) for row in values)
    head = struct.pack(">4scBH", key, kind.encode(), struct.calcsize(layout), len(table))
    return head + body + bytes(-len(body) % 4)


def gpmf_text(key: bytes, text: bytes) -> bytes:
    return struct.pack(">4scBH", key, b"c", 1, len(text)) + text + bytes(-len(text) % 4)


def gpmf_nest(key: bytes, *items: bytes) -> bytes:
    body = b"".join(items)
    return struct.pack(">4sBBH", key, 0, 1, len(body)) + body


def gps5(places: NDArray[np.float64], fix: int = 3) -> bytes:
    """A GPS stream of HERO5 to HERO10: one GPS fix for all samples, a scale for each column."""
    rows = np.hstack([places * [1e7, 1e7, 1e3], np.zeros((len(places), 2))])
    return gpmf_nest(
        b"STRM",
        gpmf_text(b"STNM", b"GPS (Lat., Long., Alt., 2D speed, 3D speed)"),
        gpmf(b"GPSF", "L", fix),
        gpmf(b"SCAL", "l", [[10**7], [10**7], [1000], [1000], [100]]),
        gpmf(b"GPS5", "l", rows),
    )


def gps9(places: NDArray[np.float64], fix: Sequence[int]) -> bytes:
    """A GPS stream of HERO11 and later: columns of two types, the last of which is the GPS fix."""
    scales = [[10**7], [10**7], [1000], [1000], [100], [1], [1000], [100], [1]]
    rest = np.zeros((len(places), 5))
    rows = np.hstack([places * [1e7, 1e7, 1e3], rest, np.array(fix)[:, None]])
    return gpmf_nest(
        b"STRM",
        gpmf_text(b"TYPE", b"lllllllSS"),
        gpmf(b"SCAL", "l", scales),
        gpmf(b"GPS9", "lllllllSS", rows),
    )


def grav(directions: NDArray[np.float64]) -> bytes:
    rows = directions * 32767
    return gpmf_nest(b"STRM", gpmf(b"SCAL", "s", 32767), gpmf(b"GRAV", "s", rows))


def with_gpmf(
    video: Path,
    output: Path,
    payloads: Sequence[tuple[float, bytes]],
    *,
    is_first: bool = False,
) -> Path:
    """Copy an AV1 video and add a data track of payloads, each with its duration in seconds.

    If `is_first`, the track precedes the video, so that the file begins with its first payload.
    """
    milliseconds = Fraction(1, 1000)
    with av.open(str(video)) as source, av.open(str(output), "w") as target:
        stream = source.streams.video[0]
        size = {"width": stream.width, "height": stream.height}
        if is_first:
            track = target.add_mux_stream("bin_data", time_base=milliseconds)
        copied = target.add_mux_stream("av1", time_base=stream.time_base, **size)
        if not is_first:
            track = target.add_mux_stream("bin_data", time_base=milliseconds)
        track.codec_tag = "gpmd"
        track.metadata["handler_name"] = "GoPro MET"
        for packet in source.demux(stream):
            if packet.size:
                packet.stream = copied
                target.mux(packet)
        at = 0
        for seconds, body in payloads:
            packet = av.Packet(gpmf_nest(b"DEVC", gpmf_text(b"DVNM", b"HERO"), body))
            packet.pts = packet.dts = at
            packet.duration = round(seconds * 1000)
            packet.time_base = milliseconds
            packet.stream = track
            target.mux(packet)
            at += packet.duration
    return output


def dji_text(places: NDArray[np.float64], rate: float) -> str:
    """The text of an .srt file with a position for each frame, at `rate` frames per second."""

    def stamp(seconds: float) -> str:
        whole = int(seconds)
        return f"00:{whole // 60:02}:{whole % 60:02},{round(seconds % 1 * 1000) % 1000:03}"

    return "\n".join(
        f"{k + 1}\n{stamp(k / rate)} --> {stamp((k + 1) / rate)}\n"
        f'<font size="28">FrameCnt: {k + 1}, DiffTime: 40ms\n2024-05-01 10:00:00.000\n'
        f"[iso: 100] [latitude: {a:.7f}] [longitude: {b:.7f}] "
        f"[rel_alt: 1.500 abs_alt: {c:.3f}] </font>\n"
        for k, (a, b, c) in enumerate(places.tolist())
    )

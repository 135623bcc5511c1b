"""Decoded frames of a video as they are stored; FFmpeg (through PyAV) decodes."""

from __future__ import annotations

import os
from collections.abc import Generator
from pathlib import Path
from typing import Any

import av
import av.error
import av.logging

from colmap_av1.errors import BitstreamError, VideoError
from colmap_av1.video.container import (
    ENCRYPTED,
    find_decodable_stream,
    is_encrypted,
    open_container,
    reason_of,
)


def count_frames(video: str | os.PathLike[str]) -> tuple[int, str | None]:
    """Decode a file of any codec: its frames before any damage, and what the damage is.

    Raises:
        VideoError: as `decode_frames`.
    """
    count = 0
    try:
        for _ in decode(video, 0, 1):
            count += 1
    except BitstreamError as error:
        return count, reason_of(error.__cause__ or error)
    return count, None


def decode(
    video: str | os.PathLike[str], operating_point: int, num_threads: int | None
) -> Generator[Any, None, None]:
    """Decode all frames as they are stored; those before a damage come first."""
    path = Path(video)
    with open_container(path) as container:
        stream = find_decodable_stream(container, path)
        yield from decode_stream(container, stream, path, operating_point, num_threads)


def decode_stream(
    container: Any, stream: Any, path: Path, operating_point: int, num_threads: int | None
) -> Generator[Any, None, None]:
    """As `decode`, of a file that is open: PyAV's container and a stream of it.

    Raises:
        VideoError: the stream is encrypted.
    """
    context = stream.codec_context
    context.thread_type = "AUTO"
    context.thread_count = num_threads or 0
    options = {"oppoint": str(operating_point)} if operating_point else {}
    # Grain is noise laid over the picture the motion was coded for.
    context.options = {"export_side_data": "film_grain", **options}
    damage: Exception | None = None
    has_packet = False
    try:
        for packet in container.demux(stream):
            if packet.size == 0:  # PyAV's end-of-stream marker
                break
            if packet.is_corrupt:
                damage = EOFError("cut off inside a packet")
                break
            if is_encrypted(packet):
                if not has_packet:
                    raise VideoError(f"{path}: {ENCRYPTED}")
                damage = EOFError("the rest is encrypted")
                break
            has_packet = True
            yield from context.decode(packet)
    except (av.error.FFmpegError, OSError) as error:
        damage = error
    # The decoder holds frames back; those before the damage are still good.
    try:
        yield from context.decode(None)
    except (av.error.FFmpegError, OSError) as error:
        damage = damage or error
    if damage is not None:
        raise BitstreamError(f"{path}: cannot be decoded further: {reason_of(damage)}") from damage

"""Decode the frames of a video as they are stored. FFmpeg decodes, through PyAV."""

from __future__ import annotations

import os
from collections.abc import Generator
from pathlib import Path
from typing import Any

import av
import av.error
import av.logging

from colmap_av1.errors import BitstreamError, VideoError
from colmap_av1.util.memory import check_memory
from colmap_av1.video.container import (
    ENCRYPTED,
    find_decodable_stream,
    is_encrypted,
    open_container,
    reason_of,
)


def count_decodable(video: str | os.PathLike[str]) -> tuple[int, str | None]:
    """Count the frames of a file of any codec up to the first damage, and describe the damage.

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
    """Decode all frames as they are stored, up to the first damage.

    Raises:
        BitstreamError: the stream is damaged; the frames before the damage have been yielded.
        VideoError: the file cannot be opened, or the stream is encrypted.
    """
    path = Path(video)
    with open_container(path) as container:
        stream = find_decodable_stream(container, path)
        yield from decode_stream(container, stream, path, operating_point, num_threads)


def decode_stream(
    container: Any, stream: Any, path: Path, operating_point: int, num_threads: int | None
) -> Generator[Any, None, None]:
    """Like `decode`, for a stream of a container that PyAV has opened.

    Raises:
        BitstreamError: the stream is damaged; the frames before the damage have been yielded.
        VideoError: the stream is encrypted.
    """
    context = stream.codec_context
    context.thread_type = "AUTO"
    context.thread_count = num_threads or 0
    options = {"oppoint": str(operating_point)} if operating_point else {}
    # Exporting film grain keeps the decoder from adding it: it is noise on top of the picture that
    # motion was coded for.
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
        check_memory(error)
        damage = error
    # The decoder delays frames; those before the damage are still valid.
    try:
        yield from context.decode(None)
    except (av.error.FFmpegError, OSError) as error:
        check_memory(error)
        damage = damage or error
    if damage is not None:
        raise BitstreamError(f"{path}: cannot be decoded further: {reason_of(damage)}") from damage

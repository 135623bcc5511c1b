"""What a file says of its video: size, display, presented frames, times."""

from __future__ import annotations

import contextlib
import os
import re
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import av.error
import av.logging
import numpy as np
from numpy.typing import NDArray

from colmap_av1.errors import BitstreamError, VideoError
from colmap_av1.video.container import find_video_stream, open_container, open_stream
from colmap_av1.video.display import Display, shown_size, turn_of_matrix
from colmap_av1.video.stored_frames import decode

# FFmpeg names it in its summary of a file; PyAV gives no other access to it.
_CROPPING = re.compile(r"^ +Frame Cropping: (\d+)/(\d+)/(\d+)/(\d+)$", re.MULTILINE)


def read_display(video: str | os.PathLike[str]) -> Display:
    """Find how players show the pictures, from the container and the first frame.

    Args:
        video: a file of any codec that FFmpeg decodes.

    Raises:
        BitstreamError: no frame can be decoded.
        VideoError: as `decode_frames`, or pictures are turned by anything but quarters.
    """
    return _look(video)[1]


def picture_size(video: str | os.PathLike[str], operating_point: int = 0) -> tuple[int, int]:
    """Width and height in pixels of the pictures that `decode_frames` gives.

    Args:
        video: a file of any codec that FFmpeg decodes.
        operating_point: operating point of a scalable stream.

    Raises:
        BitstreamError: no frame can be decoded.
        VideoError: as `read_display`.
    """
    return shown_size(*_look(video, operating_point))


def presented_frames(video: str | os.PathLike[str]) -> NDArray[np.int32] | None:
    """Find the frames that players show, where an edit list hides some, as of a trimmed clip.

    The others are frames all the same: motion runs through them. A frame that an edit list
    shows several times counts once.

    Returns:
        int32 indices among all shown frames of the stream, ascending; None: all of them.

    Raises:
        VideoError: as `decode_frames`.
    """
    path = Path(video)
    with open_container(path) as container:
        if "mov" not in container.format.name:
            return None
        stream = find_video_stream(container, path)
        num_entries = len(stream.index_entries)
        with open_container(path, apply_edits=True) as edited:
            entries = list(find_video_stream(edited, path).index_entries)
            # Entries lie in the container's memory: they are read while it is open.
            shown = {entry.pos for entry in entries if not entry.is_discard}
        if len(shown) == num_entries or not entries:
            return None
        # Where pictures are coded out of order, packets come in another order than pictures.
        packets: list[tuple[int, bool]] = []
        with contextlib.suppress(av.error.FFmpegError, OSError):
            for number, packet in enumerate(p for p in container.demux(stream) if p.size):
                time = packet.pts if packet.pts is not None else number
                packets.append((time, packet.pos in shown))
    packets.sort(key=lambda packet: packet[0])
    return np.flatnonzero([is_shown for _, is_shown in packets]).astype(np.int32)


def frame_times(video: str | os.PathLike[str]) -> NDArray[np.float64] | None:
    """Presentation times of the packets of an AV1 video, which show a frame each.

    Returns:
        float64 [num_packets] seconds, strictly ascending; None where the container gives none,
        or not in that order.

    Raises:
        VideoError: as `open_stream`.
    """
    times: list[float] = []
    with open_stream(video) as stream, contextlib.suppress(BitstreamError):
        for packet in stream.packets():
            if packet.pts is None:
                return None
            times.append(packet.pts)
    found = np.array(times, dtype=np.float64)
    return found if np.all(np.diff(found) > 0) else None


@dataclass(frozen=True)
class VideoFacts:
    """What a file of any codec says of its video, without decoding.

    Attributes:
        container: FFmpeg's name of the container format.
        index: number of the video among the streams of the file.
        size: (width, height) in pixels of the pictures as they are stored.
        num_packets: packets of the video, usually one a frame.
    """

    container: str
    index: int
    size: tuple[int, int]
    num_packets: int


def video_facts(video: str | os.PathLike[str]) -> VideoFacts:
    """Look into a file of any codec; its packets are counted where the container does not say.

    Raises:
        VideoError: as `decode_frames`.
    """
    path = Path(video)
    with open_container(path) as container:
        stream = find_video_stream(container, path)
        if stream.codec_context is None:
            raise VideoError(f"{path}: FFmpeg has no decoder for its codec: convert it first")
        count = stream.frames
        if not count:
            with contextlib.suppress(av.error.FFmpegError, OSError):
                for packet in container.demux(stream):
                    count += packet.size > 0
        size = (stream.codec_context.width, stream.codec_context.height)
        return VideoFacts(container.format.name, stream.index, size, count)


def _look(
    video: str | os.PathLike[str], operating_point: int = 0
) -> tuple[tuple[int, int], Display]:
    """(width, height) of the first stored picture, and how it is shown."""
    path = Path(video)
    frames = decode(path, operating_point, 1)
    frame = next(frames, None)
    frames.close()
    if frame is None:
        raise BitstreamError(
            f"{path}: no frame can be decoded, it is damaged: give another copy of it"
        )
    matrix = next((d for d in frame.side_data if d.type.name == "DISPLAYMATRIX"), None)
    turn = Display().turn if matrix is None else turn_of_matrix(struct.unpack("=9i", matrix))
    if turn is None:
        raise VideoError(
            f"{path}: players turn its pictures by an angle that is no multiple of 90 degrees: "
            "take the turn out with 'ffmpeg -display_rotation 0 -i ... -c copy'"
        )
    with open_container(path) as container:
        stream = find_video_stream(container, path)
        crop = _container_crop(container, stream.index)
        aspect = float(stream.sample_aspect_ratio or 1)
    left, top, right, bottom = crop
    if left + right >= frame.width or top + bottom >= frame.height:
        raise VideoError(
            f"{path}: its container cuts off the whole picture: give another copy of it"
        )
    aspect = aspect if turn[0][0] else 1 / aspect
    return (frame.width, frame.height), Display(crop, turn, aspect)


def _container_crop(container: Any, stream_index: int) -> tuple[int, int, int, int]:
    """Pixels that the container cuts off at the left, top, right and bottom."""
    if not {"mov", "matroska"} & set(container.format.name.split(",")):
        return (0, 0, 0, 0)
    level = av.logging.get_level()
    av.logging.set_level(av.logging.INFO)
    try:
        summary = container.dumps_format()
    finally:
        av.logging.set_level(level)
    of_stream = re.split(r"^  Stream #0:(\d+)", summary, flags=re.MULTILINE)
    for number, text in zip(of_stream[1::2], of_stream[2::2], strict=True):
        # The container's side data comes after its metadata, which may say anything.
        _, _, side_data = text.rpartition("\n    Side data:\n")
        found = _CROPPING.search(side_data)
        if int(number) == stream_index and found:
            left, right, top, bottom = map(int, found.groups())
            return left, top, right, bottom
    return (0, 0, 0, 0)

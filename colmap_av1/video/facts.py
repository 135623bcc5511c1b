"""A video: facts of its file and how players show its pictures, read once and passed on."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import re
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import av
import av.error
import av.logging
import numpy as np
from numpy.typing import NDArray

from colmap_av1.errors import BitstreamError, VideoError
from colmap_av1.video.container import (
    VideoFile,
    describe,
    find_decodable_stream,
    find_video_stream,
    open_container,
    open_stream,
)
from colmap_av1.video.display import Display, shown_size, turn_of_matrix
from colmap_av1.video.metadata.spherical import projection_of
from colmap_av1.video.stored_frames import decode_stream
from colmap_av1.video.unchanged import file_state

# FFmpeg names it in its summary of a file; PyAV gives no other access to it.
_CROPPING = re.compile(r"^ +Frame Cropping: (\d+)/(\d+)/(\d+)/(\d+)$", re.MULTILINE)

_File = TypeVar("_File", bound=VideoFile)

# Of several, that an edit list shows: fewer make no video.
_FEWEST_SHOWN = 2


@dataclass(frozen=True, eq=False)
class Video(VideoFile):
    """A video that can be decoded: facts of its file, and how players show its pictures.

    Attributes:
        picture_size: (width, height) in pixels of the pictures that `decode_frames` gives.
        display: how players show the stored pictures.
        presented: int32 indices, ascending, of the frames that players show among all shown
            frames of the stream, where an edit list hides some, as of a trimmed clip; None: all
            of them. The others are frames all the same: motion runs through them. A frame that
            an edit list shows several times counts once.
        doubtful_times: what of its container's times cannot be, and is left out, in words; None:
            nothing.
        is_interlaced: its pictures are of two fields, one taken after the other.
        projection: how pictures of all directions lie in the plane, as `projection_of` numbers it;
            None: these are of a plane.
    """

    picture_size: tuple[int, int]
    display: Display
    presented: NDArray[np.int32] | None
    doubtful_times: str | None
    is_interlaced: bool
    projection: int | None


def read_video(video: str | os.PathLike[str], operating_point: int = 0) -> Video:
    """Open a video of any codec and decode its first picture; the same object where it is one.

    Args:
        video: a file that FFmpeg decodes.
        operating_point: operating point of a scalable stream, which picture sizes depend on.

    Raises:
        BitstreamError: no frame can be decoded.
        VideoError: the file is missing, empty, not a video, holds no video stream, or its
            pictures are turned by anything but quarters.
    """
    if isinstance(video, Video):
        return video
    path, state = Path(video), file_state(video)
    with open_container(path) as container:
        stream = find_decodable_stream(container, path)
        file = describe(container, stream, state)
        crop = _container_crop(container, stream.index)
        aspect = float(stream.sample_aspect_ratio or 1)
        num_entries = len(stream.index_entries)
        frames = decode_stream(container, stream, path, operating_point, 1)
        frame = None
        with contextlib.closing(frames), contextlib.suppress(BitstreamError):
            frame = next(frames, None)
    if frame is None:
        raise BitstreamError(
            f"{path}: no frame can be decoded, it is damaged: give another copy of it"
        )
    display = _display(path, frame, crop, aspect)
    presented, doubt = _believed_edits(file, num_entries)
    return Video(
        **vars(file),
        picture_size=shown_size((frame.width, frame.height), display),
        display=display,
        presented=presented,
        doubtful_times=doubt,
        is_interlaced=bool(frame.interlaced_frame),
        projection=projection_of(frame.side_data),
    )


def _display(
    path: Path, frame: Any, crop: tuple[int, int, int, int], stored_aspect: float
) -> Display:
    """How a decoded frame is shown: crop and pixel aspect come from its container."""
    matrix = next((d for d in frame.side_data if d.type.name == "DISPLAYMATRIX"), None)
    turn = Display().turn if matrix is None else turn_of_matrix(struct.unpack("=9i", matrix))
    if turn is None:
        raise VideoError(
            f"{path}: players turn its pictures by an angle that is no multiple of 90 degrees: "
            "take the turn out with 'ffmpeg -display_rotation 0 -i ... -c copy'"
        )
    left, top, right, bottom = crop
    if left + right >= frame.width or top + bottom >= frame.height:
        raise VideoError(
            f"{path}: its container cuts off the whole picture: give another copy of it"
        )
    return Display(crop, turn, stored_aspect if turn[0][0] else 1 / stored_aspect)


def _believed_edits(
    file: VideoFile, num_entries: int
) -> tuple[NDArray[np.int32] | None, str | None]:
    """`Video.presented` and `Video.doubtful_times` of a file that lists a number of samples."""
    if "mov" not in file.container:
        return None, None
    if not file.is_timed:
        return None, (
            "the container's time scale is 0, or cannot be: its times and its edit list are left "
            "out, all frames are taken, and the frame rate is unknown"
        )
    presented = _presented_frames(file.path, num_entries)
    if presented is None or len(presented) >= _FEWEST_SHOWN or num_entries < _FEWEST_SHOWN:
        return presented, None
    return None, (
        f"the container's edit list shows {len(presented)} of {num_entries} frames, which is no "
        "video: it is left out, all frames are taken"
    )


def _presented_frames(path: Path, num_entries: int) -> NDArray[np.int32] | None:
    """`Video.presented` of a file whose container lists a number of samples, edits aside."""
    with open_container(path, apply_edits=True) as edited:
        entries = list(find_video_stream(edited, path).index_entries)
        # Entries lie in the container's memory: they are read while it is open.
        shown = {entry.pos for entry in entries if not entry.is_discard}
    if len(shown) == num_entries or not entries:
        return None
    # Where pictures are coded out of order, packets come in another order than pictures.
    packets: list[tuple[int, bool]] = []
    with open_container(path) as container, contextlib.suppress(av.error.FFmpegError, OSError):
        demuxed = container.demux(find_video_stream(container, path))
        for number, packet in enumerate(p for p in demuxed if p.size):
            time = packet.pts if packet.pts is not None else number
            packets.append((time, packet.pos in shown))
    packets.sort(key=lambda packet: packet[0])
    return np.flatnonzero([is_shown for _, is_shown in packets]).astype(np.int32)


def frame_times(video: str | os.PathLike[str]) -> NDArray[np.float64] | None:
    """Presentation times of the packets of an AV1 video, which show a frame each.

    The whole file is read for them, so they are no part of `Video`: few ask for them.

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


def picture_times(video: Video) -> NDArray[np.float64] | None:
    """Presentation times of all pictures of a video of any codec, those hidden by edits, too.

    Returns:
        float64 [n] seconds, ascending, up to a damage; None where the container gives none.

    Raises:
        VideoError: the file cannot be opened.
    """
    times: list[float] = []
    with (
        open_container(video.path) as container,
        contextlib.suppress(av.error.FFmpegError, OSError),
    ):
        for packet in container.demux(container.streams[video.index]):
            if packet.size and packet.pts is None:
                return None
            if packet.size:
                times.append(float(packet.pts * packet.time_base))
    # Where pictures are coded out of order, packets come in another order than pictures.
    return np.sort(np.array(times)) if times else None


def with_counted_packets(file: _File) -> _File:
    """The same facts, with the packets counted where the container does not say their number.

    Raises:
        VideoError: as `decode_frames`.
    """
    if file.num_packets is not None:
        return file
    count = 0
    with open_container(file.path) as container, contextlib.suppress(av.error.FFmpegError, OSError):
        for packet in container.demux(find_video_stream(container, file.path)):
            count += packet.size > 0
    return dataclasses.replace(file, num_packets=count)


def count_shown(video: Video) -> int:
    """Number of frames that players show, by the container: cheap, but not of a damaged stream.

    Raises:
        VideoError: as `decode_frames`.
    """
    if video.presented is not None:
        return len(video.presented)
    return with_counted_packets(video).num_packets or 0


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

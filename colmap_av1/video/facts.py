"""A video: facts about its file and how players show its pictures, read once and passed on."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import av
import av.error
import av.logging
import numpy as np
from numpy.typing import NDArray

from colmap_av1.errors import BitstreamError, VideoError
from colmap_av1.util.arrays import Floats
from colmap_av1.video.container import (
    VideoFile,
    describe,
    find_decodable_stream,
    missing_end,
    open_container,
    until_damage,
)
from colmap_av1.video.display import UPRIGHT, Display, shown_size, turn_of_matrix
from colmap_av1.video.metadata.spherical import projection_of
from colmap_av1.video.stored_frames import decode_stream
from colmap_av1.video.unchanged import file_state

# FFmpeg prints this line in its summary of a file; PyAV gives no other access to the cropping.
_CROPPING = re.compile(r"^ +Frame Cropping: (\d+)/(\d+)/(\d+)/(\d+)$", re.MULTILINE)

_File = TypeVar("_File", bound=VideoFile)

# An edit list that shows fewer frames than this is ignored, unless the video has no more.
_MIN_SHOWN = 2


@dataclass(frozen=True, eq=False)
class Video(VideoFile):
    """A video that can be decoded: facts about its file and how players show its pictures.

    Attributes:
        picture_size: (width, height) in pixels of the pictures that `decode_frames` yields.
        display: how players show the stored pictures.
        presented: int32 [n] ascending indices, among the frames that the bitstream shows, of those
            that players show, if an edit list hides some, as in a trimmed clip; None: players
            show all. Motion also runs through the hidden frames. A frame that an edit list shows
            several times counts once.
        doubtful_times: description of invalid times in the container, which are ignored; None if
            the times are valid.
        is_interlaced: whether its pictures have two fields, one taken after the other.
        projection: projection of a spherical video, a number as in `projection_of`; None for
            other videos.
    """

    picture_size: tuple[int, int]
    display: Display
    presented: NDArray[np.int32] | None
    doubtful_times: str | None
    is_interlaced: bool
    projection: int | None


def read_video(video: str | os.PathLike[str], operating_point: int = 0) -> Video:
    """Open a video of any codec and decode its first picture; a `Video` is returned unchanged.

    Args:
        video: a file that FFmpeg decodes.
        operating_point: operating point of a scalable stream, on which the picture size depends.

    Raises:
        BitstreamError: no frame can be decoded.
        VideoError: the file is missing, empty, not a video, has no video stream, or its display
            rotation is not a multiple of 90 degrees.
    """
    if isinstance(video, Video):
        return video
    path, state = Path(video), file_state(video)
    with open_container(path) as container:
        stream = find_decodable_stream(container, path)
        file = describe(container, stream, state)
        crop = _container_crop(container, file)
        aspect = float(stream.sample_aspect_ratio or 1)
        num_entries = len(stream.index_entries)
        frames = decode_stream(container, stream, path, operating_point, 1)
        frame = None
        with contextlib.closing(frames), contextlib.suppress(BitstreamError):
            frame = next(frames, None)
    if frame is None:
        raise BitstreamError(
            f"{path}: no frame can be decoded, the file is damaged: give another copy"
        )
    display = _display(path, frame, crop, aspect)
    presented, doubt = _checked_edits(file, num_entries)
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
    """How a decoded frame is shown; `crop` and `stored_aspect` come from its container."""
    matrix = next((d for d in frame.side_data if d.type.name == "DISPLAYMATRIX"), None)
    turn = UPRIGHT if matrix is None else turn_of_matrix(struct.unpack("=9i", matrix))
    if turn is None:
        raise VideoError(
            f"{path}: its display rotation is not a multiple of 90 degrees: "
            "remove it with 'ffmpeg -display_rotation 0 -i ... -c copy'"
        )
    left, top, right, bottom = crop
    if left + right >= frame.width or top + bottom >= frame.height:
        raise VideoError(f"{path}: its container crops away the whole picture: give another copy")
    return Display(crop, turn, stored_aspect if turn[0][0] else 1 / stored_aspect)


def _checked_edits(
    file: VideoFile, num_entries: int
) -> tuple[NDArray[np.int32] | None, str | None]:
    """`Video.presented` and `Video.doubtful_times` of a file that lists `num_entries` samples."""
    if not file.is_mp4:
        return None, None
    if not file.is_timed:
        return None, (
            "the container's time scale is invalid: its times and its edit list are ignored, all "
            "frames are used, and the frame rate is unknown"
        )
    presented = _presented_frames(file, num_entries)
    if presented is None or len(presented) >= _MIN_SHOWN or num_entries < _MIN_SHOWN:
        return presented, None
    return None, (
        f"the container's edit list shows only {len(presented)} of {num_entries} frames: it is "
        "ignored, and all frames are used"
    )


def _presented_frames(file: VideoFile, num_entries: int) -> NDArray[np.int32] | None:
    """`Video.presented` of a file whose container lists `num_entries` samples without edits."""
    with open_container(file.path, apply_edits=True) as edited:
        entries = list(edited.streams[file.index].index_entries)
        # The entries lie in the container's memory and must be read while it is open.
        shown = {entry.pos for entry in entries if not entry.is_discard}
    if len(shown) == num_entries or not entries:
        return None
    # Packets come in coding order, which can differ from the order of the pictures.
    packets = [
        (packet.pts if packet.pts is not None else number, packet.pos in shown)
        for number, packet in enumerate(_packets_before_damage(file))
    ]
    packets.sort(key=lambda packet: packet[0])
    return np.flatnonzero([is_shown for _, is_shown in packets]).astype(np.int32)


def picture_times(video: Video) -> Floats | None:
    """Presentation times of all pictures of a video of any codec, also of those hidden by edits.

    Returns:
        float64 [n] seconds, ascending, up to the first damage; None if the container gives none.

    Raises:
        VideoError: the file cannot be opened.
    """
    if not video.is_timed:
        return None
    times: list[float] = []
    for packet in _packets_before_damage(video):
        if packet.pts is None:
            return None
        times.append(float(packet.pts * packet.time_base))
    # Packets come in coding order, which can differ from the order of the pictures.
    return np.sort(np.array(times)) if times else None


def _packets_before_damage(file: VideoFile) -> Iterator[Any]:
    """PyAV's packets of the video stream, in coding order."""
    with open_container(file.path) as container, until_damage():
        for packet in container.demux(container.streams[file.index]):
            if packet.size:  # PyAV marks the end with an empty packet
                yield packet


def counted(file: _File) -> tuple[_File, str | None]:
    """The same facts, with the packets counted if the container does not give their number.

    Returns:
        The facts, and how the file is cut off if FFmpeg treats it as complete, otherwise None.

    Raises:
        VideoError: as `decode_frames`.
    """
    if file.num_packets is not None:
        return file, None
    count, last, last_pts = 0, None, None
    for packet in _packets_before_damage(file):
        count, last = count + 1, packet
        if packet.pts is not None and (last_pts is None or packet.pts > last_pts):
            last_pts = packet.pts
    damage = missing_end(file, count, last, last_pts)
    return dataclasses.replace(file, num_packets=count), damage


def count_shown(video: Video) -> int:
    """Number of frames that players show, according to the container.

    This is fast, but the number is too large for a damaged stream.

    Raises:
        VideoError: as `decode_frames`.
    """
    if video.presented is not None:
        return len(video.presented)
    return counted(video)[0].num_packets or 0


def _container_crop(container: Any, file: VideoFile) -> tuple[int, int, int, int]:
    """Pixels that a file's open container crops at the left, top, right and bottom."""
    if not (file.is_mp4 or file.is_matroska):
        return (0, 0, 0, 0)
    level = av.logging.get_level()
    av.logging.set_level(av.logging.INFO)
    try:
        summary = container.dumps_format()
    finally:
        av.logging.set_level(level)
    of_stream = re.split(r"^  Stream #0:(\d+)", summary, flags=re.MULTILINE)
    for number, text in zip(of_stream[1::2], of_stream[2::2], strict=True):
        # The side data follows the metadata, which may contain any text and must be skipped.
        _, _, side_data = text.rpartition("\n    Side data:\n")
        found = _CROPPING.search(side_data)
        if int(number) == file.index and found:
            left, right, top, bottom = map(int, found.groups())
            return left, top, right, bottom
    return (0, 0, 0, 0)

"""Packets, facts and decoded pictures of an AV1 video; FFmpeg (through PyAV) demuxes."""

from __future__ import annotations

import contextlib
import io
import os
import re
import shlex
import struct
from collections.abc import Generator, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any

import av
import av.error
import av.logging
import numpy as np
from av.stream import Disposition
from numpy.typing import NDArray

from colmap_av1.display import Display, shown_picture, shown_size, turn_of_matrix
from colmap_av1.errors import BitstreamError, NotAv1Error, VideoError

# Edit lists drop or hide samples, but a later frame may reference them: read them all.
_CONTAINER_OPTIONS = {"ignore_editlist": "1"}
# FFmpeg names it in its summary of a file; PyAV gives no other access to it.
_CROPPING = re.compile(r"^ +Frame Cropping: (\d+)/(\d+)/(\d+)/(\d+)$", re.MULTILINE)

_IVF_FRAME_HEADER_SIZE = 12
_IVF_RATE_OFFSET = 16  # rate and scale, 32 bits each
_IVF_ONE_TO_ONE = (1).to_bytes(4, "little") * 2
_AV1C_HEADER_SIZE = 4


@dataclass(frozen=True)
class Packet:
    """One unit of the container, usually a temporal unit.

    Attributes:
        data: OBUs in low-overhead format (AV1 specification, section 5), whatever the
            container; the last one may lack its obu_size. A view of the demuxer's memory.
        pts: presentation time in seconds; None where the container gives none.
        index: number of the packet in the stream, from 0.
    """

    data: memoryview
    pts: float | None
    index: int


class VideoStream:
    """The AV1 stream of an open video file; a context manager that closes it.

    Attributes:
        path: the file.
        container: FFmpeg's name of the container format.
        codec: always "av1".
        width: picture width in pixels as the container says, unrotated.
        height: picture height likewise.
        frame_rate: average frames per second; None where unknown.
        duration: length in seconds; None where unknown.
        num_frames: number of packets as the container says; None where it does not.
        configuration: OBUs that precede the first packet: the configOBUs of the container's
            av1C box, empty where the stream carries its sequence header itself.
    """

    def __init__(self, video: str | os.PathLike[str]) -> None:
        self.path = Path(video)
        self._opened = ExitStack()
        self._container = self._opened.enter_context(_open_container(self.path))
        try:
            self._stream = _find_av1_stream(self._container, self.path)
            context = self._stream.codec_context
            self.container: str = self._container.format.name
            self.codec = "av1"
            self.width: int = context.width
            self.height: int = context.height
            rate = self._stream.average_rate or self._stream.guessed_rate
            self._is_timed = not _is_ivf_without_rate(self.path)
            self.frame_rate = float(rate) if rate and self._is_timed else None
            self.duration = (
                _stream_duration(self._container, self._stream) if self._is_timed else None
            )
            self.num_frames = self._stream.frames or self._estimate_num_frames()
            self.configuration = _configuration_obus(context.extradata)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> VideoStream:
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._opened.close()

    def packets(self) -> Iterator[Packet]:
        """Read the packets in bitstream order. Works once per opened stream.

        Raises:
            BitstreamError: the file is damaged or cut off; every packet before the damage
                has been given.
            VideoError: there is no packet at all.
        """
        index = 0
        last: Any = None
        demuxed = self._container.demux(self._stream)
        while True:
            try:
                packet = next(demuxed, None)
            except (av.error.FFmpegError, OSError) as error:
                raise BitstreamError(
                    f"{self.path}: damaged after packet {index}: {_reason(error)}"
                ) from error
            if packet is None:
                break
            if packet.size == 0:  # PyAV's end-of-stream marker
                continue
            if packet.is_corrupt:
                raise BitstreamError(f"{self.path}: cut off inside packet {index + 1}")
            is_timed = self._is_timed and packet.pts is not None
            pts = float(packet.pts * packet.time_base) if is_timed else None
            last = packet
            yield Packet(memoryview(packet).toreadonly(), pts, index)
            index += 1
        damage = self._missing_end(index, last)
        if damage:
            raise BitstreamError(f"{self.path}: {damage}")
        if index == 0:
            raise VideoError(f"{self.path}: holds no frame: give a video with pictures")

    def _estimate_num_frames(self) -> int | None:
        if self.duration is None or self.frame_rate is None:
            return None
        return round(self.duration * self.frame_rate) or None

    def _missing_end(self, count: int, last: Any) -> str | None:
        """What shows that the file is cut off, where demuxers end as if it were whole."""
        if 0 < count < self._stream.frames and "mp4" in self.container:
            return f"cut off: {count} of {self._stream.frames} packets are there"
        if count == 0:
            # Tables that point nowhere, or a cut inside the first packet.
            if self._stream.frames or (self.duration and "matroska" in self.container):
                return "damaged or cut off before the end of the first packet"
            return None
        size = self._container.size
        if last.pos is not None and last.pos >= 0 and size > 0:
            end = last.pos + last.size
            if self.container == "ivf" and end + _IVF_FRAME_HEADER_SIZE != size:
                return f"cut off after packet {count}"
            if self.container == "obu" and end != size:
                return f"cut off after packet {count}"
        if "matroska" in self.container and self.duration and last.pts is not None:
            step = 1 / self.frame_rate if self.frame_rate else 0.0
            length = float((last.duration or 0) * last.time_base)
            end_time = float(last.pts * last.time_base) + max(length, step)
            if end_time + 1.5 * step < self.duration:
                return f"cut off: {end_time:.2f} of {self.duration:.2f} seconds are there"
        return None


def open_stream(video: str | os.PathLike[str]) -> VideoStream:
    """Open the AV1 stream of a video file.

    Reads every container FFmpeg demuxes, among them MP4, Matroska, WebM, IVF and bare OBU
    files (Section 5 and Annex B).

    Raises:
        NotAv1Error: the video is coded otherwise; the message says how to convert it.
        VideoError: the file is missing, empty, not a video, or holds no video stream.
    """
    return VideoStream(video)


def packets(video: str | os.PathLike[str]) -> Iterator[Packet]:
    """Read the packets of a video file: `VideoStream.packets` of a file opened for it."""
    with open_stream(video) as stream:
        yield from stream.packets()


def decode_frames(
    video: str | os.PathLike[str],
    *,
    operating_point: int = 0,
    num_threads: int | None = None,
    display: Display | None = None,
) -> Generator[tuple[int, NDArray[np.uint8]], None, None]:
    """Decode the frames that players show, as they show them but for film grain.

    Args:
        video: a file of any codec that FFmpeg decodes.
        operating_point: operating point of a scalable stream.
        num_threads: threads of the decoder; None: as many as it likes.
        display: how pictures are cut and turned; None: as `read_display` says. Pixels stay as
            wide as they are stored.

    Yields:
        (index, image) in output order: the index counts the frames that players show, see
        `presented_frames`; the image is uint8 [height, width, 3] in BGR order.

    Raises:
        BitstreamError: the stream is damaged; the frames before have been given.
        VideoError: the file is missing, empty, not a video, or holds no video stream.
    """
    display = display if display is not None else read_display(video)
    presented = presented_frames(video)
    index_of = None if presented is None else {int(f): i for i, f in enumerate(presented)}

    def shown(number: int, frame: Any) -> Iterator[tuple[int, NDArray[np.uint8]]]:
        index = number if index_of is None else index_of.get(number)
        if index is not None:
            yield index, shown_picture(frame.to_ndarray(format="bgr24"), display)

    count = 0
    try:
        for frame in _decode(video, operating_point, num_threads):
            yield from shown(count, frame)
            count += 1
    except BitstreamError:
        if num_threads == 1:
            raise
        # Threads lose the frames in flight at the damage; one thread has none in flight.
        for number, frame in enumerate(_decode(video, operating_point, 1)):
            if number >= count:
                yield from shown(number, frame)


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
    with _open_container(path) as container:
        if "mov" not in container.format.name:
            return None
        stream = _find_video_stream(container, path)
        num_entries = len(stream.index_entries)
        with _open_container(path, apply_edits=True) as edited:
            entries = list(_find_video_stream(edited, path).index_entries)
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


def is_av1(video: str | os.PathLike[str]) -> bool:
    """Whether a video has an AV1 stream.

    Raises:
        VideoError: as `decode_frames`.
    """
    path = Path(video)
    with _open_container(path) as container:
        return _codec_name(_find_video_stream(container, path)) == "av1"


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
    with _open_container(path) as container:
        stream = _find_video_stream(container, path)
        if stream.codec_context is None:
            raise VideoError(f"{path}: FFmpeg has no decoder for its codec: convert it first")
        count = stream.frames
        if not count:
            with contextlib.suppress(av.error.FFmpegError, OSError):
                for packet in container.demux(stream):
                    count += packet.size > 0
        size = (stream.codec_context.width, stream.codec_context.height)
        return VideoFacts(container.format.name, stream.index, size, count)


def count_frames(video: str | os.PathLike[str]) -> tuple[int, str | None]:
    """Decode a file of any codec: its frames before any damage, and what the damage is.

    Raises:
        VideoError: as `decode_frames`.
    """
    count = 0
    try:
        for _ in _decode(video, 0, 1):
            count += 1
    except BitstreamError as error:
        return count, _reason(error.__cause__ or error)
    return count, None


def _look(
    video: str | os.PathLike[str], operating_point: int = 0
) -> tuple[tuple[int, int], Display]:
    """(width, height) of the first stored picture, and how it is shown."""
    path = Path(video)
    frames = _decode(path, operating_point, 1)
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
    with _open_container(path) as container:
        stream = _find_video_stream(container, path)
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


def _decode(
    video: str | os.PathLike[str], operating_point: int, num_threads: int | None
) -> Generator[Any, None, None]:
    path = Path(video)
    with _open_container(path) as container:
        stream = _find_video_stream(container, path)
        context = stream.codec_context
        if context is None:
            raise VideoError(f"{path}: FFmpeg has no decoder for its codec: convert it first")
        context.thread_type = "AUTO"
        context.thread_count = num_threads or 0
        options = {"oppoint": str(operating_point)} if operating_point else {}
        # Grain is noise laid over the picture the motion was coded for.
        context.options = {"export_side_data": "film_grain", **options}
        damage: Exception | None = None
        try:
            for packet in container.demux(stream):
                if packet.size == 0:  # PyAV's end-of-stream marker
                    break
                if packet.is_corrupt:
                    damage = EOFError("cut off inside a packet")
                    break
                yield from context.decode(packet)
        except (av.error.FFmpegError, OSError) as error:
            damage = error
        # The decoder holds frames back; those before the damage are still good.
        try:
            yield from context.decode(None)
        except (av.error.FFmpegError, OSError) as error:
            damage = damage or error
        if damage is not None:
            raise BitstreamError(
                f"{path}: cannot be decoded further: {_reason(damage)}"
            ) from damage


class _IvfWithRate(io.FileIO):
    """An IVF file read as if its header gave a frame rate; FFmpeg refuses one that is 0."""

    def readinto(self, buffer: Any) -> int:
        start = self.tell()
        count = super().readinto(buffer) or 0
        view = memoryview(buffer).cast("B")
        for i, byte in enumerate(_IVF_ONE_TO_ONE, start=_IVF_RATE_OFFSET - start):
            if 0 <= i < count:
                view[i] = byte
        return count

    def read(self, size: int | None = -1) -> bytes:
        if size is None or size < 0:
            size = max(0, os.fstat(self.fileno()).st_size - self.tell())
        buffer = bytearray(size)
        return bytes(buffer[: self.readinto(buffer)])


def _is_ivf_without_rate(path: Path) -> bool:
    if not path.is_file():
        return False
    with path.open("rb") as file:
        header = file.read(_IVF_RATE_OFFSET + len(_IVF_ONE_TO_ONE))
    rate = header[_IVF_RATE_OFFSET:]
    return header.startswith(b"DKIF") and b"\0" * 4 in (rate[:4], rate[4:])


@contextmanager
def _open_container(path: Path, *, apply_edits: bool = False) -> Iterator[Any]:
    file: _IvfWithRate | None = None
    try:
        if not path.exists():
            raise VideoError(f"{path}: no such file: give the path of a video")
        if path.is_dir():
            raise VideoError(f"{path}: is a folder: give a video file")
        if path.is_file() and path.stat().st_size == 0:
            raise VideoError(f"{path}: is an empty file: give the path of a video")
        if _is_ivf_without_rate(path):
            file = _IvfWithRate(path)
        # An absolute path: FFmpeg would take 'name:...' for a protocol.
        container = av.open(
            file or os.path.abspath(path),
            container_options={} if apply_edits else _CONTAINER_OPTIONS,
        )
    except (PermissionError, av.error.FFmpegError, OSError, ValueError) as error:
        if file is not None:
            file.close()
        if isinstance(error, PermissionError):
            raise VideoError(
                f"{path}: no permission to read it: change that, or give another"
            ) from error
        raise VideoError(
            f"{path}: not a video, or damaged before its first frame ({_reason(error)}): give "
            "another"
        ) from error
    try:
        yield container
    finally:
        container.close()
        if file is not None:
            file.close()


def _find_av1_stream(container: Any, path: Path) -> Any:
    stream = _find_video_stream(container, path)
    if _codec_name(stream) == "av1":
        return stream
    target = path.with_name(f"{path.stem}_av1.mp4").name
    raise NotAv1Error(
        f"{path}: is {_codec_name(stream)}, not AV1; convert it: colmap-av1 encode --video "
        f"{shlex.quote(str(path))} --output {shlex.quote(target)}"
    )


def _find_video_stream(container: Any, path: Path) -> Any:
    """The AV1 stream, in a file without one the first that is no cover picture."""
    streams = container.streams.video
    if not streams:
        kinds = sorted({stream.type for stream in container.streams})
        found = f"only {', '.join(kinds)}" if kinds else "nothing"
        raise VideoError(f"{path}: holds no video stream, {found}: give a video")
    moving = [s for s in streams if not s.disposition & Disposition.attached_pic] or streams
    return next((s for s in moving if _codec_name(s) == "av1"), moving[0])


def _codec_name(stream: Any) -> str:
    if stream.codec_context is None:  # no decoder for it
        return "of an unknown codec"
    return str(stream.codec_context.codec.canonical_name)


def _configuration_obus(extradata: bytes | None) -> bytes:
    """The configOBUs of an av1C box (AV1 in ISOBMFF, section 2.3), or bare OBUs as they are."""
    if not extradata:
        return b""
    if extradata[0] == 0x81:  # marker and version; no OBU header starts so
        return bytes(extradata[_AV1C_HEADER_SIZE:])
    return bytes(extradata)


def _stream_duration(container: Any, stream: Any) -> float | None:
    if stream.duration is not None and stream.time_base:
        return float(stream.duration * stream.time_base)
    tag = stream.metadata.get("DURATION")  # Matroska, as muxers write it: 00:00:01.234
    if tag:
        try:
            hours, minutes, seconds = tag.split(":")
            return float(hours) * 3600 + float(minutes) * 60 + float(seconds)
        except ValueError:
            pass
    if container.duration is not None and len(container.streams) == 1:
        return float(Fraction(container.duration, av.time_base))
    return None


def _reason(error: BaseException) -> str:
    """FFmpeg's words for an error, without its number and the file's name."""
    reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return " ".join(str(reason).split())

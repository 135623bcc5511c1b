"""Facts from the container of a video, and its AV1 packets. FFmpeg demuxes, through PyAV."""

from __future__ import annotations

import io
import math
import os
import re
import shlex
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any

import av
import av.error
import av.logging
from av.stream import Disposition

from colmap_av1.errors import BitstreamError, NotAv1Error, VideoError
from colmap_av1.util.memory import check_memory
from colmap_av1.video.cut_off import (
    is_fragmented_mp4,
    is_fragmented_mp4_cut,
    is_matroska_cut,
    is_mp4_without_index,
)
from colmap_av1.video.unchanged import FileState, file_state

# Edit lists drop or hide samples that a later frame may reference, so all samples are read.
_CONTAINER_OPTIONS = {"ignore_editlist": "1"}
_IVF_FRAME_HEADER_SIZE = 12
_IVF_RATE_OFFSET = 16  # frame rate and time scale, 32 bits each
_IVF_ONE_TO_ONE = (1).to_bytes(4, "little") * 2
_AV1C_HEADER_SIZE = 4
# A URL as `Path` spells it, with one slash instead of two.
_ADDRESS = re.compile(r"(?P<scheme>[A-Za-z][A-Za-z0-9+.-]+):/(?P<rest>.*)", re.DOTALL)
ENCRYPTED = "is encrypted: give a decrypted copy"
# FFmpeg gives this tag to an encrypted Matroska stream: the ID of its key.
_KEY_TAG = "enc_key_id"
# Transfer characteristics of HDR video (ITU-T H.273, table 3).
_HDR_TRANSFERS = {16: "PQ", 18: "HLG"}


@dataclass(frozen=True)
class Packet:
    """One unit of the container, usually a temporal unit.

    Attributes:
        data: OBUs in low-overhead format (AV1 specification, section 5) for every
            container; the last one may lack its obu_size. A view of the demuxer's memory.
        pts: presentation time in seconds; None if the container gives none.
        index: index of the packet in the stream, from 0.
    """

    data: memoryview
    pts: float | None
    index: int


@dataclass(frozen=True)
class VideoFile:
    """Facts about a video file of any codec, read without decoding.

    It can be passed wherever the path of a video is expected.

    Attributes:
        path: the file.
        state: state of the file before it was opened, for `unchanged`.
        container: FFmpeg's name of the container format.
        codec: FFmpeg's name of the codec.
        index: index of the video stream in the file.
        stored_size: (width, height) in pixels of the stored pictures.
        frame_rate: average frames per second; None if unknown.
        duration: length in seconds; None if unknown.
        is_timed: whether the container gives presentation times.
        num_packets: packets of the video stream, usually one per frame; None if the container
            does not give the number.
        dynamic_range: transfer function of HDR video, "HLG" or "PQ"; None for other video.
        tags: metadata of the whole file: (name in lower case, value) pairs.
        has_telemetry: whether the file has data or subtitle streams, which may hold positions.
    """

    path: Path
    state: FileState
    container: str
    codec: str
    index: int
    stored_size: tuple[int, int]
    frame_rate: float | None
    duration: float | None
    is_timed: bool
    num_packets: int | None
    dynamic_range: str | None
    tags: tuple[tuple[str, str], ...]
    has_telemetry: bool

    def __fspath__(self) -> str:
        return str(self.path)

    def __str__(self) -> str:
        return str(self.path)

    @property
    def is_mp4(self) -> bool:
        """Whether the container is MP4 or QuickTime: FFmpeg's format "mov,mp4,m4a,..."."""
        return _is_mp4(self.container)

    @property
    def is_matroska(self) -> bool:
        """Whether the container is Matroska or WebM: FFmpeg's format "matroska,webm"."""
        return "matroska" in self.container.split(",")

    @property
    def likely_num_packets(self) -> int | None:
        """The number of packets, or an estimate from duration and frame rate."""
        if self.num_packets is not None or self.duration is None or self.frame_rate is None:
            return self.num_packets
        return round(self.duration * self.frame_rate) or None


def read_file(video: str | os.PathLike[str]) -> VideoFile:
    """Read the facts about a file of any codec; a `VideoFile` is returned unchanged.

    Raises:
        VideoError: as `decode_frames`.
    """
    if isinstance(video, VideoFile):
        return video
    path, state = Path(video), file_state(video)
    with open_container(path) as container:
        return describe(container, find_decodable_stream(container, path), state)


def describe(container: Any, stream: Any, state: FileState) -> VideoFile:
    """Collect the facts that an open container gives about a stream.

    Args:
        container: PyAV's container.
        stream: PyAV's stream.
        state: state of the file before it was opened.
    """
    rate = stream.average_rate or stream.guessed_rate
    is_timed = not (_is_ivf_without_rate(state.path) or _is_mp4_without_scale(container, stream))
    num_packets, duration = stream.frames or None, _stream_duration(container, stream)
    if num_packets and _is_mp4(container.format.name) and is_fragmented_mp4(state.path):
        num_packets = None  # the container counts only those before the fragments
    if container.format.name == "ivf" and is_timed and rate and stream.time_base != 1 / rate:
        # The header holds the number of frames or the duration in time units, depending on the
        # program that wrote it, so both are measured.
        num_packets, duration = _measured_length(state.path, stream.index, 1 / rate)
    return VideoFile(
        path=state.path,
        state=state,
        container=container.format.name,
        codec=_codec_name(stream),
        index=stream.index,
        stored_size=(stream.codec_context.width, stream.codec_context.height),
        frame_rate=float(rate) if rate and is_timed else None,
        duration=duration if is_timed else None,
        is_timed=is_timed,
        num_packets=num_packets,
        dynamic_range=_HDR_TRANSFERS.get(stream.codec_context.color_trc),
        tags=tuple((str(k).lower(), str(v)) for k, v in container.metadata.items()),
        has_telemetry=bool(container.streams.data or container.streams.subtitles),
    )


class VideoStream:
    """The AV1 stream of an open video file; a context manager that closes it.

    Attributes:
        file: facts from the container.
        configuration: OBUs that precede the first packet: the configOBUs of the container's
            av1C box; empty if the stream contains its own sequence header.
    """

    def __init__(self, video: str | os.PathLike[str]) -> None:
        path, state = Path(video), file_state(video)
        self._process = os.getpid()
        self._opened = ExitStack()
        self._container = self._opened.enter_context(open_container(path))
        try:
            self._stream = _find_av1_stream(self._container, path)
            self.file = describe(self._container, self._stream, state)
            self.configuration = _configuration_obus(self._stream.codec_context.extradata)
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
        """Read the packets in bitstream order. Can be called once per opened stream.

        Raises:
            BitstreamError: the file is damaged or cut off; every packet before the damage
                has been yielded.
            VideoError: the stream has no packets, is encrypted, or was opened before this
                process was forked.
        """
        index = 0
        last: Any = None
        demuxed = self._container.demux(self._stream)
        while True:
            check_process(self.file, self._process)
            try:
                packet = next(demuxed, None)
            except (av.error.FFmpegError, OSError) as error:
                check_memory(error)
                raise BitstreamError(
                    f"{self.file}: damaged after packet {index}: {reason_of(error)}"
                ) from error
            if packet is None:
                break
            if packet.size == 0:  # PyAV's end-of-stream marker
                continue
            if packet.is_corrupt:
                raise BitstreamError(f"{self.file}: cut off inside packet {index + 1}")
            if is_encrypted(packet):
                if index == 0:
                    raise VideoError(f"{self.file}: {ENCRYPTED}")
                raise BitstreamError(f"{self.file}: is encrypted after packet {index}")
            is_timed = self.file.is_timed and packet.pts is not None
            pts = float(packet.pts * packet.time_base) if is_timed else None
            last = packet
            yield Packet(memoryview(packet).toreadonly(), pts, index)
            index += 1
        damage = missing_end(self.file, index, last)
        if damage:
            raise BitstreamError(f"{self.file}: {damage}")
        if index == 0:
            raise VideoError(f"{self.file}: has no frames: give another video")


def missing_end(file: VideoFile, count: int, last: Any, last_pts: int | None = None) -> str | None:
    """Describe how a file is cut off that the demuxer treats as complete; None if it is whole.

    Args:
        file: the file.
        count: number of packets of its video stream.
        last: the last packet, of PyAV; None without packets.
        last_pts: the largest presentation time of all packets in units of the time base, if it may
            be that of another packet; None: that of the last one.
    """
    if 0 < count < (file.num_packets or 0) and file.is_mp4:
        return f"cut off after {count} of {file.num_packets} packets"
    if count == 0:
        # The sample tables point outside the file, or it ends inside the first packet.
        if file.num_packets or (file.duration and file.is_matroska):
            return "damaged or cut off before the end of the first packet"
        return None
    size = file.path.stat().st_size
    if last.pos is not None and last.pos >= 0:
        end = last.pos + last.size
        if file.container == "ivf" and end + _IVF_FRAME_HEADER_SIZE != size:
            return f"cut off after packet {count}"
        if file.container == "obu" and end != size:
            return f"cut off after packet {count}"
        if file.is_matroska and is_matroska_cut(file.path, last.pos, last.size):
            return f"cut off after packet {count}"
    if file.is_mp4 and is_fragmented_mp4_cut(file.path):
        return f"cut off after packet {count}"
    last_pts = last.pts if last_pts is None else last_pts
    if file.is_matroska and file.duration and last_pts is not None:
        step = 1 / file.frame_rate if file.frame_rate else 0.0
        length = float((last.duration or 0) * last.time_base)
        end_time = float(last_pts * last.time_base) + max(length, step)
        if end_time + 1.5 * step < file.duration:
            return f"cut off after {end_time:.2f} of {file.duration:.2f} seconds"
    return None


def check_process(video: str | os.PathLike[str], process: int) -> None:
    """Check that a file is read by the process that opened it, not by a fork of it.

    Both processes would take packets from the same open file, and the fork has no reader threads.

    Args:
        video: the file, for the message.
        process: ID of the process that opened it.

    Raises:
        VideoError: the current process is another one.
    """
    if os.getpid() != process:
        raise VideoError(
            f"{os.fspath(video)}: was opened before this process was forked: open it again here"
        )


def open_stream(video: str | os.PathLike[str]) -> VideoStream:
    """Open the AV1 stream of a video file.

    Every container that FFmpeg demuxes is accepted, including MP4, Matroska, WebM, IVF and bare
    OBU files (Section 5 and Annex B).

    Raises:
        NotAv1Error: the video has another codec; the message says how to convert it.
        VideoError: the file is missing, empty, not a video, or has no video stream.
    """
    return VideoStream(video)


class _IvfWithRate(io.FileIO):
    """An IVF file read as if its header had a frame rate, because FFmpeg rejects a rate of 0."""

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


def _is_mp4(format_name: str) -> bool:
    return "mp4" in format_name.split(",")


def _is_mp4_without_scale(container: Any, stream: Any) -> bool:
    """Whether an MP4 file has an invalid time scale, for which FFmpeg assumes units of a second.

    With this unit the file has less than one frame per second, which no real video has.
    """
    rate = stream.average_rate
    is_second = _is_mp4(container.format.name) and stream.time_base == 1
    return bool(is_second and rate is not None and rate < 1)


@contextmanager
def open_container(path: Path, *, apply_edits: bool = False) -> Iterator[Any]:
    """Open a file of any container.

    Args:
        path: the file.
        apply_edits: hide the samples that an edit list hides.

    Raises:
        VideoError: the file is missing, unreadable, empty, or not a video.
    """
    file: _IvfWithRate | None = None
    try:
        address = _ADDRESS.match(str(path))
        if address and not path.exists():
            raise VideoError(
                f"{address['scheme']}://{address['rest']}: is a URL, not a file: download it first "
                "and give its path"
            )
        if not path.exists():
            raise VideoError(f"{path}: no such file: give the path of a video")
        if path.is_dir():
            raise VideoError(f"{path}: is a folder: give a video file")
        if not path.is_file():
            raise VideoError(
                f"{path}: is a pipe or device, and a video is read several times: copy it to a "
                "file first"
            )
        if path.stat().st_size == 0:
            raise VideoError(f"{path}: is an empty file: give the path of a video")
        if _is_ivf_without_rate(path):
            file = _IvfWithRate(path)
        # The path is absolute because FFmpeg would read 'name:...' as a protocol.
        container = av.open(
            file or os.path.abspath(path),
            container_options={} if apply_edits else _CONTAINER_OPTIONS,
            metadata_errors="replace",  # some cameras and programs write Latin-1
        )
    except (PermissionError, av.error.FFmpegError, OSError, ValueError) as error:
        if file is not None:
            file.close()
        check_memory(error)
        if isinstance(error, PermissionError):
            raise VideoError(
                f"{path}: no permission to read it: change its permissions or give another file"
            ) from error
        if is_mp4_without_index(path):
            raise VideoError(
                f"{path}: its end is missing, with the index of its frames, so the recording or "
                "copy is incomplete: give another copy, or repair it"
            ) from error
        raise VideoError(
            f"{path}: not a video, or damaged before its first frame ({reason_of(error)}): give "
            "another file"
        ) from error
    try:
        yield container
    finally:
        container.close()
        if file is not None:
            file.close()


@contextmanager
def until_damage() -> Iterator[None]:
    """End the body without an error where a file is damaged."""
    try:
        yield
    except (av.error.FFmpegError, OSError) as error:
        check_memory(error)


def _find_av1_stream(container: Any, path: Path) -> Any:
    stream = find_video_stream(container, path)
    if _codec_name(stream) == "av1":
        return stream
    target = path.with_name(f"{path.stem}_av1.mp4").name
    raise NotAv1Error(
        f"{path}: is {_codec_name(stream)}, not AV1; convert it: colmap-av1 encode --video "
        f"{shlex.quote(str(path))} --output {shlex.quote(target)}"
    )


def find_video_stream(container: Any, path: Path) -> Any:
    """The AV1 stream of a file; if there is none, a video stream with moving pictures.

    Of several, it is the default one, else the one with the largest pictures. Cover pictures, and
    the still pictures of animated AVIF and HEIF files, are skipped.

    Raises:
        VideoError: there is no video stream.
    """
    streams = container.streams.video
    if not streams:
        kinds = sorted({stream.type for stream in container.streams})
        found = f", only {', '.join(kinds)}" if kinds else ""
        raise VideoError(f"{path}: has no video stream{found}: give a video")
    moving = [s for s in streams if not s.disposition & Disposition.attached_pic]
    if not moving and container.streams.audio:
        raise VideoError(f"{path}: has audio and a cover picture, no video: give a video")
    moving = moving or streams
    candidates = [s for s in moving if _codec_name(s) == "av1"] or moving
    return max(candidates, key=_preference)


def _preference(stream: Any) -> tuple[bool, bool, int]:
    """Sort key of the video streams of a file: players show the one with the largest."""
    is_default = bool(stream.disposition & Disposition.default)
    context = stream.codec_context
    return stream.frames != 1, is_default, context.width * context.height if context else 0


def find_decodable_stream(container: Any, path: Path) -> Any:
    """Like `find_video_stream`, but the codec must be one that FFmpeg decodes.

    Raises:
        VideoError: there is no video stream, or FFmpeg cannot decode it.
    """
    stream = find_video_stream(container, path)
    if stream.codec_context is None:
        raise VideoError(f"{path}: FFmpeg has no decoder for its codec: convert it first")
    return stream


def is_encrypted(packet: Any) -> bool:
    """Whether a packet is encrypted, for example by Common Encryption (ISO/IEC 23001-7)."""
    # Old versions of PyAV do not give the side data of packets.
    has = getattr(packet, "has_sidedata", None)
    return _KEY_TAG in packet.stream.metadata or (has is not None and has("encryption_info"))


def _codec_name(stream: Any) -> str:
    if stream.codec_context is None:  # no decoder for it
        return "of an unknown codec"
    return str(stream.codec_context.codec.canonical_name)


def _configuration_obus(extradata: bytes | None) -> bytes:
    """The configOBUs of an av1C box (AV1 in ISOBMFF, section 2.3); bare OBUs stay unchanged."""
    if not extradata:
        return b""
    if extradata[0] == 0x81:  # marker and version; no OBU header begins with this byte
        return bytes(extradata[_AV1C_HEADER_SIZE:])
    return bytes(extradata)


def _stream_duration(container: Any, stream: Any) -> float | None:
    if stream.duration is not None and stream.time_base:
        return float(stream.duration * stream.time_base)
    tag = stream.metadata.get("DURATION")  # Matroska muxers write 00:00:01.234
    if tag:
        try:
            hours, minutes, seconds = tag.split(":")
            length = float(hours) * 3600 + float(minutes) * 60 + float(seconds)
        except ValueError:
            length = math.nan
        if math.isfinite(length):
            return length
    if container.duration is not None and len(container.streams) == 1:
        return float(Fraction(container.duration, av.time_base))
    return None


def _measured_length(path: Path, index: int, step: Fraction) -> tuple[int, float]:
    """Number of packets of a stream up to the first damage, and its duration in seconds.

    Args:
        path: the file.
        index: index of the stream.
        step: seconds from one picture to the next.
    """
    times: list[Fraction] = []
    with open_container(path) as container, until_damage():
        for packet in container.demux(container.streams[index]):
            if packet.size and packet.pts is not None:
                times.append(packet.pts * packet.time_base)
    return len(times), float(max(times) - min(times) + step) if times else 0.0


def reason_of(error: BaseException) -> str:
    """FFmpeg's description of an error, without its number and the name of the file."""
    reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return " ".join(str(reason).split())

"""Convert any video to an AV1 stream with good motion vectors, with ffmpeg."""

from __future__ import annotations

import hashlib
import os
import re
import subprocess
import tempfile
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import av
import av.error
import numpy as np
from numpy.typing import NDArray

from colmap_av1.errors import (
    BitstreamError,
    EncodeError,
    NotAv1Error,
    OptionError,
    VideoError,
    writing,
)
from colmap_av1.options import EncodeOptions
from colmap_av1.util.files import check_new_file, may_read, remove_leftovers, whole_file
from colmap_av1.util.processes import bound
from colmap_av1.util.progress import Progress, no_progress
from colmap_av1.util.signals import held_back
from colmap_av1.video.coded_size import scaling
from colmap_av1.video.container import VideoFile, open_stream, read_file
from colmap_av1.video.deinterlacing import DEINTERLACING
from colmap_av1.video.encoders import (
    ENCODERS,
    KEY_FRAME_DISTANCE,
    TALK,
    find_encoder,
    reason_in_log,
    settings,
)
from colmap_av1.video.facts import Video, counted, read_video
from colmap_av1.video.metadata.positions import read_positions
from colmap_av1.video.metadata.telemetry import carrying, loss_of
from colmap_av1.video.stored_frames import count_decodable
from colmap_av1.video.unchanged import unchanged

_FORMATS = {".mp4": "mp4", ".mkv": "matroska", ".webm": "webm", ".ivf": "ivf"}
# Number of bytes at the start, in the middle and at the end of a video that identify it.
_SAMPLE = 1 << 16
# Begins the comment tag that records the settings of a stream. A kept stream is recognized by the
# source that its tag records, too.
_MARK = "colmap-av1"
# Containers that store the tag.
_KEPT_FORMATS = (".mp4", ".mkv", ".webm")
_NEW_SIZE = re.compile(r"Reconfiguring filter graph.* changed to .*, (\d+)x(\d+)")


@dataclass(frozen=True)
class EncodeReport:
    """Result of a conversion.

    Attributes:
        output: the AV1 stream.
        encoder: ffmpeg's name of the encoder.
        num_frames: number of frames of the stream; the video has as many.
        reused: whether an existing stream was used.
    """

    output: Path
    encoder: str
    num_frames: int
    reused: bool = False


def encode(
    video: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    overwrite: bool = False,
    strict: bool = False,
    options: EncodeOptions = EncodeOptions(),
    progress: Progress = no_progress,
) -> EncodeReport:
    """Convert a video to AV1 with backward references only and a single intra frame.

    Every frame that players show becomes one frame of the stream, none is dropped or duplicated,
    and time stamps are kept. Interlaced pictures are deinterlaced, which keeps their first field.
    Pictures are rotated as players rotate them, and downscaled if the options ask for it. Sound is
    dropped. GPS positions and the direction of gravity are copied if the output format can hold
    them; otherwise a warning is given. The output appears under its name only when it is complete.
    A damaged video is converted up to the damage, with a warning.

    Args:
        video: a video that ffmpeg decodes.
        output: the stream; its extension .mp4, .mkv, .webm or .ivf selects the container.
        overwrite: replace an existing output.
        strict: raise an error for a damaged video.
        options: the encoder and its settings.
        progress: called with the stage "encoding", the number of frames done, and the total if
            it is known.

    Raises:
        VideoError: the video is missing or cannot be decoded.
        BitstreamError: the video is damaged and `strict` is set.
        EncodeError: no encoder works.
        WriteError: the output cannot be written.
        OptionError: an option has an invalid value, the output exists, or its format cannot hold
            the pixel aspect.

    Examples:
        >>> from colmap_av1 import EncodeOptions, encode
        >>> report = encode("phone.mp4", "phone_av1.mp4", options=EncodeOptions(downscale=2))
        >>> report.num_frames
        60
    """
    return _encode(
        video,
        output,
        overwrite=overwrite,
        strict=strict,
        options=options,
        progress=progress,
    )


def encode_for_motion(
    video: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    strict: bool,
    options: EncodeOptions,
    progress: Progress,
) -> EncodeReport:
    """Convert a video as `encode` does, to a stream that only its motion is read from.

    It also has the frames that an edit list hides, because motion runs through them, and no
    positions, which are read from the video itself.
    """
    return _encode(
        video,
        output,
        overwrite=False,
        strict=strict,
        options=options,
        progress=progress,
        is_for_motion=True,
    )


def _encode(
    video: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    overwrite: bool,
    strict: bool,
    options: EncodeOptions,
    progress: Progress,
    is_for_motion: bool = False,
    is_kept: bool = False,
) -> EncodeReport:
    """Do the work of `encode`, `encode_for_motion` and `stream_of`.

    Args:
        video: see `encode`, as the next five.
        output: the stream.
        overwrite: replace an existing output.
        strict: raise an error for a damaged video.
        options: the encoder and its settings.
        progress: called with the stage "encoding".
        is_for_motion: see `encode_for_motion`.
        is_kept: mark the output as a kept stream of the video.
    """
    path, output = Path(video), Path(output)
    if output.suffix.lower() not in _FORMATS:
        raise OptionError(f"{output}: give an output that ends in {', '.join(_FORMATS)}")
    check_new_file(output, [path], overwrite=overwrite)
    if not output.parent.is_dir():
        raise EncodeError(f"{output}: the folder does not exist: create it first")
    if not os.access(output.parent, os.W_OK | os.X_OK):
        raise EncodeError(f"{output.parent}: no permission to write there: give another output")
    target = output.resolve()  # a link keeps leading to the output
    remove_leftovers(target.parent, target.name)
    file, damage = counted(read_video(video))
    output_format = _FORMATS[output.suffix.lower()]
    if output_format == "ivf" and file.display.pixel_aspect != 1:
        raise OptionError(
            f"{output}: IVF cannot hold the pixel aspect of {path}, without which focal lengths "
            "are wrong: give an output that ends in .mp4, .mkv or .webm"
        )
    ignores_edits = file.is_mp4 and (
        is_for_motion or file.doubtful_times is not None  # an edit list that hides nearly all
    )
    positions, second_input, copied = None, list[str](), list[str]()
    if not is_for_motion:
        positions = read_positions(file)
        second_input, copied = carrying(file, positions, output_format, ignores_edits=ignores_edits)
    presented = None if ignores_edits else file.presented
    expected = file.num_packets if presented is None else len(presented)
    name, ffmpeg = find_encoder(options)
    encoder = ENCODERS[name]
    quality, speed = settings(encoder, options)
    before = [ffmpeg, *TALK, "-nostdin", "-y", *encoder.before_input]
    if ignores_edits:
        before += ["-ignore_editlist", "1"]
    # fmt: off
    arguments = [
        "-i", f"file:{path}",
        *second_input,
        "-map", f"0:{file.index}",
        "-vf", ",".join([*_filters(file, options), encoder.upload]),
        "-fps_mode", "passthrough",
        "-enc_time_base", "demux",
        "-c:v", encoder.ffmpeg_name,
        "-g", KEY_FRAME_DISTANCE,
        *encoder.words(quality, speed),
        "-progress", "pipe:1",
        "-f", output_format,
        *copied,
    ]
    # fmt: on
    mark: dict[str, object] = {"encoder": name, "quality": quality, "speed": speed}
    if scaling(options):
        mark["downscale"] = float(options.downscale or 1)
    if is_kept:
        mark["source"] = _source(path)
    if damage is not None:
        mark["readable"] = file.num_packets

    def convert(partial: Path, num_frames: int | None = None) -> int:
        total = num_frames or expected
        progress("encoding", 0, total)
        command = [*before, *arguments]
        if num_frames is not None:
            command += ["-frames:v", str(num_frames)]
        comment = _mark(mark if num_frames is None else {**mark, "readable": num_frames})
        command += ["-metadata", f"comment={comment}", f"file:{partial}"]
        count = _run(command, file, lambda done: progress("encoding", done, total))
        if count == 0:
            raise VideoError(
                f"{path}: no frame can be decoded, the file is damaged: give another copy"
            )
        _check_stream(path, partial, count)
        return count

    with writing(output), whole_file(target) as partial, unchanged(file.state):
        count = convert(partial)
        readable = _readable_frames(file, count, damage, presented, strict=strict)
        if readable < count:
            count = convert(partial, readable)
    loss = loss_of(file, positions, output)
    if loss is not None:
        warnings.warn(loss, stacklevel=3)
    return EncodeReport(output, encoder.ffmpeg_name, count)


def stream_of(
    video: str | os.PathLike[str],
    keep_stream: str | os.PathLike[str],
    *,
    strict: bool = False,
    options: EncodeOptions = EncodeOptions(),
    progress: Progress = no_progress,
) -> EncodeReport:
    """The AV1 stream of a video in another codec: the stream kept by an earlier run, or a new one.

    A kept stream is reused if it is complete, newer than the video, and made from a file of the
    same size and content with the settings that `options` ask for. Otherwise it is replaced. Only
    streams that this function wrote are kept streams, those of `encode` are not.

    Args:
        video: a video that ffmpeg decodes.
        keep_stream: file in which the stream is kept; its extension selects the container.
        strict: raise an error for a damaged video.
        options: the encoder and its settings.
        progress: as in `encode`.

    Raises:
        VideoError: the video is missing or cannot be decoded.
        BitstreamError: the video is damaged and `strict` is set.
        EncodeError: no encoder works.
        WriteError: the stream cannot be written.
        OptionError: an option has an invalid value, or `keep_stream` names an existing file
            that is not a kept stream.
    """
    path = Path(video)
    output = Path(keep_stream)
    if output.suffix.lower() not in _KEPT_FORMATS:
        raise OptionError(f"{output}: give a file that ends in {', '.join(_KEPT_FORMATS)}")
    file = read_file(video)
    if output.exists():
        if not may_read(output):
            raise OptionError(f"{output}: no permission to read it: change its permissions")
        mark = _mark_of(output)
        if mark is None:
            raise OptionError(
                f"{output}: exists and is not a kept stream: give another --keep_stream, or remove "
                "it"
            )
        if _fits(mark, path, options) and output.stat().st_mtime_ns >= path.stat().st_mtime_ns:
            kept = _count_packets(output)
            readable = int(mark.get("readable", 0))
            if kept and not (strict and readable):
                if readable:
                    file, _ = counted(file)
                    _warn_of_damage(file, readable, f"{output} ends there")
                return EncodeReport(output, ENCODERS[mark["encoder"]].ffmpeg_name, kept, True)
    if not os.access(output.resolve().parent, os.W_OK | os.X_OK):
        raise EncodeError(
            f"{output.resolve().parent}: the AV1 stream of {path.name} cannot be written there: "
            "give another place with --keep_stream"
        )
    return _encode(
        video,
        output,
        overwrite=True,
        strict=strict,
        options=options,
        progress=progress,
        is_for_motion=True,
        is_kept=True,
    )


def _filters(video: Video, options: EncodeOptions) -> list[str]:
    # Scaling comes last because it would mix the fields of an interlaced picture.
    return [*([DEINTERLACING] if video.is_interlaced else []), *scaling(options)]


def _run(command: Sequence[str], video: VideoFile, report: Callable[[int], None]) -> int:
    """Run ffmpeg on a video and return the number of frames it wrote."""
    size = video.stored_size
    count = dropped = doubled = 0
    with tempfile.TemporaryFile() as log_file, _process(command, log_file) as process:
        for line in process.stdout or ():
            key, _, value = line.strip().partition("=")
            if key == "frame":
                count = int(value)
                report(count)
            elif key == "drop_frames":
                dropped = int(value)
            elif key == "dup_frames":
                doubled = int(value)
        status = process.wait()
        log_file.seek(0)
        log = log_file.read().decode(errors="replace")
    if status != 0:
        reason = reason_in_log(log)
        if "No space left" in log or "File too large" in log:
            raise EncodeError(
                f"{video}: no disk space for the stream: free some space, or write it elsewhere"
            )
        if count == 0 and ("Invalid data" in log or "does not contain any stream" in log):
            raise VideoError(f"{video}: cannot be decoded: {reason}: give another copy")
        raise EncodeError(
            f"{video}: the encoder failed after {count} frames ({reason}): try another --encoder"
        )
    sizes = {(int(width), int(height)) for width, height in _NEW_SIZE.findall(log)} - {size}
    if sizes:
        raise VideoError(
            f"{video}: the picture size changes from {size[0]}x{size[1]} to "
            f"{' and '.join(f'{w}x{h}' for w, h in sorted(sizes))}: convert it to one size first"
        )
    if dropped or doubled:
        raise EncodeError(
            f"{video}: ffmpeg dropped {dropped} and duplicated {doubled} frames, so the frames of "
            "the stream would not match the video: convert it with another program first"
        )
    return count


@contextmanager
def _process(command: Sequence[str], log_file: object) -> Iterator[subprocess.Popen[str]]:
    """Run ffmpeg; it is killed if the body ends before it does."""
    process: subprocess.Popen[str] | None = None
    try:
        # An interrupt while it starts must not leave it running: it would write its output after
        # the output was removed.
        with held_back():
            process = subprocess.Popen(
                bound(command),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=log_file,  # type: ignore[call-overload]
                text=True,
            )
        yield process
    finally:
        if process is not None:
            if process.poll() is None:
                process.kill()
            process.wait()
            if process.stdout is not None:
                process.stdout.close()


def _readable_frames(
    video: VideoFile,
    count: int,
    damage: str | None,
    presented: NDArray[np.int32] | None,
    *,
    strict: bool,
) -> int:
    """Number of the `count` frames written by ffmpeg that PyAV decodes, too.

    ffmpeg continues after damage, and the frames that it skips shift all later ones.

    Args:
        video: the video.
        count: number of frames that ffmpeg wrote.
        damage: how the file is cut off, see `counted`.
        presented: the frames that were converted, see `Video.presented`; None: all.
        strict: whether damage is an error.
    """
    readable = count
    if count != (video.num_packets if presented is None else len(presented)):
        readable, damage = count_decodable(video)
        if presented is not None:
            readable = int((presented < readable).sum())
    if damage is None and readable == count:
        return count
    if damage is None or readable > count:
        raise EncodeError(
            f"{video}: ffmpeg decodes {count} frames and PyAV {readable}, so the frames of the "
            "stream would not match the video: convert it with another program first"
        )
    if readable == 0:
        raise VideoError(f"{video}: no frame can be decoded: {damage}: give another copy")
    if strict:
        raise BitstreamError(f"{video}: damaged after {readable} frames: {damage}")
    _warn_of_damage(video, readable, damage)
    return readable


def _warn_of_damage(video: VideoFile, readable: int, reason: str) -> None:
    missing = readable < (video.num_packets or 0)
    of_all = f" of {video.num_packets}" if missing else ""
    warnings.warn(
        f"{video}: damaged after {readable}{of_all} frames, only these are used: {reason}",
        stacklevel=3,
    )


def _check_stream(video: Path, stream: Path, count: int) -> None:
    """Raise an error if the stream of a video lacks frames that ffmpeg reported."""
    found = _count_packets(stream)
    if found != count:
        raise EncodeError(
            f"{video}: the encoder wrote {found} of {count} frames: try another --encoder"
        )


def _count_packets(stream: Path) -> int:
    """Number of frames of a stream that `encode` wrote; 0 if it is damaged or not AV1."""
    try:
        with open_stream(stream) as opened:
            return sum(1 for _ in opened.packets())
    except (VideoError, NotAv1Error, BitstreamError):
        return 0


def _source(video: Path) -> str:
    """Identifies the content of a video: its size and a digest of parts of it.

    Videos without compression often have the same size.
    """
    size = video.stat().st_size
    digest = hashlib.sha256()
    with video.open("rb") as file:
        for start in (0, size // 2, size - _SAMPLE):
            file.seek(max(0, start))
            digest.update(file.read(_SAMPLE))
    return f"{size}:{digest.hexdigest()[:16]}"


def _mark(facts: Mapping[str, object]) -> str:
    return " ".join([_MARK, *(f"{key}={value}" for key, value in facts.items())])


def _mark_of(stream: Path) -> dict[str, str] | None:
    """The source and settings recorded in a kept stream; None for other files."""
    try:
        with av.open(os.path.abspath(stream)) as opened:
            tags = {key.lower(): value for key, value in opened.metadata.items()}
    except (av.error.FFmpegError, OSError, ValueError):
        return None
    name, *words = tags.get("comment", "").split(" ")
    if name != _MARK or not all("=" in word for word in words):
        return None
    mark = dict(word.split("=", 1) for word in words)
    return mark if "source" in mark else None


def _fits(mark: Mapping[str, str], video: Path, options: EncodeOptions) -> bool:
    """Whether a kept stream was made from the video with these options; 'auto' is any encoder."""
    if mark.get("encoder") not in ENCODERS or mark.get("source") != _source(video):
        return False
    encoder = ENCODERS[mark["encoder"]]
    if options.encoder not in ("auto", mark["encoder"]):
        return False
    quality, speed = settings(encoder, options)
    speeds = {speed}
    if options.speed is None and options.effort != "full":
        speeds = {encoder.speed, encoder.quick_speed}
    return (
        mark.get("quality") == str(quality)
        and mark.get("speed") in {str(own) for own in speeds}
        and mark.get("downscale", "1.0") == str(float(options.downscale or 1))
    )

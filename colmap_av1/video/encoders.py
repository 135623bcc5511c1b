"""ffmpeg's AV1 encoders, their options, and which of them work on this machine."""

from __future__ import annotations

import contextlib
import functools
import re
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import dataclass

import imageio_ffmpeg

from colmap_av1.errors import EncodeError
from colmap_av1.options import EncodeOptions
from colmap_av1.options.video import NUM_QUALITIES
from colmap_av1.util.processes import bound

# An encoder works if it can encode this many frames.
_PROBE_FRAMES = 8
_PROBE_TIMEOUT = 30.0
# libaom's realtime mode starts at this speed.
_LIBAOM_REALTIME = 5
# ffmpeg's -cpu-used does not accept higher speeds, libaom does.
_FFMPEG_FASTEST = 8
# At higher speeds a fifth of the time would be spent on updating the costs of symbols. Streams have
# the same size without the updates. Without any, libaom does not count the blocks with a warp
# either, and streams with a few of them cannot be decoded: warps, which are rare, are switched off.
_LIBAOM_FASTER = (
    "mode-cost-upd-freq=3:coeff-cost-upd-freq=3:mv-cost-upd-freq=3:enable-warped-motion=0"
)
# In frames; longer than most videos, so that the first frame is the only intra frame.
KEY_FRAME_DISTANCE = "9999"
# Log options; `level` starts every message with its severity.
TALK = ("-hide_banner", "-nostats", "-v", "level+info")
_MESSAGE_SOURCE = re.compile(r"^(\[[^\]]+\] )+")
_SEVERE = re.compile(r"\[(error|fatal|panic)\]")


@dataclass(frozen=True)
class _Encoder:
    """An encoder of ffmpeg.

    Attributes:
        ffmpeg_name: its name in ffmpeg.
        quality: default quality on the scale of EncodeOptions.
        speed: default speed on the encoder's own scale.
        quick_speed: default speed of quick conversions.
        words: ffmpeg's arguments for a quality and a speed.
        before_input: arguments that precede the input.
        upload: filters that set the pixel format and send pictures to the device.
    """

    ffmpeg_name: str
    quality: int
    speed: int
    quick_speed: int
    words: Callable[[int, int], list[str]]
    before_input: tuple[str, ...] = ()
    upload: str = "format=yuv420p"


def _nvenc(quality: int, speed: int) -> list[str]:
    # These are the flags of the published method, see CITATION.cff.
    rate = ["-rc", "constqp", "-qp", str(_q_index(quality))]
    return ["-tune", "hq", "-preset", f"p{speed}", *rate, "-b_ref_mode", "0", "-bf", "0"]


def _qsv(quality: int, speed: int) -> list[str]:
    return [
        "-preset",
        str(speed),
        "-q:v",
        str(_q_index(quality)),
        "-bf",
        "0",
        "-low_delay_brc",
        "1",
    ]


def _amf(quality: int, speed: int) -> list[str]:
    q_index = str(_q_index(quality))
    how = ["-usage", "lowlatency", "-quality", str(speed), "-bf", "0"]
    return [*how, "-rc", "cqp", "-qp_i", q_index, "-qp_p", q_index]


def _vaapi(quality: int, speed: int) -> list[str]:
    rate = ["-rc_mode", "CQP", "-global_quality", str(_q_index(quality))]
    return ["-compression_level", str(speed), *rate, "-bf", "0"]


def _libaom(quality: int, speed: int) -> list[str]:
    usage = "realtime" if speed >= _LIBAOM_REALTIME else "good"
    how = ["-usage", usage, "-cpu-used", str(min(speed, _FFMPEG_FASTEST)), "-lag-in-frames", "0"]
    how += ["-row-mt", "1", "-crf", str(quality), "-b:v", "0"]
    if speed <= _FFMPEG_FASTEST:
        return how
    return [*how, "-aom-params", f"cpu-used={speed}:{_LIBAOM_FASTER}"]


def _svt(quality: int, speed: int) -> list[str]:
    # Low delay without hierarchical layers: frames refer to the frames just before them.
    how = "pred-struct=1:hierarchical-levels=0"
    return ["-preset", str(speed), "-crf", str(quality), "-svtav1-params", how]


# In the order in which they are tried. ffmpeg has no AV1 encoder for Apple's VideoToolbox.
ENCODERS = {
    "nvenc": _Encoder("av1_nvenc", 20, 1, 1, _nvenc),
    "qsv": _Encoder("av1_qsv", 20, 7, 7, _qsv, upload="format=nv12"),
    "amf": _Encoder("av1_amf", 20, 100, 100, _amf, upload="format=nv12"),
    "vaapi": _Encoder(
        "av1_vaapi",
        20,
        7,
        7,
        _vaapi,
        before_input=("-vaapi_device", "/dev/dri/renderD128"),
        upload="format=nv12,hwupload",
    ),
    # Speed 7 takes a third to a half of the time of speed 6 for models that are nearly as good.
    # Speed 8 saves little more and gives up to 8 % fewer points. Other settings are compared in
    # docs/benchmarks.md, "Encoders".
    "libaom": _Encoder("libaom-av1", 20, 7, 10, _libaom),
    "svt": _Encoder("libsvtav1", 20, 8, 8, _svt),
}


def find_encoder(options: EncodeOptions) -> tuple[str, str]:
    """Find an encoder that works by encoding a few frames.

    Hardware encoders are tried first, unless the options name an encoder. The ffmpeg of
    imageio-ffmpeg ($IMAGEIO_FFMPEG_EXE if set) is preferred to the one on PATH.

    Returns:
        The encoder's name in EncodeOptions, and the path of the ffmpeg program that has it.

    Raises:
        EncodeError: no encoder works.
    """
    names = list(ENCODERS) if options.encoder == "auto" else [str(options.encoder)]
    programs = _ffmpeg_programs()
    reasons = []
    for name in names:
        quality, speed = settings(ENCODERS[name], options)
        for program in programs:
            # A dynamically linked ffmpeg takes several times as long to start as a probe takes,
            # so ask it once which encoders it has.
            if program != programs[0] and ENCODERS[name].ffmpeg_name not in _encoders_of(program):
                reasons.append(f"{name}: {program} does not have it")
                continue
            reason = _probe(program, ENCODERS[name], quality, speed)
            if reason is None:
                return name, program
            reasons.append(f"{name}: {reason}")
    if options.encoder == "auto":
        tried = f"none of {', '.join(names)} works"
        remedy = "pip install imageio-ffmpeg"
        if options.speed is not None:
            remedy += ", or leave out --speed"
        raise EncodeError(
            f"no AV1 encoder: {tried} with {' or '.join(programs) or 'any ffmpeg'} "
            f"({reasons[-1] if reasons else 'there is none'}): {remedy}"
        )
    why = "; ".join(dict.fromkeys(reasons)) or "there is no ffmpeg"
    raise EncodeError(
        f"the encoder does not work here ({why}): give another --encoder, such as auto"
    )


def _q_index(quality: int) -> int:
    """Quantizer index (0 to 255) of a quality. libaom's own scale is nearly linear, too."""
    return round(quality * 255 / (NUM_QUALITIES - 1))


def settings(encoder: _Encoder, options: EncodeOptions) -> tuple[int, int]:
    """Quality and speed from the options, or the encoder's defaults."""
    quality = encoder.quality if options.quality is None else options.quality
    default_speed = encoder.quick_speed if options.effort == "quick" else encoder.speed
    return quality, default_speed if options.speed is None else options.speed


def _ffmpeg_programs() -> list[str]:
    programs = []
    with contextlib.suppress(RuntimeError):  # the package has no binary for this system
        programs.append(imageio_ffmpeg.get_ffmpeg_exe())
    on_path = shutil.which("ffmpeg")
    if on_path is not None and on_path not in programs:
        programs.append(on_path)
    return programs


@functools.cache
def _encoders_of(program: str) -> str:
    """The list of encoders that an ffmpeg program prints."""
    command = [program, "-hide_banner", "-encoders"]
    try:
        run = _run(command)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return run.stdout


@functools.cache
def _probe(program: str, encoder: _Encoder, quality: int, speed: int) -> str | None:
    """Try an encoder. Return why it does not work, or None if it works."""
    # fmt: off
    command = [
        program,
        *TALK,
        "-nostdin",
        *encoder.before_input,
        "-f", "lavfi",
        "-i", "testsrc2=size=320x192:rate=25",
        "-frames:v", str(_PROBE_FRAMES),
        "-vf", encoder.upload,
        "-c:v", encoder.ffmpeg_name,
        "-g", KEY_FRAME_DISTANCE,
        *encoder.words(quality, speed),
        "-f", "null",
        "-",
    ]
    # fmt: on
    try:
        run = _run(bound(command))  # an encoder of a broken driver may hang
    except subprocess.TimeoutExpired:
        return f"no frame within {_PROBE_TIMEOUT:.0f} s"
    except OSError as error:
        return f"{program}: {error.strerror}"
    return None if run.returncode == 0 else reason_in_log(run.stderr)


def _run(command: list[str]) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        errors="replace",  # drivers' messages may have another encoding
        timeout=_PROBE_TIMEOUT,
        check=False,
    )


def reason_in_log(text: str) -> str:
    """The reason of a failure in ffmpeg's log, on one line."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    # The first error gives the reason; later ones only say that the conversion failed. If ffmpeg
    # did not start, the lines come from another program, such as the loader, without a severity.
    errors = [line for line in lines if _SEVERE.search(line)] or lines
    return _MESSAGE_SOURCE.sub("", errors[0]).rstrip(".") if errors else "it gave no message"

"""AV1 encoders of ffmpeg, their options, and which of them works here."""

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

# Whether an encoder works is found out by encoding so many frames.
_PROBE_FRAMES = 8
_PROBE_TIMEOUT = 30.0
_LIBAOM_REALTIME = 5
# ffmpeg's own option goes no further, libaom does.
_FFMPEG_FASTEST = 8
# Beyond, a fifth of the time would go into bringing the costs of symbols up to date; streams are of
# the same size without.
_LIBAOM_FASTER = "mode-cost-upd-freq=3:coeff-cost-upd-freq=3:mv-cost-upd-freq=3"
# A frame further than any video is long: the first is the only intra frame.
KEY_FRAME_DISTANCE = "9999"
# So that every message says how grave it is.
TALK = ("-hide_banner", "-nostats", "-v", "level+info")
_MESSAGE_SOURCE = re.compile(r"^(\[[^\]]+\] )+")
_GRAVE = re.compile(r"\[(error|fatal|panic)\]")


@dataclass(frozen=True)
class _Encoder:
    """An encoder of ffmpeg.

    Attributes:
        ffmpeg_name: ffmpeg's name of it.
        quality: default on the scale of EncodeOptions.
        speed: default on the encoder's own scale.
        quick_speed: that of quick conversions.
        words: ffmpeg's words for a quality and a speed.
        before_input: words before the input.
        upload: filter that hands the pictures to the device, and the pixel format.
    """

    ffmpeg_name: str
    quality: int
    speed: int
    quick_speed: int
    words: Callable[[int, int], list[str]]
    before_input: tuple[str, ...] = ()
    upload: str = "format=yuv420p"


def _nvenc(quality: int, speed: int) -> list[str]:
    # The published method's flags.
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
    # Its realtime mode starts at speed 5.
    usage = "realtime" if speed >= _LIBAOM_REALTIME else "good"
    how = ["-usage", usage, "-cpu-used", str(min(speed, _FFMPEG_FASTEST)), "-lag-in-frames", "0"]
    how += ["-row-mt", "1", "-crf", str(quality), "-b:v", "0"]
    if speed <= _FFMPEG_FASTEST:
        return how
    return [*how, "-aom-params", f"cpu-used={speed}:{_LIBAOM_FASTER}"]


def _svt(quality: int, speed: int) -> list[str]:
    # Low delay, and without layers: frames refer to those just before them.
    how = "pred-struct=1:hierarchical-levels=0"
    return ["-preset", str(speed), "-crf", str(quality), "-svtav1-params", how]


# In the order in which they are tried. ffmpeg has no AV1 encoder of Apple's VideoToolbox.
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
    # Speed 7 takes a third to a half of the time of 6 for models that are nearly as good; 8 saves
    # little more and gives up to 8 % fewer points. What else was tried: "Encoders" in
    # examples/benchmarks/README.md.
    "libaom": _Encoder("libaom-av1", 20, 7, 10, _libaom),
    "svt": _Encoder("libsvtav1", 20, 8, 8, _svt),
}


def find_encoder(options: EncodeOptions) -> tuple[str, str]:
    """Find an encoder that works, by letting it encode a few frames.

    Hardware encoders are tried first, unless the options name one. The ffmpeg of
    imageio-ffmpeg ($IMAGEIO_FFMPEG_EXE where that is set) is preferred to the one on the PATH.

    Returns:
        The encoder's name in EncodeOptions, and the ffmpeg program that has it.

    Raises:
        EncodeError: none works.
    """
    names = list(ENCODERS) if options.encoder == "auto" else [str(options.encoder)]
    programs = _ffmpeg_programs()
    reasons = []
    for name in names:
        quality, speed = settings(ENCODERS[name], options)
        for program in programs:
            # To start one that is not linked as a whole takes several times as long as to probe.
            if program != programs[0] and ENCODERS[name].ffmpeg_name not in _encoders_of(program):
                reasons.append(f"{name}: {program} does not have it")
                continue
            reason = _probe(program, ENCODERS[name], quality, speed)
            if reason is None:
                return name, program
            reasons.append(f"{name}: {reason}")
    if options.encoder == "auto":
        tried = f"none of {', '.join(names)} works"
        raise EncodeError(
            f"no AV1 encoder: {tried} with {' or '.join(programs) or 'any ffmpeg'} "
            f"({reasons[-1] if reasons else 'there is none'}): pip install imageio-ffmpeg"
        )
    raise EncodeError(
        f"the encoder does not work here ({'; '.join(reasons) or 'there is no ffmpeg'}): give "
        "another --encoder, such as auto"
    )


def _q_index(quality: int) -> int:
    """Quantiser index (0 to 255) of a quality; libaom's own scale is nearly linear, too."""
    return round(quality * 255 / (NUM_QUALITIES - 1))


def settings(encoder: _Encoder, options: EncodeOptions) -> tuple[int, int]:
    """Quality and speed asked for, or the encoder's own."""
    quality = encoder.quality if options.quality is None else options.quality
    usual = encoder.quick_speed if options.effort == "quick" else encoder.speed
    return quality, usual if options.speed is None else options.speed


def _ffmpeg_programs() -> list[str]:
    programs = []
    with contextlib.suppress(RuntimeError):  # it has none for this system
        programs.append(imageio_ffmpeg.get_ffmpeg_exe())
    on_path = shutil.which("ffmpeg")
    if on_path is not None and on_path not in programs:
        programs.append(on_path)
    return programs


@functools.cache
def _encoders_of(program: str) -> str:
    """What an ffmpeg says of its encoders."""
    command = [program, "-hide_banner", "-encoders"]
    try:
        run = subprocess.run(
            command, capture_output=True, text=True, timeout=_PROBE_TIMEOUT, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return run.stdout


def _probe(program: str, encoder: _Encoder, quality: int, speed: int) -> str | None:
    """Why an encoder does not work; None where it does."""
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
        run = subprocess.run(
            command, capture_output=True, text=True, timeout=_PROBE_TIMEOUT, check=False
        )
    except subprocess.TimeoutExpired:
        return f"no frame within {_PROBE_TIMEOUT:.0f} s"
    except OSError as error:
        return f"{program}: {error.strerror}"
    return None if run.returncode == 0 else reason_of(run.stderr)


def reason_of(text: str) -> str:
    """What ffmpeg gives as the reason of a failure, on a line."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    # Later lines say that the conversion failed, the first says why. Where ffmpeg itself has
    # not come to speak, whoever stands in its place has.
    grave = [line for line in lines if _GRAVE.search(line)] or lines
    return _MESSAGE_SOURCE.sub("", grave[0]).rstrip(".") if grave else "it ended without a message"

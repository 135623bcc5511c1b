"""Options of reading a bitstream, and of converting a video that is not AV1."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from colmap_av1.options.fields import Options, option

NUM_QUALITIES = 64
_NUM_OPERATING_POINTS = 32  # that a sequence header has room for (5.5.1)


@dataclass(frozen=True)
class ReadOptions(Options):
    """How the bitstream is read."""

    title: ClassVar[str] = "bitstream"

    operating_point: int = option(
        0,
        "operating point of a scalable stream (AV1 specification, 7.20: choose_operating_point)",
        least=0,
        most=_NUM_OPERATING_POINTS - 1,
    )
    num_threads: int | None = option(
        None,
        "threads that parse tiles, and groups of frames that start at a key frame, in parallel; "
        "None: one per CPU that the process may use. Does not change the result",
        least=1,
    )
    strict: bool = option(
        False,
        "fail on a damaged stream instead of using the frames before the damage, and on tiles that "
        "end otherwise than the specification demands",
    )
    max_frame_size: int = option(
        16384 * 16384,
        "largest accepted frame in luma samples; guards memory against hostile headers",
        above=0,
        unit="samples",
    )


@dataclass(frozen=True)
class EncodeOptions(Options):
    """How a video that is not AV1 is converted."""

    title: ClassVar[str] = "conversion of a video that is not AV1"

    encoder: Literal["auto", "nvenc", "qsv", "amf", "vaapi", "libaom", "svt"] = option(
        "auto", "the encoder; auto: the first that works, hardware before software", common=True
    )
    quality: int | None = option(
        None,
        "constant quantiser, 0 (best) to 63; None: the encoder's default",
        least=0,
        most=NUM_QUALITIES - 1,
    )
    speed: int | None = option(
        None,
        "preset on the encoder's own scale: -cpu-used of libaom (5 and above: its realtime mode), "
        "-preset of the others; None: what effort says",
    )
    effort: Literal["auto", "full", "quick"] = option(
        "auto",
        "full: search motion as exactly as poses that come from it alone need; quick: in half of "
        "the time, for poses that are corrected on the pictures; auto: quick in reconstruct, else "
        "full",
    )
    downscale: float | None = option(
        None,
        "width and height of pictures are divided by this before they are coded; keypoints are "
        "scaled back, those of the longest tracks corrected on the full pictures, and images keep "
        "the video's size; None: by a whole number that leaves large pictures half a megapixel or "
        "more; by 1 in encode, whose output is a video of its own",
        least=1,
        most=16,
    )

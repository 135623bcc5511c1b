"""Options of reading a bitstream, and of converting a video that is not AV1."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Literal

from colmap_av1.options.fields import Options, option

NUM_QUALITIES = 64
_NUM_OPERATING_POINTS = 32  # the most that a sequence header can describe (5.5.1)


@dataclass(frozen=True)
class ReadOptions(Options):
    """How the bitstream is read.

    Examples:
        >>> from colmap_av1 import MatchOptions, ReadOptions
        >>> options = MatchOptions(read=ReadOptions(strict=True))
        >>> options.read.strict
        True
    """

    title: ClassVar[str] = "bitstream"

    operating_point: int = option(
        0,
        "operating point of a scalable stream (AV1 specification, 6.4.1: choose_operating_point)",
        least=0,
        most=_NUM_OPERATING_POINTS - 1,
    )
    num_threads: int | None = option(
        None,
        "number of threads that parse tiles, and groups of frames that start at a key frame, in "
        "parallel; None: one per CPU that the process may use. Does not change the result",
        least=1,
    )
    strict: bool = option(
        False,
        "fail on a damaged stream instead of using the frames before the damage, and on tiles that "
        "do not end as the specification requires",
    )
    max_frame_size: int = option(
        16384 * 16384,
        "largest accepted frame in luma samples; protects memory from malicious headers",
        above=0,
        unit="samples",
    )


@dataclass(frozen=True)
class EncodeOptions(Options):
    """How a video that is not AV1 is converted.

    Examples:
        >>> from colmap_av1 import EncodeOptions, MatchOptions
        >>> options = MatchOptions(encode=EncodeOptions(encoder="libaom"))
        >>> options.encode.encoder
        'libaom'
    """

    title: ClassVar[str] = "conversion of a video that is not AV1"

    encoder: Literal["auto", "nvenc", "qsv", "amf", "vaapi", "libaom", "svt"] = option(
        "auto", "encoder; auto: the first that works, hardware before software", common=True
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
        "-preset of the others; None: set by effort",
    )
    effort: Literal["auto", "full", "quick"] = option(
        "auto",
        "full: an exact motion search, for poses from motion alone; quick: half the time, for "
        "poses that are refined on the pictures; auto: quick in reconstruct and in match with a "
        "joint estimate, else full",
    )
    downscale: float | None = option(
        None,
        "divide width and height of the pictures by this before encoding; keypoints are scaled "
        "back, those of the longest tracks are refined on the full pictures, and images keep the "
        "video's size; None: a whole number that leaves large pictures half a megapixel or more, "
        "but 1 in encode",
        least=1,
        most=16,
    )

    @property
    def quick_by_default(self) -> EncodeOptions:
        """A copy for poses that are refined on the pictures: effort "auto" becomes "quick"."""
        return replace(self, effort="quick") if self.effort == "auto" else self

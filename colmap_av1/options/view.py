"""Options of drawing motion and tracks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from colmap_av1.options.fields import Options, option


@dataclass(frozen=True)
class ViewOptions(Options):
    """How motion and tracks are drawn over the frames of a video.

    Examples:
        >>> from colmap_av1 import ViewOptions
        >>> options = ViewOptions(draw="tracks", tail=20)
        >>> options.tail
        20
    """

    title: ClassVar[str] = "drawing"

    draw: Literal["motion", "tracks", "both"] = option(
        "both",
        "motion: direction of motion as colour; tracks: tracks with tails; both: side by side",
        common=True,
    )
    opacity: float = option(
        0.6,
        "opacity of the motion's colour, 0 to 1",
        least=0,
        most=1,
        unit="an opacity",
        common=True,
    )
    tail: int = option(
        8, "length of a track's tail, in frames", least=0, unit="frames", common=True
    )
    spacing: int = option(
        8,
        "draw one track for each square of this many pixels",
        least=1,
        unit="pixels",
        common=True,
    )

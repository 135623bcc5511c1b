"""Options of where a model lies in the world: its scale, what is up, its coordinates."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Literal

from colmap_av1.errors import OptionError
from colmap_av1.options.fields import Options, option


@dataclass(frozen=True)
class Mark:
    """A place that an image shows, or the image's camera.

    Attributes:
        image: name of the image.
        xy: pixels, the first one's centre at (0.5, 0.5); None: the camera's centre.
    """

    image: str
    xy: tuple[float, float] | None


@dataclass(frozen=True)
class End:
    """An end of a known distance: a camera's centre, or what two images or more show of a place."""

    marks: tuple[Mark, ...]

    def __str__(self) -> str:
        return "+".join(
            m.image if m.xy is None else f"{m.image}:{m.xy[0]:g}:{m.xy[1]:g}" for m in self.marks
        )


@dataclass(frozen=True)
class KnownDistance:
    """A distance in metres, between two ends."""

    metres: float
    ends: tuple[End, End]

    def __str__(self) -> str:
        return f"{self.metres:g}={self.ends[0]},{self.ends[1]}"


@dataclass(frozen=True)
class PlaceOptions(Options):
    """Where a model lies in the world."""

    title: ClassVar[str] = "place and scale"

    align: Literal["gps", "none"] = option(
        "gps",
        "gps: in metres east, north and up of where the video or the photos say they were taken, "
        "where they say it of a path; none: as the mapper leaves it",
    )
    upright: bool = option(
        False,
        "turn the model so that z is up: by the gravity that the video recorded, else by vertical "
        "lines in its pictures, else by how the camera was held; by positions where align finds "
        "them",
    )
    scale: str | None = option(
        None,
        "METRES=A,B: the known distance of two images' cameras, or of two places, each marked in "
        "two images or more of the model, as in "
        "1.25=a.png:310:402+b.png:290:398,a.png:55:410+b.png:61:405",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.scale is not None:
            parse_distance(self.scale)


def parse_distance(text: str) -> KnownDistance:
    """Read a known distance, METRES=A,B.

    Raises:
        OptionError: it is none.
    """
    number, _, rest = text.partition("=")
    try:
        metres = float(number)
        first, second = (_parse_end(word.strip()) for word in rest.split(","))
    except ValueError:
        raise OptionError(
            f"scale '{text}': give METRES=A,B, such as 2.5=frame_000010.png,frame_000200.png, or "
            "for A and B what two images show of them: frame_000010.png:310:402+"
            "frame_000200.png:290:398"
        ) from None
    if not (math.isfinite(metres) and metres > 0):
        raise OptionError(f"scale '{text}': give a distance above 0 metres")
    if first == second:
        raise OptionError(f"scale '{text}': both ends are one: give two")
    return KnownDistance(metres, (first, second))


def _parse_end(word: str) -> End:
    marks = []
    for mark in word.split("+"):
        image, *pixels = mark.rsplit(":", 2)
        if not image or len(pixels) == 1:
            raise ValueError(mark)
        xy = (float(pixels[0]), float(pixels[1])) if pixels else None
        if xy is not None and not all(map(math.isfinite, xy)):
            raise ValueError(mark)
        marks.append(Mark(image, xy))
    images = {mark.image for mark in marks}
    alone = len(marks) == 1
    if any((mark.xy is None) != alone for mark in marks) or len(images) < len(marks):
        raise ValueError(word)
    return End(tuple(marks))

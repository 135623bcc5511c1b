"""Options of a model's world coordinates: scale, up direction and position."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Literal

from colmap_av1.errors import OptionError
from colmap_av1.options.fields import Options, option


@dataclass(frozen=True)
class Mark:
    """A point that is marked in an image, or the centre of the image's camera.

    Attributes:
        image: name of the image.
        xy: in pixels, the first pixel's centre at (0.5, 0.5); None: the camera's centre.
    """

    image: str
    xy: tuple[float, float] | None


@dataclass(frozen=True)
class End:
    """An end of a known distance: a camera's centre, or a point marked in two or more images."""

    marks: tuple[Mark, ...]

    def __str__(self) -> str:
        return "+".join(
            m.image if m.xy is None else f"{m.image}:{m.xy[0]:g}:{m.xy[1]:g}" for m in self.marks
        )


@dataclass(frozen=True)
class KnownDistance:
    """A known distance in metres between two ends."""

    metres: float
    ends: tuple[End, End]

    def __str__(self) -> str:
        return f"{self.metres:g}={self.ends[0]},{self.ends[1]}"


@dataclass(frozen=True)
class PlaceOptions(Options):
    """How a model is placed in world coordinates.

    Examples:
        >>> from colmap_av1 import PlaceOptions, ReconstructOptions
        >>> options = ReconstructOptions(place=PlaceOptions(align="none"))
        >>> options.place.align
        'none'
    """

    title: ClassVar[str] = "place and scale"

    align: Literal["gps", "none"] = option(
        "gps",
        "gps: metres east, north and up, if the GPS positions of the video or the photos form a "
        "path; none: keep the mapper's coordinates",
    )
    upright: bool = option(
        False,
        "rotate the model so that z is up: by GPS positions if align finds them, else by the "
        "gravity recorded in the video, else by vertical lines in the pictures, else by how the "
        "camera was held",
    )
    scale: str | None = option(
        None,
        "METRES=A,B: the known distance between the cameras of two images, or between two points, "
        "each marked in two or more images of the model, such as "
        "1.25=a.png:310:402+b.png:290:398,a.png:55:410+b.png:61:405",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.scale is not None:
            parse_distance(self.scale)


def parse_distance(text: str) -> KnownDistance:
    """Parse a known distance, METRES=A,B.

    Raises:
        OptionError: the text is invalid.
    """
    number, _, rest = text.partition("=")
    try:
        metres = float(number)
        first, second = (_parse_end(word.strip()) for word in rest.split(","))
    except ValueError:
        raise OptionError(
            f"scale '{text}' is invalid: give METRES=A,B, such as "
            "2.5=frame_000010.jpg,frame_000200.jpg, or mark A and B in two images each, such as "
            "frame_000010.jpg:310:402+frame_000200.jpg:290:398"
        ) from None
    if not (math.isfinite(metres) and metres > 0):
        raise OptionError(f"scale '{text}' is not above 0 metres: give a positive distance")
    if first == second:
        raise OptionError(f"scale '{text}': both ends are the same: give two different ends")
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

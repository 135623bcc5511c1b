"""The focal length that a container says, as phones write it."""

from __future__ import annotations

import math
import re

from colmap_av1.util.texts import shown

# Of the picture that a focal length in millimetres is equivalent to, CIPA DCG-001: 36 x 24.
_FILM_DIAGONAL = math.hypot(36.0, 24.0)
_TAG = "camera.focal_length.35mm_equivalent"
# No lens of a camera that films has others.
_SHORTEST, _LONGEST = 6.0, 1200.0


def said_focal_length(
    tags: tuple[tuple[str, str], ...], size: tuple[int, int], pixel_aspect: float = 1.0
) -> float | None:
    """The focal length that a container says, by the diagonal of its pictures.

    Args:
        tags: names in lower case, and values, of what the container says.
        size: (width, height) of the pictures in pixels.
        pixel_aspect: width of a pixel over its height.

    Returns:
        In heights of a pixel; None where it says none, or none that can be one.
    """
    millimetres = _millimetres(_said(tags))
    if millimetres is None:
        return None
    return millimetres / _FILM_DIAGONAL * math.hypot(size[0] * pixel_aspect, size[1])


def doubtful_lens(tags: tuple[tuple[str, str], ...]) -> str | None:
    """A focal length that a container says and no lens has, in words; None: there is none."""
    said = _said(tags).strip()
    if not said or _millimetres(said) is not None:
        return None
    return (
        f"the container says a focal length of '{shown(said)}' mm (of 35 mm film), which no lens "
        "that films has: that is left out"
    )


def _said(tags: tuple[tuple[str, str], ...]) -> str:
    return next((value for name, value in tags if name.endswith(_TAG)), "")


def _millimetres(said: str) -> float | None:
    """The number that is said; None where it is none, or no lens has it."""
    if re.fullmatch(r"\s*\d+(\.\d+)?\s*", said) is None:
        return None
    millimetres = float(said)
    return millimetres if _SHORTEST <= millimetres <= _LONGEST else None

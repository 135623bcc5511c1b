"""The focal length that a container says, as phones write it."""

from __future__ import annotations

import math
import re

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
    said = next((value for name, value in tags if name.endswith(_TAG)), "")
    if re.fullmatch(r"\s*\d+(\.\d+)?\s*", said) is None:
        return None
    millimetres = float(said)
    if not _SHORTEST <= millimetres <= _LONGEST:
        return None
    return millimetres / _FILM_DIAGONAL * math.hypot(size[0] * pixel_aspect, size[1])

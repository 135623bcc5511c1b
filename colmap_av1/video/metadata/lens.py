"""The focal length in the metadata of a container, which phones write."""

from __future__ import annotations

import math
import re

from colmap_av1.util.texts import excerpt

# Diagonal in millimetres of the 36 x 24 mm frame that equivalent focal lengths refer to (CIPA
# DCG-001).
_FILM_DIAGONAL = math.hypot(36.0, 24.0)
_TAG = "camera.focal_length.35mm_equivalent"
# Values outside this range, in millimetres, are implausible.
_SHORTEST, _LONGEST = 6.0, 1200.0


def container_focal_length(
    tags: tuple[tuple[str, str], ...], size: tuple[int, int], pixel_aspect: float = 1.0
) -> float | None:
    """The focal length that a container gives, converted by the diagonal of the pictures.

    Args:
        tags: metadata of the container: (name in lower case, value) pairs.
        size: (width, height) of the pictures in pixels.
        pixel_aspect: width of a pixel divided by its height.

    Returns:
        The focal length in pixel heights; None if it is missing or implausible.
    """
    millimetres = _millimetres(_tag_value(tags))
    if millimetres is None:
        return None
    return millimetres / _FILM_DIAGONAL * math.hypot(size[0] * pixel_aspect, size[1])


def implausible_focal_length(tags: tuple[tuple[str, str], ...]) -> str | None:
    """Describe an implausible focal length that a container gives; None if there is none."""
    text = _tag_value(tags).strip()
    if not text or _millimetres(text) is not None:
        return None
    return (
        f"the container's focal length of '{excerpt(text)}' mm (35 mm equivalent) is implausible: "
        "it is ignored"
    )


def _tag_value(tags: tuple[tuple[str, str], ...]) -> str:
    return next((value for name, value in tags if name.endswith(_TAG)), "")


def _millimetres(text: str) -> float | None:
    """The focal length as a number; None if it is not a number or is implausible."""
    if re.fullmatch(r"\s*\d+(\.\d+)?\s*", text) is None:
        return None
    millimetres = float(text)
    return millimetres if _SHORTEST <= millimetres <= _LONGEST else None

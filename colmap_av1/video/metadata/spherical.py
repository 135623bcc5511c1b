"""Spherical videos, which no camera model fits, and the command that cuts views from them."""

from __future__ import annotations

import math
import shlex
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from colmap_av1.errors import VideoError

# FFmpeg's AVSphericalProjection: name for messages, and the matching input of its filter v360.
_PROJECTIONS = {
    0: ("equirectangular", "equirect"),
    1: ("cube maps", "c3x2"),
    2: ("equirectangular", "equirect"),
    3: ("half equirectangular", "hequirect"),
}
# Directions of the views in degrees, and their field of view, which is so wide that they overlap.
_YAWS = {"equirect": (0, 90, 180, -90), "c3x2": (0, 90, 180, -90), "hequirect": (-40, 40)}
_FIELD_OF_VIEW = 100
_MULTIPLE = 16
# Spherical cameras do not write narrower pictures.
_MIN_WIDTH = 1920


def projection_of(side_data: Sequence[Any]) -> int | None:
    """FFmpeg's number of the spherical projection of a decoded frame; None if it has none."""
    data = next((d for d in side_data if d.type.name == "SPHERICAL"), None)
    number = struct.unpack("=i", bytes(data)[:4])[0] if data is not None else None
    return number if number in _PROJECTIONS else None


def check_is_plane(path: Path, projection: int | None, width: int) -> None:
    """Check that a video is not spherical; the error has the command that cuts views from it.

    Args:
        path: the video.
        projection: as returned by `projection_of`.
        width: width of its pictures in pixels, which determines the resolution of the views.

    Raises:
        VideoError: the video is spherical.
    """
    if projection is None:
        return
    name, of_filter = _PROJECTIONS[projection]
    raise VideoError(
        f"{path}: its pictures are {name}, which no camera model fits: cut views from it and give "
        f"each as --video: {_line(path, of_filter, width)}"
    )


def spherical_warnings(path: Path, projection: int | None, size: tuple[int, int]) -> list[str]:
    """A warning if pictures have the shape of equirectangular ones but no such metadata."""
    if projection is not None or size[0] != 2 * size[1] or size[0] < _MIN_WIDTH:
        return []
    return [
        f"{path}: its pictures are twice as wide as high, like those of spherical video: if they "
        f"are equirectangular, cut views from it: {_line(path, 'equirect', size[0])}"
    ]


def _line(path: Path, of_filter: str, width: int) -> str:
    """The shell command that cuts views from a video."""
    around = math.pi if of_filter == "hequirect" else 2 * math.pi
    side = 2 * math.tan(math.radians(_FIELD_OF_VIEW / 2)) * width / around
    side = max(round(side / _MULTIPLE) * _MULTIPLE, _MULTIPLE)
    view = f"{of_filter}:flat:yaw=$yaw:h_fov={_FIELD_OF_VIEW}:v_fov={_FIELD_OF_VIEW}"
    yaws = " ".join(map(str, _YAWS[of_filter]))
    stem = shlex.quote(f"{path.stem}_")
    return (
        f"for yaw in {yaws}; do ffmpeg -i {shlex.quote(str(path))} -vf v360={view}:w={side}:"
        f"h={side} -crf 14 {stem}$yaw.mp4; done"
    )

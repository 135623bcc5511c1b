"""Videos of all directions, which no one camera model fits, and how views are cut from them."""

from __future__ import annotations

import math
import shlex
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from colmap_av1.errors import VideoError

# AVSphericalProjection of FFmpeg: its name, and that of its filter v360's input.
_PROJECTIONS = {
    0: ("equirectangular", "equirect"),
    1: ("those of a cube map", "c3x2"),
    2: ("equirectangular", "equirect"),
    3: ("half equirectangular", "hequirect"),
}
# Views that are cut: their directions in degrees, and the field of view, which lets them overlap.
_YAWS = {"equirect": (0, 90, 180, -90), "c3x2": (0, 90, 180, -90), "hequirect": (-40, 40)}
_FIELD_OF_VIEW = 100
_MULTIPLE = 16
# No camera writes smaller ones.
_LEAST_WIDTH = 1920


def projection_of(side_data: Sequence[Any]) -> int | None:
    """FFmpeg's number of the projection that a decoded frame has; None where it is a plane's."""
    data = next((d for d in side_data if d.type.name == "SPHERICAL"), None)
    number = struct.unpack("=i", bytes(data)[:4])[0] if data is not None else None
    return number if number in _PROJECTIONS else None


def check_is_plane(path: Path, projection: int | None, width: int) -> None:
    """Refuse pictures of all directions, with the line that cuts views from them.

    Args:
        path: the video.
        projection: as `projection_of` gives it.
        width: of its pictures, in pixels; views get their resolution.

    Raises:
        VideoError: they are.
    """
    if projection is None:
        return
    name, of_filter = _PROJECTIONS[projection]
    raise VideoError(
        f"{path}: its pictures are {name}, of all directions, which is no camera's model: cut "
        f"views from it, and give each as --video: {_line(path, of_filter, width)}"
    )


def hint(path: Path, projection: int | None, size: tuple[int, int]) -> list[str]:
    """A warning where pictures are as large and wide as equirectangular ones that do not say so."""
    if projection is not None or size[0] != 2 * size[1] or size[0] < _LEAST_WIDTH:
        return []
    return [
        f"{path}: its pictures are twice as wide as high, as those of all directions are: if they "
        f"are equirectangular, cut views from it: {_line(path, 'equirect', size[0])}"
    ]


def _line(path: Path, of_filter: str, width: int) -> str:
    """A line for a shell that cuts views from a video."""
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

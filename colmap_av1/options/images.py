"""Options of the images: which frames of the video they are, and how they are named."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import ClassVar, Literal

from colmap_av1.errors import OptionError
from colmap_av1.options.fields import Options, option

# Formats that images are written in.
IMAGE_EXTENSIONS = (".png", ".jpg", ".jpeg")
_NUMBER_FIELD = re.compile(r"%0?\d*d")
_LONGEST_NUMBER = 20  # digits
_LONGEST_NAME = 255  # bytes, on all usual file systems


@dataclass(frozen=True)
class ImageOptions(Options):
    """Which frames of the video are images: all, unless one of the options chooses."""

    title: ClassVar[str] = "images"

    image_name: str = option(
        "frame_%06d",
        "file name of new images; the number is the frame's display index, from 0; .png or .jpg "
        "at its end is their format, which is PNG without one, JPEG in reconstruct",
    )
    num_images: int | None = option(
        None, "number of images, spread over the video", least=2, common=True
    )
    every: int | None = option(None, "every n-th frame becomes an image", least=1, common=True)
    fps: float | None = option(
        None,
        "images per second, by the time stamps of the frames",
        above=0,
        unit="images per second",
        common=True,
    )
    frame_list: str | os.PathLike[str] | None = option(
        None,
        "text file with a line for each image: the frame's index and, if wanted, the image's name",
        common=True,
    )
    select: Literal["time", "parallax"] = option(
        "time",
        "time: num_images at equal intervals of time; parallax: at equal steps of parallax along "
        "the tracks",
    )
    skip_blurred: bool = option(
        True,
        "replace a blurred image by a sharp frame nearby that overlaps as well; only where "
        "num_images or fps choose and images are written",
    )
    first_number: int | None = option(
        None,
        "number of the video's first frame in the names of existing images; None: only names that "
        "determine the frame are accepted",
    )

    @property
    def file_name(self) -> str:
        """`image_name` with its extension."""
        return self.image_name if "." in self.image_name else f"{self.image_name}.png"

    @property
    def ways(self) -> list[str]:
        """The options that say which frames are images, of those that are given."""
        names = ("num_images", "every", "fps", "frame_list")
        return [name for name in names if getattr(self, name) is not None]

    def __post_init__(self) -> None:
        super().__post_init__()
        given = self.ways
        if len(given) > 1:
            raise OptionError(
                f"{given[0]} and {given[1]} both say which frames are images: give one"
            )
        if self.select == "parallax" and self.num_images is None:
            raise OptionError("select 'parallax' spreads a number of images: give num_images, too")
        check_image_pattern(self.file_name)


@dataclass(frozen=True)
class MaskOptions(Options):
    """Which pixels count; black ones of masks are left out."""

    title: ClassVar[str] = "masks"
    colmap_prefix: ClassVar[str] = "ImageReader"

    mask_path: str | os.PathLike[str] | None = option(
        None,
        "masks, whose black pixels are ignored: a PNG for all frames, or a folder with one for "
        "every frame, or with NAME.png for every image, as COLMAP has them",
        common=True,
    )


def check_image_pattern(pattern: str) -> str:
    """Refuse a pattern that cannot name images; 'frame_%06d.png' can.

    Returns:
        The pattern's number field.

    Raises:
        OptionError: it has no number field, or several, names a folder, or no format of images.
    """
    fields = _NUMBER_FIELD.findall(pattern)
    if len(fields) != 1 or pattern.count("%") != 1:
        raise OptionError(
            f"image_name '{pattern}' needs exactly one number field, such as frame_%06d.png"
        )
    # Judged before it is used: a field of many digits makes a name that fills memory.
    too_long = int(fields[0].strip("%d") or 0) > _LONGEST_NUMBER if len(fields[0]) < 9 else True
    if too_long or len(os.fsencode(pattern)) + _LONGEST_NUMBER > _LONGEST_NAME or "\0" in pattern:
        raise OptionError(
            f"image_name {pattern[:40]!r} gives names that files cannot have: give one such as "
            "frame_%06d.png"
        )
    if pattern.encode(errors="replace").decode() != pattern:
        raise OptionError(
            f"image_name {pattern!r} is not UTF-8, as names in a database are: give another"
        )
    if Path(pattern).name != pattern or pattern.startswith("."):
        raise OptionError(
            f"image_name '{pattern}' has a folder or a leading dot: give a plain file name"
        )
    check_extension(pattern)
    return str(fields[0])


def check_extension(name: str) -> None:
    """Refuse a name without the extension of an image format.

    Raises:
        OptionError: so it does.
    """
    if PurePosixPath(name).suffix.lower() not in IMAGE_EXTENSIONS:
        raise OptionError(f"image name '{name}': give one that ends in .png, .jpg or .jpeg")

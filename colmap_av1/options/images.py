"""Options of the images: which frames become images, and how they are named."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import ClassVar, Literal

from colmap_av1.errors import OptionError
from colmap_av1.options.fields import Options, option

# Formats in which images are written.
IMAGE_EXTENSIONS = (".png", ".jpg", ".jpeg")
_NUMBER_FIELD = re.compile(r"%0?\d*d")
_LONGEST_NUMBER = 20  # digits
# Longest name of an output in bytes. File systems allow 255, but an output is first written under a
# hidden name that has 33 more.
LONGEST_NAME = 222


@dataclass(frozen=True)
class ImageOptions(Options):
    """Which frames of the video become images: all, unless an option chooses among them.

    Examples:
        >>> from colmap_av1 import ImageOptions, MatchOptions
        >>> options = MatchOptions(images=ImageOptions(fps=2.0))
        >>> options.images.fps
        2.0
    """

    title: ClassVar[str] = "images"

    image_name: str = option(
        "frame_%06d",
        "file name of new images; the number is that of the frame, from 0; the extension "
        ".png or .jpg chooses the format (default PNG, JPEG in reconstruct)",
    )
    num_images: int | None = option(
        None, "number of images, spread evenly over the video", least=2, common=True
    )
    every: int | None = option(None, "every n-th frame becomes an image", least=1, common=True)
    fps: float | None = option(
        None,
        "images per second, measured by the time stamps of the frames",
        above=0,
        unit="images per second",
        common=True,
    )
    frame_list: str | os.PathLike[str] | None = option(
        None,
        "text file with one line per image: the frame's index and optionally the image's name",
        common=True,
    )
    select: Literal["time", "parallax"] = option(
        "time",
        "time: space num_images evenly in time; parallax: space them evenly in parallax, measured "
        "on the tracks",
    )
    skip_blurred: bool = option(
        True,
        "replace a blurred image by a nearby sharp frame; applies only if num_images or fps "
        "chooses the frames and images are written",
    )
    first_number: int | None = option(
        None,
        "number of the video's first frame in the names of existing images; None: accept only "
        "names that determine the frame",
    )

    @property
    def file_name(self) -> str:
        """`image_name` with its extension."""
        return self.image_name if "." in self.image_name else f"{self.image_name}.png"

    @property
    def ways(self) -> list[str]:
        """Names of the given options that choose the frames."""
        names = ("num_images", "every", "fps", "frame_list")
        return [name for name in names if getattr(self, name) is not None]

    @property
    def is_spread(self) -> bool:
        """Whether `num_images` or `fps` spreads the images over the video."""
        return self.num_images is not None or self.fps is not None

    def __post_init__(self) -> None:
        super().__post_init__()
        given = self.ways
        if len(given) > 1:
            raise OptionError(
                f"{given[0]} and {given[1]} both choose which frames become images: give one"
            )
        if self.select == "parallax" and self.num_images is None:
            raise OptionError("select 'parallax' needs the number of images: give num_images, too")
        check_image_pattern(self.file_name)


@dataclass(frozen=True)
class MaskOptions(Options):
    """Masks of the pixels to ignore.

    Examples:
        >>> from colmap_av1 import MaskOptions, MatchOptions
        >>> options = MatchOptions(masks=MaskOptions("my_masks"))
        >>> options.masks.mask_path
        'my_masks'
    """

    title: ClassVar[str] = "masks"

    mask_path: str | os.PathLike[str] | None = option(
        None,
        "masks, whose black pixels are ignored: one PNG for all frames, or a folder with one for "
        "each frame, or with NAME.png for each image as in COLMAP",
        common=True,
        colmap="ImageReader.mask_path",
    )


def check_image_pattern(pattern: str) -> str:
    """Check a pattern for image names, such as 'frame_%06d.png'.

    Returns:
        The pattern's number field.

    Raises:
        OptionError: the pattern does not have exactly one number field, names a folder, lacks the
            extension of an image format, or gives invalid file names.
    """
    fields = _NUMBER_FIELD.findall(pattern)
    if len(fields) != 1 or pattern.count("%") != 1:
        raise OptionError(
            f"image_name '{pattern}' does not have exactly one number field: give one such as "
            "frame_%06d.png"
        )
    # Checked before the pattern is used, because formatting a huge field width fills the memory.
    too_long = int(fields[0].strip("%d") or 0) > _LONGEST_NUMBER if len(fields[0]) < 9 else True
    if too_long or len(os.fsencode(pattern)) + _LONGEST_NUMBER > LONGEST_NAME or "\0" in pattern:
        raise OptionError(
            f"image_name {pattern[:40]!r} gives invalid file names: give one such as frame_%06d.png"
        )
    if pattern.encode(errors="replace").decode() != pattern:
        raise OptionError(
            f"image_name {pattern!r} is not UTF-8, which databases need: give another name"
        )
    if Path(pattern).name != pattern or pattern.startswith("."):
        raise OptionError(
            f"image_name '{pattern}' has a folder or a leading dot: give a plain file name"
        )
    check_extension(pattern)
    return str(fields[0])


def check_extension(name: str) -> None:
    """Check that a name has the extension of an image format.

    Raises:
        OptionError: it has not.
    """
    if PurePosixPath(name).suffix.lower() not in IMAGE_EXTENSIONS:
        raise OptionError(
            f"image name '{name}' is not that of a PNG or JPEG file: give one that ends in .png, "
            ".jpg or .jpeg"
        )

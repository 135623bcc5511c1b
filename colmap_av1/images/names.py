"""Names of images: patterns for new images, and numbers and order of existing ones."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from colmap_av1.errors import ImageError
from colmap_av1.options.images import (
    LONGEST_NAME,
    ImageOptions,
    check_extension,
    check_image_pattern,
)
from colmap_av1.util.texts import check_name

_MOST_DIGITS = 255


def image_names(pattern: str, frames: Sequence[int]) -> list[str]:
    """Name the images of frames by a printf pattern such as 'frame_%06d.png'.

    Args:
        pattern: file name with one integer field, which takes the frame number, from 0.
        frames: frame numbers.

    Raises:
        OptionError: the pattern has no integer field, or not the extension of an image.
    """
    check_image_pattern(pattern)
    return [pattern % frame for frame in frames]


def names_of_all(options: ImageOptions, num_frames: int) -> list[str] | None:
    """Names of new images if every frame becomes an image; None if the options choose frames."""
    return None if options.ways else image_names(options.file_name, range(num_frames))


def frames_of_images(
    names: Sequence[str], num_frames: int, first_number: int | None = None
) -> NDArray[np.int32]:
    """Find the video frame of each image of a database that already lists images.

    If there are as many images as frames, they are the frames in natural order of the names.
    Otherwise the last number in a name is that of the frame, counted from `first_number`. If that
    is None, it is inferred when the names are unambiguous: gaps show that the numbers count frames
    of the video, and a 0 or the number of the last frame shows where they start. Image sequences
    extracted at a lower rate are numbered without gaps and therefore ambiguous.

    Args:
        names: names of the images, in any order.
        num_frames: number of shown frames of the video.
        first_number: number in the name of the video's first frame, usually 0 or 1; None: inferred.

    Returns:
        int32 [len(names)] frame number of each image.

    Raises:
        ImageError: count and names do not determine the frames.
    """
    numbers = [last_number(name) for name in names]
    if first_number is None and len(names) == num_frames:
        order = natural_order(names)
        frames = np.empty(len(names), dtype=np.int32)
        frames[order] = np.arange(len(names), dtype=np.int32)
        return frames

    counts = f"there are {len(names)} images, the video has {num_frames} frames"
    found = [number for number in numbers if number is not None]
    if len(found) < len(numbers):
        unnumbered = names[numbers.index(None)]
        raise ImageError(
            f"{counts}, and '{unnumbered}' has no frame number: list the images in a "
            "--frame_list, or give their folder as --image_path to identify them by content"
        )
    lowest, highest = min(found), max(found)
    if first_number is None:
        first_number = _guess_first_number(found, num_frames, counts)
    if lowest < first_number or highest - first_number >= num_frames:
        raise ImageError(
            f"{counts}, but the image numbers run from {lowest} to {highest} where frames are "
            f"numbered {first_number} to {first_number + num_frames - 1}: give the video that the "
            "images were extracted from"
        )
    if len(set(found)) < len(found):
        twice = next(number for number in found if found.count(number) > 1)
        first, second, *_ = (n for n, own in zip(names, found, strict=True) if own == twice)
        raise ImageError(
            f"'{first}' and '{second}' have the same frame number {twice}: list the images in a "
            "--frame_list, or give the videos of all folders in one run"
        )
    return np.array([number - first_number for number in found], dtype=np.int32)


def _guess_first_number(numbers: Sequence[int], num_frames: int, counts: str) -> int:
    lowest, highest = min(numbers), max(numbers)
    with_gaps = highest - lowest + 1 > len(numbers)
    if with_gaps and lowest == 0 and highest < num_frames:
        return 0
    if with_gaps and highest == num_frames and lowest > 0:
        return 1
    raise ImageError(
        f"{counts}, and the image numbers {lowest} to {highest} do not determine the frames: give "
        "the number of the video's first frame as --first_number, list the images in a "
        "--frame_list, or give their folder as --image_path to identify them by content"
    )


def plain_name(name: str) -> str:
    """Replace characters other than letters, digits, '-' and '_', which confuse some programs."""
    return re.sub(r"[^\w-]+", "_", name)


def natural_order(names: Sequence[str]) -> list[int]:
    """Indices that sort names so that 'f9' comes before 'f10'."""
    return sorted(range(len(names)), key=lambda i: natural_key(names[i]))


def videos_of(
    camera_ids: Sequence[int], names: Sequence[str]
) -> list[tuple[PurePosixPath, int | None]]:
    """The video of each image, as a key: its folder, and its camera if other images share it.

    In the natural order of their names, neighbours that have the same key are neighbours in time.
    """
    num_images = Counter(camera_ids)
    return [
        (PurePosixPath(name).parent, camera_id if num_images[camera_id] > 1 else None)
        for camera_id, name in zip(camera_ids, names, strict=True)
    ]


def last_number(name: str) -> int | None:
    """The last number in an image's name without its extension; None if there is none."""
    digits = re.findall(r"\d+", PurePosixPath(name).stem)
    return _value(digits[-1]) if digits else None


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Sort key by which 'f9' comes before 'f10'; the text itself breaks ties."""
    parts = re.split(r"(\d+)", name)
    # Every second part is digits.
    key = [(1, _value(p), p) if i % 2 else (0, 0, p) for i, p in enumerate(parts)]
    return [*key, (0, 0, name)]


def _value(digits: str) -> int:
    """The value of digits. Python limits their number, to more than a file name can have."""
    return int(digits[:_MOST_DIGITS])


def pattern_regex(pattern: str) -> re.Pattern[str]:
    """A regular expression that matches the names that a pattern creates."""
    before, after = pattern.split(check_image_pattern(pattern))
    return re.compile(re.escape(before) + r"\d+" + re.escape(after))


def check_new_name(name: str) -> None:
    """Check that an image can be written under a name.

    Raises:
        OptionError: the extension is not that of a format that can be written.
        ImageError: the name leaves the image folder, or is too long.
    """
    check_extension(name)
    if len(os.fsencode(image_file(Path(), name).name)) > LONGEST_NAME:
        raise ImageError(f"image {name!r} has a name that is too long: give another name")


def image_file(root: Path, name: str) -> Path:
    """The file of an image in a folder.

    Raises:
        ImageError: the name leaves the folder, or is not a valid file name.
    """
    check_name(name)
    return root / name

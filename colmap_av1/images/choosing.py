"""Choose the frames of a video that become images: by count, rate, list, time or parallax."""

from __future__ import annotations

import os
import re
import warnings
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_av1.errors import ImageError, OptionError
from colmap_av1.images.blur import sharpness_of, skip_blurred
from colmap_av1.images.files import READABLE, UNREADABLE, image_size
from colmap_av1.images.names import (
    check_new_name,
    frames_of_images,
    image_file,
    image_names,
    last_number,
    natural_key,
    natural_order,
    pattern_regex,
)
from colmap_av1.images.parallax import parallax
from colmap_av1.images.recognising import check_content, frames_by_content, frames_near
from colmap_av1.options import ImageOptions
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.arrays import Floats, Ints, Picture
from colmap_av1.util.spread import evenly_spread
from colmap_av1.util.texts import read_lines, some_names

# Yields (frame number, picture) of some frames, given by their numbers, in order; None: all. Frames
# are numbered as players show them, from 0.
_Decode = Callable[[Collection[int] | None], Iterable[tuple[int, Picture]]]

# Number of existing images whose content is checked.
_NUM_CHECKED = 8
# Added to times in ticks, which are rational numbers. At half the frame rate of a video, every
# other time lies halfway between two ticks.
_ROUNDING = 1e-6
# A line of a list of frames that begins with an index.
_INDEXED = re.compile(r"(\d+)(?:[\s,]+(.*))?")


@dataclass(frozen=True)
class ChosenImages:
    """The frames that are images.

    Attributes:
        names: name of each image, its path relative to the image folder.
        frames: int32 [n] frame number of each image, strictly ascending.
    """

    names: list[str]
    frames: NDArray[np.int32]

    @property
    def frame_of(self) -> dict[str, int]:
        """The frame number of each image, by name."""
        return dict(zip(self.names, self.frames.tolist(), strict=True))

    def some(self, index: Sequence[int] | NDArray[np.integer[Any]]) -> ChosenImages:
        """Select images by their indices, which must ascend."""
        return ChosenImages([self.names[i] for i in index], self.frames[np.asarray(index, int)])


def existing_images(
    folder: str | os.PathLike[str], options: ImageOptions, size: tuple[int, int]
) -> list[str]:
    """Images in a folder, unless an earlier run of this package wrote them.

    An earlier run wrote them

    - if frame 0 exists under the name that new images get: other programs count from 1;
    - if the options choose frames by time, and all names are those of new images, but not numbered
      from 1 without gaps;
    - if `frame_list` lists all of them and more, and they have the size of new images.

    Args:
        folder: the folder; it need not exist.
        options: how images are chosen and named.
        size: (width, height) of new images.

    Returns:
        File names in natural order; none if an earlier run wrote them.

    Raises:
        ImageError: the list of frames or an image cannot be read.
    """
    root = Path(folder)
    if not root.is_dir():
        return []
    found = [p for p in root.iterdir() if not p.name.startswith(".")]
    unread = sorted(p.name for p in found if p.suffix.lower() in UNREADABLE)
    if unread:
        warnings.warn(
            f"{root}: ignored {len(unread)} images: convert these to JPEG or PNG: "
            f"{some_names(unread)}",
            stacklevel=2,
        )
    names = sorted((p.name for p in found if p.suffix.lower() in READABLE), key=natural_key)
    if not names:
        _warn_of_subfolders(root)
    is_own = image_names(options.file_name, [0])[0] in names
    if options.is_spread:
        regex = pattern_regex(options.file_name)
        are_new = all(regex.fullmatch(name) for name in names)
        is_own |= are_new and names != image_names(options.file_name, range(1, len(names) + 1))
    if options.frame_list is not None and names:
        listed = {name for *_, name in _read_entries(options.frame_list, options)}
        is_own |= {*names} < listed and image_size(root / names[0]) == size
    return [] if is_own else names


def _warn_of_subfolders(root: Path) -> None:
    """Warn if the images of a folder are in its subfolders, where those of one video are not."""
    deeper = (p.relative_to(root) for p in root.glob("*/*") if p.suffix.lower() in READABLE)
    first = next((p for p in sorted(deeper) if not str(p).startswith(".")), None)
    if first is not None:
        warnings.warn(
            f"{root}: ignored images in subfolders, such as {first}: give '{root / first.parent}' "
            "to use them",
            stacklevel=3,
        )


def choose_images(
    num_frames: int,
    options: ImageOptions,
    *,
    existing: Sequence[str],
    folder: Path | None,
    times: Callable[[], Floats | None],
    decode: _Decode,
    tracks: Tracks | None = None,
    of_model: bool = False,
) -> ChosenImages:
    """Choose the frames that become images: the frames of existing images, else by the options.

    The frames of existing images are determined by `frame_list`; by `every`, in the order of their
    names from frame 0, or with `first_number` by the numbers in their names; by `num_images` or
    `fps`, if these choose exactly the existing images; or by count and names, see
    `frames_of_images`. If these are ambiguous or wrong, and the files exist, the frames are found
    by content.

    Args:
        num_frames: number of frames of the video.
        options: how to choose.
        existing: names of existing images, in any order.
        folder: folder of the images; None: no picture is decoded.
        times: returns the times of the frames in seconds; None if unknown.
        decode: yields (frame number, picture) of some frames, given by their numbers, or with
            None of all frames.
        tracks: tracks through all frames if new images are spread in parallax; else None.
        of_model: the existing images are those of a model, so the options may choose more.

    Raises:
        ImageError: the frames of the existing images cannot be determined, or fewer than two are
            chosen.
        OptionError: `num_images` or `fps` chooses other images than those that exist, or `fps`
            needs times.
    """
    if existing and not options.is_spread:
        chosen = _find_existing(num_frames, options, existing, folder, decode, of_model=of_model)
    elif options.frame_list is not None:
        chosen = read_frame_list(options.frame_list, num_frames, options)
        for name in chosen.names:
            check_new_name(name)
    else:
        if tracks is not None and options.num_images is not None:
            frames = spread_in_parallax(tracks, options.num_images)
        else:
            at = times() if options.is_spread else None
            frames = choose_frames(num_frames, options, at)
        if folder is not None and options.skip_blurred and options.is_spread:
            frames = skip_blurred(frames, lambda asked: sharpness_of(decode(set(asked))))
        chosen = ChosenImages(image_names(options.file_name, frames.tolist()), frames)
        if existing:
            if of_model:
                chosen = _keep_images_of_model(chosen, existing)
            if {*existing} != {*chosen.names}:
                way = "num_images" if options.fps is None else "fps"
                other = "" if of_model else ", or give a new database and folder"
                raise OptionError(
                    f"{way} chooses other images than the {len(existing)} that exist: leave it out"
                    f"{other}"
                )
            _check_some(chosen, folder, decode)
    if len(chosen.frames) < 2:
        remedy = "add images of other frames" if existing else "choose more frames"
        if num_frames < 2:
            remedy = "give a longer video"
        raise ImageError(
            f"{len(chosen.frames)} of {num_frames} frames {'are' if existing else 'become'} "
            f"images: matches need two or more: {remedy}"
        )
    return chosen


def choose_frames(
    num_frames: int,
    options: ImageOptions,
    times: Floats | None = None,
) -> NDArray[np.int32]:
    """Choose the frames that become images: all, unless the options say otherwise.

    Args:
        num_frames: number of frames of the video.
        options: how to choose; not by `frame_list` or in parallax.
        times: float64 [num_frames] time of each frame in seconds, ascending; None: frames are
            equally spaced.

    Returns:
        int32 frame numbers, strictly ascending.

    Raises:
        OptionError: `fps` needs times.
    """
    if options.every is not None:
        return np.arange(0, num_frames, options.every, dtype=np.int32)
    if options.fps is not None:
        if times is None:
            raise OptionError("the video has no time stamps: give every instead of fps")
        return _at_rate(times - times[0], options.fps)
    if options.num_images is None:
        return np.arange(num_frames, dtype=np.int32)
    position = times if times is not None else np.arange(num_frames, dtype=np.float64)
    return _spread_by_position(position, options.num_images)


def spread_in_parallax(tracks: Tracks, num_images: int) -> NDArray[np.int32]:
    """Choose frames that are spread evenly in `parallax`.

    Args:
        tracks: tracks through all frames.
        num_images: number of frames to choose.

    Returns:
        int32 frame numbers, strictly ascending.
    """
    return _spread_by_position(np.concatenate([[0.0], np.cumsum(parallax(tracks))]), num_images)


def read_frame_list(
    path: str | os.PathLike[str], num_frames: int, options: ImageOptions
) -> ChosenImages:
    """Read which frames become images, and their names, from a text file.

    A line holds the index of a frame, from 0, optionally followed by a space or comma and the name
    of the image; or only a name, whose last number is that of the frame, counted from
    `first_number` (0 if None). Empty lines and lines that start with '#' are ignored.

    Raises:
        ImageError: the file is missing, or lists a frame that the video does not have, or a frame
            or a name twice.
    """
    entries = _read_entries(path, options)
    for number, frame, _ in entries:
        if not 0 <= frame < num_frames:
            raise ImageError(
                f"{path}, line {number}: there is no frame {frame}: the video has frames 0 to "
                f"{num_frames - 1}, give one of them"
            )
    entries.sort(key=lambda entry: entry[1])
    frames = np.array([frame for _, frame, _ in entries], dtype=np.int32)
    return ChosenImages([name for _, _, name in entries], frames)


def check_frame_list(options: ImageOptions) -> None:
    """Check the format of a list of frames before the number of frames is known.

    Raises:
        ImageError: see `read_frame_list`.
    """
    if options.frame_list is not None:
        _read_entries(options.frame_list, options)


def _read_entries(
    path: str | os.PathLike[str], options: ImageOptions
) -> list[tuple[int, int, str]]:
    """Line number, frame and image name of each entry of a list of frames."""
    try:
        lines = read_lines(path)
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not text"
        raise ImageError(
            f"{path}: cannot be read as a list of frames: {reason}: give a text file with a "
            "frame's index on each line"
        ) from error
    entries: list[tuple[int, int, str]] = []
    for number, line in enumerate(map(str.strip, lines), start=1):
        if not line or line.startswith("#"):
            continue
        indexed = _INDEXED.fullmatch(line)
        if indexed is not None:
            frame = last_number(indexed[1]) or 0
            name = indexed[2] or options.file_name % frame
        else:
            name = line
            found = last_number(name)
            if found is None:
                raise ImageError(
                    f"{path}, line {number}: '{name}' is neither the index of a frame nor the name "
                    "of an image with a number"
                )
            frame = found - (options.first_number or 0)
        extension = PurePosixPath(name).suffix[1:]
        if not extension.isalnum() or extension.isdecimal():
            raise ImageError(
                f"{path}, line {number}: '{name}' is not the name of an image: give one index and "
                "optionally one file name per line"
            )
        entries.append((number, frame, name))
    if not entries:
        raise ImageError(f"{path}: lists no frame: give a frame's index on each line")
    for what, values in (
        ("frame", [str(f) for _, f, _ in entries]),
        ("name", [n for _, _, n in entries]),
    ):
        twice = next((v for v, count in Counter(values).items() if count > 1), None)
        if twice is not None:
            raise ImageError(f"{path}: lists {what} {twice} twice: remove one line")
    return entries


def _find_existing(
    num_frames: int,
    options: ImageOptions,
    names: Sequence[str],
    folder: Path | None,
    decode: _Decode,
    *,
    of_model: bool,
) -> ChosenImages:
    """Find the frames of existing images."""
    by_name = [names[i] for i in natural_order(names)]
    if options.frame_list is not None:
        chosen = read_frame_list(options.frame_list, num_frames, options)
        if of_model:
            chosen = _keep_images_of_model(chosen, names)
        odd = sorted(set(names) ^ set(chosen.names))
        if odd:
            lists = "lists" if odd[0] in chosen.names else "does not list"
            exists = "does not exist" if odd[0] in chosen.names else "exists"
            raise ImageError(
                f"{options.frame_list} {lists} '{odd[0]}', which {exists}: list exactly the images "
                "that exist"
            )
    elif options.every is not None:
        chosen = _in_order(by_name, _at_steps(by_name, num_frames, options))
    else:
        try:
            frames = frames_of_images(by_name, num_frames, options.first_number)
        except ImageError as error:
            files = [image_file(folder, name) for name in by_name] if folder is not None else []
            missing = [n for n, file in zip(by_name, files, strict=False) if not file.exists()]
            if options.first_number is not None or len(missing) == len(files):
                raise
            if missing:
                raise ImageError(
                    f"{error}; {folder} lacks {len(missing)} of the {len(names)} images, such as "
                    f"'{missing[0]}', and content identifies them only if all are there"
                ) from error
            return _by_content(by_name, files, decode)
        chosen = _in_order(by_name, frames)
    _check_some(chosen, folder, decode)
    return chosen


def _check_some(chosen: ChosenImages, folder: Path | None, decode: _Decode) -> None:
    """Check the content of some images that are in a folder, including the first and the last."""
    if folder is None:
        return
    files = [image_file(folder, name) for name in chosen.names]
    there = [k for k, file in enumerate(files) if file.exists()]
    some = [there[k] for k in evenly_spread(len(there), _NUM_CHECKED)]
    if some:
        frames = chosen.frames[some].tolist()
        check_content([files[k] for k in some], frames, decode(frames_near(frames)))


def _keep_images_of_model(chosen: ChosenImages, names: Sequence[str]) -> ChosenImages:
    """Keep the images of a model, given by their names; it may lack some of the chosen ones."""
    return chosen.some(np.flatnonzero(np.isin(chosen.names, names)))


def _by_content(
    names: Sequence[str],
    files: Sequence[Path],
    decode: _Decode,
) -> ChosenImages:
    """Find the frames of images by content, without images that repeat the previous one."""
    kept, frames = frames_by_content(files, decode(None))
    repeated = sorted(set(range(len(files))) - set(kept))
    if repeated:
        warnings.warn(
            f"{files[0].parent}: ignored {len(repeated)} images that repeat the previous one, the "
            f"first is '{names[repeated[0]]}'",
            stacklevel=2,
        )
    return _in_order([names[k] for k in kept], frames)


def _in_order(names: Sequence[str], frames: NDArray[np.int32]) -> ChosenImages:
    order = np.argsort(frames, kind="stable")
    return ChosenImages([names[i] for i in order], frames[order])


def _at_steps(names: Sequence[str], num_frames: int, options: ImageOptions) -> NDArray[np.int32]:
    """The frames of existing images if every `every`-th frame is an image."""
    step = options.every or 1
    numbers = list(range(len(names)))
    found = [last_number(name) for name in names]
    if options.first_number is not None:
        if None in found:
            raise ImageError(f"'{names[found.index(None)]}' has no number: leave out first_number")
        numbers = [(n or 0) - options.first_number for n in found]
    elif None not in found:
        # Where a model does not register an image, the others keep their numbers.
        steps = np.diff([n or 0 for n in found])
        if len(steps) and steps.min() == 1 < steps.max():
            raise ImageError(
                f"no image has a number between '{names[int(steps.argmax())]}' and the next: give "
                "first_number, the number of the video's first frame"
            )
    for name, number in zip(names, numbers, strict=True):
        if not 0 <= number * step < num_frames:
            raise ImageError(
                f"'{name}' would be frame {number * step} of the video, which has frames 0 to "
                f"{num_frames - 1}: give another every or first_number"
            )
    if len(set(numbers)) < len(numbers):
        twice = next(k for k, n in enumerate(numbers) if n in numbers[:k])
        raise ImageError(
            f"'{names[numbers.index(numbers[twice])]}' and '{names[twice]}' have the same number: "
            "list their frames in a --frame_list"
        )
    return np.array(numbers, dtype=np.int32) * step


def _at_rate(times: Floats, fps: float) -> NDArray[np.int32]:
    """The frames that FFmpeg's fps filter selects: for each tick, the last that rounds to it."""
    half = 0.5 + _ROUNDING
    tick = np.floor(times * fps + half)
    interval = np.median(np.diff(times)) if len(times) > 1 else 0.0
    num_ticks = max(1.0, np.floor((times[-1] + interval) * fps + half))
    is_last = np.append(tick[1:] > tick[:-1], True)
    return np.flatnonzero(is_last & (tick < num_ticks)).astype(np.int32)


def _spread_by_position(positions: Floats, num_images: int) -> NDArray[np.int32]:
    """Choose frames evenly by the positions of all frames, which ascend."""
    count = len(positions)
    if num_images > count:
        warnings.warn(
            f"the video has {count} frames, {num_images} images are wanted: all of its frames "
            "become images",
            stacklevel=2,
        )
        return np.arange(count, dtype=np.int32)
    wanted = np.linspace(positions[0], positions[-1], num_images)
    return _distinct(nearest(positions, wanted), count)


def nearest(positions: NDArray[np.floating] | Ints, wanted: NDArray[np.floating] | Ints) -> Ints:
    """Index of the position nearest to each wanted one, the earlier of two; positions ascend."""
    above = np.clip(np.searchsorted(positions, wanted), 1, max(len(positions) - 1, 1))
    if len(positions) == 1:
        return np.zeros(len(wanted), dtype=np.int64)
    nearer_below = wanted - positions[above - 1] <= positions[above] - wanted
    return np.asarray(np.where(nearer_below, above - 1, above), dtype=np.int64)


def _distinct(frames: Ints, count: int) -> NDArray[np.int32]:
    """Move ascending frames so that they are distinct and below `count`."""
    index = np.arange(len(frames))
    pushed_up = np.maximum.accumulate(frames - index) + index
    most = count - len(frames) + index
    return np.asarray(np.minimum(pushed_up, most), dtype=np.int32)

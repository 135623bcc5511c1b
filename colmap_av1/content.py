"""Which frame of a video an image shows, found by looking at it at low resolution."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_av1.errors import ImageError

_Image = NDArray[np.uint8]

# Side of the squares that pictures are compared at: small enough that neither scaling nor
# JPEG shows, large enough that the motion between frames does.
_THUMBNAIL = 48
# Least normalised correlation of an image with its frame.
_LEAST_LIKENESS = 0.98
# A frame further away must be this many times less like the image than its own.
_MARGIN = 1.5
# Unlikeness below which pictures cannot be told apart.
_NOISE = 2e-5


def frames_by_content(
    files: Sequence[Path],
    pictures: Iterable[tuple[int, _Image]],
    progress: Callable[[int], None] | None = None,
) -> NDArray[np.int32]:
    """Find the frames that image files show; files are in the order of the frames.

    Of all assignments in which frames ascend, the one with the greatest likeness in sum is
    taken. It must leave no doubt: each image is like its frame, and less like any that is not
    a neighbour of it.

    Args:
        files: image files of any size with the video's aspect.
        pictures: (display index, uint8 [h, w, 3] BGR) of all frames, in order.
        progress: called with the number of frames looked at.

    Returns:
        int32 [len(files)] display indices, strictly ascending.

    Raises:
        ImageError: there are more images than frames, an image cannot be read, shows no frame of
            the video, or shows several as well.
    """
    images = np.array([_thumbnail(_read(path)) for path in files])
    likeness_of = []
    for index, picture in pictures:
        likeness_of.append(images @ _thumbnail(picture))
        if progress is not None:
            progress(index + 1)
    likeness = np.array(likeness_of).T  # [images, frames]
    if likeness.shape[0] > likeness.shape[1]:
        raise ImageError(
            f"there are {likeness.shape[0]} images, but the video has {likeness.shape[1]} frames: "
            "give the video the images were cut from"
        )
    frames = _ascending_assignment(likeness)
    for k, (path, frame) in enumerate(zip(files, frames, strict=True)):
        _check(path, int(frame), likeness[k])
    return frames


def _check(path: Path, frame: int, likeness: NDArray[np.float32]) -> None:
    if likeness[frame] < _LEAST_LIKENESS:
        raise ImageError(
            f"{path}: shows no frame of the video that fits its place (the best is frame {frame}, "
            f"alike by {likeness[frame]:.1%}): give the images that were cut from this video, "
            "unedited, or name their frames with --frame_list"
        )
    far = np.abs(np.arange(len(likeness)) - frame) > 1
    if far.any():
        unlike, next_best = 1 - likeness[frame], 1 - likeness[far].max()
        if next_best < _MARGIN * unlike + _NOISE:
            rival = int(np.flatnonzero(far)[np.argmax(likeness[far])])
            raise ImageError(
                f"{path}: looks like frame {frame} and like frame {rival}: name the images' frames "
                "with --frame_list"
            )


def _ascending_assignment(likeness: NDArray[np.float32]) -> NDArray[np.int32]:
    """Strictly ascending columns, one for each row, with the greatest sum."""
    num_images, num_frames = likeness.shape
    total = likeness[0].astype(np.float64)
    best_before = np.empty((num_images, num_frames), dtype=np.int32)
    for k in range(1, num_images):
        # The best end of the first k rows in any column before each.
        running = np.maximum.accumulate(total)
        is_new = np.concatenate([[True], total[1:] > running[:-1]])
        where = np.maximum.accumulate(np.where(is_new, np.arange(num_frames), 0))
        best_before[k, 1:], best_before[k, 0] = where[:-1], 0
        total = likeness[k] + np.concatenate([[-np.inf], running[:-1]])
    frames = np.empty(num_images, dtype=np.int32)
    frames[-1] = np.argmax(total)
    for k in range(num_images - 1, 0, -1):
        frames[k - 1] = best_before[k, frames[k]]
    return frames


def _thumbnail(image: _Image) -> NDArray[np.float32]:
    """The picture's grey values at low resolution, of mean 0 and length 1."""
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.float32)
    small = cv2.resize(grey, (_THUMBNAIL, _THUMBNAIL), interpolation=cv2.INTER_AREA).reshape(-1)
    small -= small.mean()
    return np.asarray(small / max(float(np.linalg.norm(small)), 1e-6), dtype=np.float32)


def _read(path: Path) -> _Image:
    image = cv2.imread(str(path), cv2.IMREAD_COLOR) if path.is_file() else None
    if image is None:
        raise ImageError(f"{path}: is missing or no image: give the folder of the images")
    return np.asarray(image, dtype=np.uint8)

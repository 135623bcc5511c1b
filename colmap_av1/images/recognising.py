"""Identify the frame of a video that an image shows, by comparing thumbnails."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_av1.errors import ImageError
from colmap_av1.images.files import read_image
from colmap_av1.util.arrays import Bools, Picture
from colmap_av1.video.display import Display, shown_picture, turned_back

# Width and height of thumbnails: small enough to hide scaling and JPEG compression, large enough to
# show the motion between frames.
_THUMBNAIL = 48
# Standard deviation of the grey values of a picture that counts as half flat. All flat pictures are
# similar, as at a fade from black.
_FLAT = 1.0
# Smallest normalised correlation of an image with its frame.
_MIN_CORRELATION = 0.98
# The dissimilarity (1 - correlation) of any other frame must exceed that of the image's own frame
# by this factor.
_MARGIN = 1.5
# Number of frames on either side of a frame that an image is compared with.
_REACH = 2
# Two pictures with less dissimilarity differ by a motion of less than half a pixel.
_SAME = 5e-5


def frames_by_content(
    files: Sequence[Path], pictures: Iterable[tuple[int, Picture]]
) -> tuple[list[int], NDArray[np.int32]]:
    """Find the frames that image files show.

    The frame of an image is the most similar one. If several are, because the camera stands still,
    the files are assumed to be in the order of the video. The result must be unambiguous: each
    image is similar to its frame, and clearly less similar to all other frames. If it is not,
    images that show the same frame as the one before are left out: FFmpeg repeats pictures if the
    video has a lower or a varying rate.

    Args:
        files: image files of any size with the video's aspect ratio.
        pictures: (frame number, uint8 [h, w, 3] BGR) of all frames, in order.

    Returns:
        Indices of the images that are not left out, ascending, and int32 [n] their frame numbers,
        all different.

    Raises:
        ImageError: there are more images than frames, or an image cannot be read, or shows no
            frame of the video, or is similar to several.
    """
    images = np.array([_thumbnail(read_image(path)) for path in files])
    frames = np.array([_thumbnail(picture) for _, picture in pictures])
    if len(frames) == 0:
        raise ImageError("no picture of the video can be decoded: give an undamaged copy")
    try:
        return list(range(len(files))), _assigned(files, images, frames)
    except ImageError:
        nearest = np.argmax(images @ frames.T, axis=1)
        kept = np.flatnonzero(np.append(True, nearest[1:] != nearest[:-1])).tolist()
        if not 2 <= len(kept) < len(files):
            raise
    return kept, _assigned([files[k] for k in kept], images[kept], frames)


def _assigned(
    files: Sequence[Path], images: NDArray[np.float32], frames: NDArray[np.float32]
) -> NDArray[np.int32]:
    """The frames of images by the thumbnails of both, see `frames_by_content`."""
    if len(images) > len(frames):
        raise ImageError(
            f"there are {len(images)} images, but the video has {len(frames)} frames: "
            "give the video that the images were extracted from"
        )
    similarity = images @ frames.T
    found = np.argmax(similarity, axis=1).astype(np.int32)
    if len(np.unique(found)) < len(found):
        found = _ascending_assignment(similarity)
    for k, path in enumerate(files):
        best = int(np.argmax(similarity[k]))
        if similarity[k, best] < _MIN_CORRELATION:
            raise ImageError(
                f"{path}: shows no frame of the video (the most similar is frame {best}, with "
                f"correlation {similarity[k, best]:.3f}): give unedited images of this video, or "
                "list their frames in a --frame_list"
            )
        if _is_clearly_less(similarity[k, found[k]], similarity[k, best]):
            twins = [files[int(i)].name for i in np.flatnonzero(similarity.argmax(axis=1) == best)]
            if len(twins) > 1:
                raise ImageError(
                    f"{' and '.join(twins)} show the same frame, {best}: keep one of them"
                )
            raise ImageError(
                f"{path}: shows frame {best} if it is of this video, but the names of the images "
                "are not in the order of their frames: give the video that all of them come from, "
                "rename them, or list their frames in a --frame_list"
            )
        _check_rivals(path, int(found[k]), similarity[k], frames)
    return np.asarray(found, dtype=np.int32)


def frames_near(frames: Iterable[int]) -> set[int]:
    """The frames that `check_content` compares images with; some may lie outside the video."""
    return {near for frame in frames for near in range(frame - _REACH, frame + _REACH + 1)}


def check_content(
    files: Sequence[Path], frames: Sequence[int], pictures: Iterable[tuple[int, Picture]]
) -> None:
    """Check that images show their frames rather than neighbouring ones.

    Args:
        files: image files.
        frames: the frame that each image should show, ascending.
        pictures: (frame number, picture) of `frames_near` or more frames, in order; not read
            beyond the last needed one.

    Raises:
        ImageError: an image shows something else.
    """
    images = np.array([_thumbnail(read_image(path)) for path in files])
    similarity = np.zeros((len(files), 2 * _REACH + 1))
    for index, picture in pictures:
        near = [k for k, frame in enumerate(frames) if abs(index - frame) <= _REACH]
        if near:
            thumbnail = _thumbnail(picture)
            for k in near:
                similarity[k, index - frames[k] + _REACH] = images[k] @ thumbnail
        if index >= frames[-1] + _REACH:
            break
    for path, frame, own in zip(files, frames, similarity, strict=True):
        best = int(np.argmax(own))
        if own[_REACH] >= _MIN_CORRELATION and not _is_clearly_less(own[_REACH], own[best]):
            continue
        shows = f"frame {frame + best - _REACH}" if own[best] >= _MIN_CORRELATION else "another"
        raise ImageError(
            f"{path}: should show frame {frame} of the video but shows {shows}: give unedited "
            "images of this video, or list their frames in a --frame_list"
        )


def is_turned_back(path: Path, pictures: Iterable[tuple[int, Picture]], display: Display) -> bool:
    """Whether an image shows pictures as stored, not as players rotate them.

    Args:
        path: the image file.
        pictures: (frame number, picture) of all frames as players show them.
        display: how players show them.

    Raises:
        ImageError: the image cannot be read.
    """
    image = _thumbnail(read_image(path))
    back = turned_back(display)
    best = np.zeros(2)
    for _, picture in pictures:
        both = (picture, shown_picture(picture, back))
        best = np.maximum(best, [float(image @ _thumbnail(p)) for p in both])
        if best.max() >= _MIN_CORRELATION:
            break
    return bool(best[1] > best[0])


def _check_rivals(
    path: Path, frame: int, similarity: NDArray[np.float32], frames: NDArray[np.float32]
) -> None:
    """Reject an image that fits another frame as well, unless the camera stands still."""
    rivals = ~_is_clearly_less(similarity, similarity[frame])
    # Frames without motion between them are interchangeable.
    differs = 1 - frames @ frames[frame] > _SAME
    still = np.ones(len(frames), dtype=np.bool_)
    still[: frame + 1] = ~np.maximum.accumulate(differs[frame::-1])[::-1]
    still[frame:] = ~np.maximum.accumulate(differs[frame:])
    rivals &= ~still & (similarity <= similarity[frame])
    if rivals.any():
        rival = int(np.argmax(np.where(rivals, similarity, -1)))
        raise ImageError(
            f"{path}: looks like frame {frame} and like frame {rival}: list the frames of the "
            "images in a --frame_list"
        )


def _is_clearly_less(similarity: Any, than: Any) -> Bools:
    """Whether one similarity is clearly less than another."""
    return np.asarray((1 - similarity) > _MARGIN * (1 - than) + _SAME / 2)


def _ascending_assignment(similarity: NDArray[np.float32]) -> NDArray[np.int32]:
    """Strictly ascending columns, one for each row, with the largest sum."""
    num_images, num_frames = similarity.shape
    total = similarity[0].astype(np.float64)
    best_before = np.empty((num_images, num_frames), dtype=np.int32)
    for k in range(1, num_images):
        # For each column, the largest sum of the first k rows that ends before it.
        running = np.maximum.accumulate(total)
        is_new = np.concatenate([[True], total[1:] > running[:-1]])
        where = np.maximum.accumulate(np.where(is_new, np.arange(num_frames), 0))
        best_before[k, 1:], best_before[k, 0] = where[:-1], 0
        total = similarity[k] + np.concatenate([[-np.inf], running[:-1]])
    frames = np.empty(num_images, dtype=np.int32)
    frames[-1] = np.argmax(total)
    for k in range(num_images - 1, 0, -1):
        frames[k - 1] = best_before[k, frames[k]]
    return frames


def _thumbnail(image: Picture) -> NDArray[np.float32]:
    """Grey values of a picture at low resolution, and a constant that makes flat pictures similar.

    The grey values have mean 0, and the vector has norm 1.
    """
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.float32)
    small = cv2.resize(grey, (_THUMBNAIL, _THUMBNAIL), interpolation=cv2.INTER_AREA).reshape(-1)
    values = np.append(small - small.mean(), np.float32(_FLAT * _THUMBNAIL))
    return np.asarray(values / np.linalg.norm(values), dtype=np.float32)

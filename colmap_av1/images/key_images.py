"""Key images: the images of a video that are mapped, as many as tracks need to connect them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from colmap_av1.images.choosing import nearest, spread_in_parallax
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.arrays import Bools, Ints

# Share of its cells with tracks that a key image has in common with the next one. Three consecutive
# key images then have half of them in common, which matters since a point needs three observations.
_KEPT = 0.7
# Smallest number of key images, if there are that many images, and largest distance in images
# between two of them.
_MIN_KEYS = 10
_MAX_APART = 6


def key_images(
    tracks: Tracks,
    frames: NDArray[np.int32],
    always: Bools,
    *,
    spacing: float,
    num_cells: int,
) -> Ints:
    """Choose key images as far apart as tracks allow.

    Where tracks are long, for example because the camera moves slowly, key images lie far apart.
    Where tracks are short, key images lie close together.

    Args:
        tracks: tracks of the whole video that poses may be estimated from.
        frames: int32 [num_images] frame number of each image, ascending.
        always: bool [num_images] images that become key images in any case.
        spacing: width in pixels of the cells of an image that are counted.
        num_cells: number of cells with tracks beyond which an image needs no more.

    Returns:
        int64 indices of images, ascending, including the first and the last.
    """
    num_images = len(frames)
    apart = max(1, min(_MAX_APART, (num_images - 1) // (_MIN_KEYS - 1)))
    seen = _TracksByImage(tracks, frames, spacing)
    key = [0]
    while key[-1] < num_images - 1:
        seen.compare_with(key[-1])
        wanted = _KEPT * min(num_cells, seen.num_shared_cells(key[-1]))
        last = min(key[-1] + apart, num_images - 1)
        following = key[-1] + 1
        while following < last and not always[following]:
            if seen.num_shared_cells(following + 1) < wanted:
                break
            following += 1
        key.append(following)
    return np.array(key, dtype=np.int64)


def spread_images(tracks: Tracks, num_images: int, key: Ints) -> NDArray[np.int32]:
    """Choose images of a long video: its key images, and others evenly in parallax.

    Args:
        tracks: tracks of the whole video.
        num_images: number of images to choose.
        key: int64 frames of the key images, ascending.

    Returns:
        int32 frames, ascending: `num_images`, or more if key images are close together.
    """
    spread = spread_in_parallax(tracks, num_images).astype(np.int64)
    # Each key image replaces the nearest other image.
    replaced = np.unique(nearest(spread, key))
    return np.union1d(np.delete(spread, replaced), key).astype(np.int32)


class _TracksByImage:
    """Counts the cells of images with tracks that are also observed in another image."""

    def __init__(self, tracks: Tracks, frames: NDArray[np.int32], spacing: float) -> None:
        by_frame = tracks.by_frame()
        self._rows = [by_frame[frame] for frame in frames.tolist()]
        self._number = tracks.track.astype(np.int32)
        self._xy = tracks.xy
        self._spacing = np.float32(max(spacing, 1.0))
        self._num_columns = int(tracks.width // self._spacing) + 1
        self._compared = np.zeros(tracks.num_tracks, dtype=np.bool_)

    def compare_with(self, image: int) -> None:
        """Set the image whose tracks are counted from now on."""
        self._compared[:] = False
        self._compared[self._number[self._rows[image]]] = True

    def num_shared_cells(self, image: int) -> int:
        """Number of cells of an image with tracks of the image set by `compare_with`."""
        rows = self._rows[image]
        rows = rows[self._compared[self._number[rows]]]
        column, row = (self._xy[rows] // self._spacing).astype(np.int32).T
        return int(np.count_nonzero(np.bincount(row * self._num_columns + column)))

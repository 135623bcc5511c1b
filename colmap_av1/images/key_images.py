"""Key images: those of a video that its poses are found from, as many as tracks need to connect."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from colmap_av1.images.choosing import choose_frames
from colmap_av1.options import ImageOptions
from colmap_av1.tracks.tracks import Tracks

# Share of its cells with tracks that a key image has in common with the next one: of three in a row
# they then have half in common, and a point takes three views.
_KEPT = 0.7
# Key images are so many at least, where there are as many images, and one in so many at least.
_LEAST_KEYS = 10
_MOST_APART = 6


def key_images(
    tracks: Tracks,
    frames: NDArray[np.int32],
    always: NDArray[np.bool_],
    *,
    spacing: float,
    num_cells: int,
) -> NDArray[np.int64]:
    """Choose key images as far apart as tracks still connect neighbours well.

    Where tracks live long, because the camera moves slowly or much is seen for long, key images lie
    far apart; what moves fast or ends early has them close together.

    Args:
        tracks: tracks of the whole video that poses may be estimated from.
        frames: int32 [num_images] display index of each image, ascending.
        always: bool [num_images] images that become key images in any case.
        spacing: width in pixels of the cells of an image that are counted.
        num_cells: cells with tracks that an image needs at most.

    Returns:
        int64 indices of images, ascending, the first and the last among them.
    """
    num_images = len(frames)
    apart = max(1, min(_MOST_APART, (num_images - 1) // (_LEAST_KEYS - 1)))
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


def spread_images(tracks: Tracks, num_images: int, key: NDArray[np.int64]) -> NDArray[np.int32]:
    """Choose images of a long video: its key images, and between them evenly in parallax.

    Args:
        tracks: tracks of the whole video.
        num_images: images to choose.
        key: int64 key images, as frames, ascending.

    Returns:
        int32 frames, ascending: `num_images` of them, or more where key images are close together.
    """
    evenly = ImageOptions(num_images=num_images, select="parallax")
    spread = choose_frames(tracks, evenly).astype(np.int64)
    # A key image takes the place of the one nearest to it.
    after = np.clip(np.searchsorted(spread, key), 1, len(spread) - 1)
    is_before = key - spread[after - 1] <= spread[after] - key
    replaced = np.unique(np.where(is_before, after - 1, after))
    return np.union1d(np.delete(spread, replaced), key).astype(np.int32)


class _TracksByImage:
    """Which tracks each image sees, and in how many of its cells."""

    def __init__(self, tracks: Tracks, frames: NDArray[np.int32], spacing: float) -> None:
        order = tracks.order_by_frame()
        ends = np.searchsorted(tracks.frame[order], np.arange(tracks.num_frames + 1))
        self._rows = [order[ends[frame] : ends[frame + 1]] for frame in frames.tolist()]
        self._number = tracks.track.astype(np.int32)
        self._xy = tracks.xy
        self._spacing = np.float32(max(spacing, 1.0))
        self._num_columns = int(tracks.width // self._spacing) + 1
        self._compared = np.zeros(tracks.num_tracks, dtype=np.bool_)

    def compare_with(self, image: int) -> None:
        """Count from now on the tracks that this image sees, too."""
        self._compared[:] = False
        self._compared[self._number[self._rows[image]]] = True

    def num_shared_cells(self, image: int) -> int:
        """Cells of an image in which it sees tracks of the compared one."""
        rows = self._rows[image]
        rows = rows[self._compared[self._number[rows]]]
        column, row = (self._xy[rows] // self._spacing).astype(np.int32).T
        return int(np.count_nonzero(np.bincount(row * self._num_columns + column)))

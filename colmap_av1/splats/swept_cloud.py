"""The cloud that trainers start from, of tracks and of what pictures show beside these."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from colmap_av1.geometry.colmap_model import ModelPoints, joined_points
from colmap_av1.geometry.coverage import PosedCamera
from colmap_av1.splats.cloud import splat_cloud
from colmap_av1.splats.sweep import Sweep
from colmap_av1.util.cpus import threads_or_cpus
from colmap_av1.util.progress import Clock

# Takes the picture of an image, by its index, see `Sweep.add`.
Look = Callable[[int, NDArray[np.uint8]], None]


def swept_cloud(
    tracked: ModelPoints,
    views: Sequence[PosedCamera],
    sequence: NDArray[np.int32],
    show: Callable[[Look], None],
    *,
    max_points: int | None,
    num_threads: int | None,
    clock: Clock,
) -> ModelPoints:
    """The points that a trainer needs, in black; see `Sweep` and `splat_cloud`.

    Args:
        tracked: points of tracks.
        views: the images, by the index that observations have.
        sequence: int32 [num_images] the video of each.
        show: gives the pictures of videos to what looks at them, in their order.
        max_points: points at most; None: any number.
        num_threads: see `RunOptions`.
        clock: measures the stages "sweep", but for what `show` measures itself, and "cloud".
    """
    with Sweep(tracked, views, sequence, num_threads=threads_or_cpus(num_threads)) as sweep:
        show(sweep.add)
        with clock.measure("sweep"):
            swept = sweep.result()
    with clock.measure("cloud"):
        return splat_cloud(joined_points([tracked, swept]), views, max_points)

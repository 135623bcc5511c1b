"""The point cloud for splatting, from tracks and from a sweep of the pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from colmap_av1.geometry.model_points import ModelPoints
from colmap_av1.geometry.posed_camera import PosedCamera
from colmap_av1.splats.cloud import splat_cloud
from colmap_av1.splats.sweep import Sweep
from colmap_av1.util.cpus import threads_or_cpus
from colmap_av1.util.progress import Clock

# Accepts the index and the picture of an image, see `Sweep.add`.
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
    """The point cloud for splatting, in black; see `Sweep` and `splat_cloud`.

    Args:
        tracked: points of tracks.
        views: the images, which the points' observations refer to.
        sequence: int32 [num_images] sequence of each image.
        show: calls its argument with the pictures of videos, in their order.
        max_points: largest number of points; None: no limit.
        num_threads: see `RunOptions`.
        clock: measures the stages "sweep" and "cloud"; time within `show` is not included.
    """
    with Sweep(tracked, views, sequence, num_threads=threads_or_cpus(num_threads)) as sweep:
        show(sweep.add)
        with clock.measure("sweep"):
            swept = sweep.result()
    with clock.measure("cloud"):
        return splat_cloud(ModelPoints.concatenate([tracked, swept]), views, max_points)

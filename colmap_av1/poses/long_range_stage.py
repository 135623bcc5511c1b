"""The stage that runs the long-range check."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from colmap_av1.images.image_set import ImageSet
from colmap_av1.poses.estimate_tracks import EstimateTracks
from colmap_av1.poses.long_range import LongRangeCheck, LongRangeErrors
from colmap_av1.poses.posed_images import (
    FOR_POSES,
    PosedImages,
    PosesResult,
    read_posed_images,
    triangulate_in,
)
from colmap_av1.poses.run import Run
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.arrays import Floats
from colmap_av1.util.grouping import groups
from colmap_av1.util.stages import Kept, run_stage

# About the number of tracks whose points determine which images overlap; short ones are ignored.
_NUM_TRACKS = 10_000


@dataclass(frozen=True)
class LongRangeResult:
    """What `long_range_stage` found.

    Attributes:
        median: median long-range epipolar error in pixels, over pairs of images ten or more apart;
            None if no such images have enough matches.
        largest: its 90th percentile.
        warning: warning about it.
        contradicts_poses: whether the images contradict the poses.
    """

    median: float | None
    largest: float | None
    warning: str | None
    contradicts_poses: bool


# The result for models that are not checked.
NOT_CHECKED = Kept(
    LongRangeResult(median=None, largest=None, warning=None, contradicts_poses=False),
    digest="",
    resumed=False,
)


def long_range_stage(
    run: Run,
    tracks: EstimateTracks,
    image_set: ImageSet,
    poses: Kept[PosesResult],
    *,
    searched_loops: bool,
    number: int,
) -> Kept[LongRangeResult]:
    """Match a few pairs of images far apart in time, and compare the matches with the poses.

    Args:
        run: inputs and options of the run.
        tracks: the tracks of all videos, without dynamic pixels.
        image_set: the images.
        poses: the stage that estimated the poses.
        searched_loops: whether loop closures have been searched in all videos.
        number: 1 for the check of the whole model, else the number of the adjustment after a split.
    """

    def make(_: Path) -> LongRangeResult:
        registered = read_posed_images(run, poses, image_set.masked_by(tracks.dynamic_masks))
        errors = _compared(run, tracks.motion, image_set, registered)
        return LongRangeResult(
            median=errors.median,
            largest=errors.largest,
            warning=errors.warning(searched_loops=searched_loops),
            contradicts_poses=errors.contradicts_poses,
        )

    return run_stage(
        run.stages,
        f"long_range_{number}" if number > 1 else "long_range",
        [poses.digest, tracks.masks_digest, searched_loops],
        LongRangeResult,
        products=[],
        make=make,
    )


def _compared(
    run: Run,
    tracks: Tracks,
    image_set: ImageSet,
    registered: PosedImages,
) -> LongRangeErrors:
    with run.clock.measure("long range"):
        points_of = _points_by_image(run, tracks, registered)
        check = LongRangeCheck(registered.images, registered.cameras, points_of.__getitem__)
        indices = np.searchsorted(image_set.images.frames, registered.frames[check.wanted]).tolist()
        index_of = dict(zip(indices, check.wanted, strict=True))
        for done, (k, picture) in enumerate(run.pictures(image_set)(indices), start=1):
            index = index_of[k]
            check.add(index, picture, registered.image_set.masks[index])
            run.progress("long range", done, len(indices))
        return check.result()


def _points_by_image(run: Run, tracks: Tracks, registered: PosedImages) -> list[Floats]:
    """Float64 [n, 3] some points that each image observes."""
    some = tracks.every_nth(max(1, tracks.num_tracks // _NUM_TRACKS))
    points = triangulate_in(run, registered, run.pose_tracks(some), FOR_POSES).model_points()
    xyz = points.xyz[points.point]
    return [xyz[own] for own in groups(points.image, len(registered.images))]

"""Check that COLMAP's incremental mapper starts well from matches, by running it.

The mapper adjusts focal length and distortion along with its first images. If few matches determine
them, they may diverge: no further image registers, and the mapper writes the few images as its
first model, which trainers open. Whether that happens depends on the mapper's random choices and on
the first five images, so the mapper itself is run until its first model has a number of images.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pycolmap

from colmap_av1.database.writing import write_matches
from colmap_av1.matching.initial_pairs import PreparedStart, are_far, with_demoted
from colmap_av1.matching.mapper_limits import DEFAULT_LIMITS
from colmap_av1.matching.matched_images import MatchedImages, connected_images
from colmap_av1.options import MapOptions
from colmap_av1.poses.mapper import LEAST_IMAGES, start_mapper
from colmap_av1.util.arrays import Bools
from colmap_av1.util.progress import Clock

# A start has succeeded with this number of images, or with half of all images. It is the least
# number that COLMAP's mapper requires of a model, except of the first (min_model_size).
_NUM_IMAGES = 10
# If the focal length is a default, it has succeeded with this number of images, or with this share
# of the largest set of images that matches connect, if that is less.
_NUM_ASSUMED, _ASSUMED_SHARE = 30, 0.9
# Largest number of starts that are tried.
_MAX_TRIALS = 5


def demote_failing_starts(
    start: PreparedStart,
    names: Sequence[str],
    cameras: Sequence[pycolmap.Camera],
    clock: Clock,
    *,
    fixed_intrinsics: bool = False,
    is_assumed: bool = False,
) -> MatchedImages | None:
    """Limit the inliers of pairs with which COLMAP's incremental mapper starts a small model.

    The mapper runs with one thread and the seed 0, with the limits of `start`. If no pair certainly
    meets them, it begins with lower ones, since it would try all pairs before it lowers them. Other
    seeds, numbers of threads and versions often start alike.

    Args:
        start: the images, and the mapper's limits.
        names: names of the images.
        cameras: the camera of each image. COLMAP 4.2 may crash if a focal length is not known.
        clock: gets the stage "verification".
        fixed_intrinsics: whether the mapper keeps the intrinsics.
        is_assumed: whether the focal length is a default, which may diverge late: a start then
            needs more images.

    Returns:
        The images with fewer inliers; None if no trial succeeds.

    Raises:
        ModelError: the mapper stopped.
    """
    if is_assumed:
        most_connected = np.bincount(connected_images(start.matched)).max()
        enough = min(_NUM_ASSUMED, round(_ASSUMED_SHARE * int(most_connected)))
    else:
        enough = min(_NUM_IMAGES, np.unique(start.matched.pairs).size // 2)
    num_images = max(LEAST_IMAGES, enough)
    options = MapOptions(
        mapper="incremental",
        refine_intrinsics=not fixed_intrinsics,
        seed=0,
        num_threads=1,
    )
    lower = vars(DEFAULT_LIMITS.relaxed[1]) if not start.is_certain else {}
    initial_pair = {**lower, **start.limits.options}

    def failing_start(matched: MatchedImages) -> list[str] | None:
        with tempfile.TemporaryDirectory() as folder:
            database, log = Path(folder) / "matches.db", Path(folder) / "log"
            write_matches(database, names, cameras, matched)
            return start_mapper(database, options, num_images, log=log, initial_pair=initial_pair)

    with clock.measure("verification"):
        return _without_failing_starts(start.matched, names, failing_start)


def _without_failing_starts(
    matched: MatchedImages,
    names: Sequence[str],
    failing_start: Callable[[MatchedImages], list[str] | None],
) -> MatchedImages | None:
    """Demote the pairs of small first models until a trial succeeds.

    Args:
        matched: the images.
        names: their names.
        failing_start: runs the mapper, see `start_mapper`.

    Returns:
        The images with fewer inliers; None if no trial succeeds.
    """
    found = matched
    for _ in range(_MAX_TRIALS):
        failed = failing_start(found)
        if failed is None:
            return found
        if not failed:
            break  # the mapper finds no initial pair
        images = [names.index(name) for name in failed]
        is_in = np.asarray(np.isin(matched.pairs, images).all(axis=1))
        # Neighbours connect the images, so they are demoted only if no other pair is left.
        changed = _demoted(found, is_in & are_far(matched.pairs)) or _demoted(found, is_in)
        if changed is None:
            break  # the next trial would be the same
        found = changed
    return None


def _demoted(matched: MatchedImages, which: Bools) -> MatchedImages | None:
    """The images with demoted pairs, bool [num_pairs]; None if they were demoted before."""
    changed = with_demoted(matched, np.flatnonzero(which))
    both = zip(changed.geometries, matched.geometries, strict=True)
    return None if all(new is old for new, old in both) else changed

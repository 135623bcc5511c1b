"""Check that COLMAP's incremental mapper starts well from matches, by running it.

The mapper adjusts focal length and distortion along with its first images. If few matches determine
them, they may diverge: no further image registers, and the mapper writes the few images as its
first model, which trainers open. Whether that happens depends on the mapper's random choices and on
the first five images, so the mapper itself is run until its first model has a number of images.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap

from colmap_av1.database.writing import write_matched_images
from colmap_av1.matching.image_matches import MatchedImages
from colmap_av1.matching.initial_pairs import NEIGHBOURS, demoted
from colmap_av1.matching.mapper_limits import LOWER_INITIAL_LIMITS
from colmap_av1.options import MapOptions
from colmap_av1.poses.mapper import start_mapper
from colmap_av1.util.run_context import RunContext

# A start has succeeded with this number of images, or with half of all images. It is the least
# number that COLMAP's mapper requires of a model, except of the first (min_model_size).
_NUM_IMAGES = 10
# Fewest images of a model that can be judged.
_LEAST_IMAGES = 3
# Largest number of starts that are tried.
_MAX_TRIALS = 5


def demote_failing_starts(
    matched: MatchedImages,
    names: Sequence[str],
    cameras: Sequence[pycolmap.Camera],
    context: RunContext,
    *,
    meets_first_limits: bool,
) -> MatchedImages:
    """Limit the inliers of pairs from which COLMAP's incremental mapper starts a model in vain.

    The mapper runs with one thread and the seed 0, with its defaults or with the options that
    `match` prints for forward motion. Other seeds and versions nearly always start alike.

    Args:
        matched: the images.
        names: their names.
        cameras: the camera of each image.
        context: its clock gets the stage "verification".
        meets_first_limits: whether a pair meets the mapper's limits for an initial pair. If not,
            the trials begin with the lower limits that the mapper tries later, because it takes
            many seconds to find that no pair meets the first ones.

    Returns:
        The images with fewer inliers; the given ones if no trial succeeds.

    Raises:
        ModelError: the mapper stopped.
    """
    most = np.unique(matched.pairs).size // 2
    num_images = max(_LEAST_IMAGES, min(_NUM_IMAGES, most))
    options = MapOptions(
        mapper="incremental",
        forward_motion=matched.forward_motion,
        seed=0,
        num_threads=1,
    )
    # Assumed focal lengths count as known: otherwise COLMAP 4.2 estimates them together with the
    # first pose, and its solver crashes on some pairs.
    copies = {id(camera): pycolmap.Camera(camera.todict()) for camera in cameras}
    for camera in copies.values():
        camera.has_prior_focal_length = True
    known = [copies[id(camera)] for camera in cameras]
    found = matched
    with context.clock.measure("verification"), tempfile.TemporaryDirectory() as folder:
        for trial in range(_MAX_TRIALS):
            database = Path(folder) / f"{trial}.db"
            write_matched_images(database, names, known, found)
            failed = start_mapper(
                database,
                options,
                num_images,
                log=Path(folder) / "log",
                initial_pair={} if meets_first_limits else LOWER_INITIAL_LIMITS,
            )
            if failed is None:
                return found
            is_in = np.isin(matched.pairs, [names.index(name) for name in failed]).all(axis=1)
            is_in &= np.diff(matched.pairs, axis=1)[:, 0] > NEIGHBOURS
            geometries = [
                demoted(geometry) if demote else geometry
                for geometry, demote in zip(found.geometries, is_in.tolist(), strict=True)
            ]
            found = replace(found, geometries=geometries)
    return matched

"""Choose pairs and cameras with which COLMAP's incremental mapper starts a large model."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import numpy as np  # noqa: F401 - before pycolmap: else writing PNG files fails later
import pycolmap

from colmap_av1.errors import ModelError
from colmap_av1.geometry.cameras import assumes_focal_length, with_known_focal_lengths
from colmap_av1.matching.initial_pairs import prepare_start
from colmap_av1.matching.mapper_limits import DEFAULT_LIMITS, FORWARD_MOTION, InitialLimits
from colmap_av1.matching.match_images import ImageMatches
from colmap_av1.matching.matched_images import MatchedImages
from colmap_av1.poses.joint_matches import JointMatches
from colmap_av1.poses.mapper_trials import demote_failing_starts
from colmap_av1.util.progress import Clock


@dataclass(frozen=True)
class MapperStart:
    """What COLMAP's incremental mapper starts from.

    Attributes:
        matched: the images with their matches. Pairs that would be a bad initial pair have fewer
            inliers.
        cameras: the camera of each image.
        limits: the limits of the initial pair that the mapper needs.
        fixed_intrinsics: whether the mapper should keep the intrinsics.
        warnings: problems with the mapper or the cameras.
    """

    matched: MatchedImages
    cameras: Sequence[pycolmap.Camera]
    limits: InitialLimits
    fixed_intrinsics: bool
    warnings: tuple[str, ...] = ()


def choose_mapper_start(
    found: ImageMatches, names: Sequence[str], clock: Clock, *, keep_cameras: bool
) -> MapperStart:
    """Choose pairs, cameras and fixed intrinsics so that the mapper starts a large model.

    If the joint estimate does not determine the focal length, the mapper refines the default one if
    a large model then grows, and otherwise keeps it. If intrinsics diverge with many pairs, the
    pairs are chosen so that a mapper with default options, which refines them, starts well, too.

    Args:
        found: the matches and cameras.
        names: names of the images.
        clock: gets the stage "verification".
        keep_cameras: the cameras are those of an existing database, which do not change.
    """
    if isinstance(found, JointMatches):
        # The cameras of images that the joint estimate does not register do not count.
        poses, counted = found.poses, found.registered_cameras
    else:
        poses, counted = [], found.cameras
    is_assumed = assumes_focal_length(counted)
    # The poses of pairs are wrong if a focal length is assumed.
    start = prepare_start(found.matched, found.cameras, clock, [] if is_assumed else poses)
    cameras, known_cameras = found.cameras, with_known_focal_lengths(found.cameras)
    # Cameras of an existing database are often rough, as from EXIF data.
    would_diverge = start.intrinsics_diverge and not keep_cameras
    fixed_intrinsics = not is_assumed and (start.limits == FORWARD_MOTION or would_diverge)
    warnings = []
    if is_assumed and poses and not keep_cameras:
        with suppress(ModelError):
            matched = demote_failing_starts(start, names, cameras, clock, is_assumed=True)
            if matched is not None:
                return MapperStart(matched, cameras, start.limits, fixed_intrinsics=False)
        warnings.append(
            "the images hardly determine the focal length, so the mapper keeps a default that may "
            "be far off: give the intrinsics by --camera_params if you know them"
        )
        # The mapper keeps the default intrinsics only if they count as known.
        cameras, fixed_intrinsics = known_cameras, True
    matched = None
    # Without depth, there is no good start.
    if found.depth.is_observable and (would_diverge or not start.is_tried):
        tried = partial(demote_failing_starts, names=names, cameras=known_cameras, clock=clock)
        try:
            if would_diverge:
                # Scripts often run the mapper without the options that `match` prints.
                is_certain = start.is_certain and start.limits == DEFAULT_LIMITS
                plain = tried(replace(start, limits=DEFAULT_LIMITS, is_certain=is_certain))
                if plain is not None:
                    matched = tried(replace(start, matched=plain), fixed_intrinsics=True)
            if matched is None:
                matched = tried(start, fixed_intrinsics=fixed_intrinsics)
        except ModelError:
            warnings.append(
                "COLMAP's mapper failed in a trial on this database and may fail again: its output "
                "then gives the reason"
            )
    return MapperStart(
        matched=matched or start.matched,
        cameras=cameras,
        limits=start.limits,
        fixed_intrinsics=fixed_intrinsics,
        warnings=tuple(warnings),
    )

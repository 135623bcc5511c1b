"""The initial pair for COLMAP's incremental mapper, chosen by known poses.

The mapper starts from a pair with many inliers and a large triangulation angle (the median over the
inliers), and halves these limits if no pair meets them. On a drive, most points that two images
share are far ahead. No pair has a large angle then, and the mapper may choose one with a wrong
pose. Points beside the road do have a large angle, so that the pair is matched by these alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from colmap_av1.geometry.colmap_model import ModelImage, camera_centres
from colmap_av1.matching.mapper_limits import (
    INITIAL_FORWARD_TOLERANCE,
    INITIAL_MARGIN,
    INITIAL_MAX_FORWARD_MOTION,
    INITIAL_MIN_ANGLE,
    INITIAL_MIN_INLIERS,
)
from colmap_av1.util.arrays import Floats, Ints
from colmap_av1.util.grouping import groups
from colmap_av1.util.spread import evenly_spread

_ENOUGH = round(1.5 * INITIAL_MIN_INLIERS)
_FORWARD = INITIAL_MAX_FORWARD_MOTION - INITIAL_FORWARD_TOLERANCE
# Number of images that are tried as the first of a pair, and distances in images to the second.
_NUM_FIRST = 100
_SPANS = (1, 2, 3, 4, 6, 8, 11, 15, 20, 28, 40, 56)


@dataclass(frozen=True)
class InitialPair:
    """An initial pair of images.

    Attributes:
        first: index of the first image.
        second: index of the second one.
        points: int64 [n] the points to match the pair by, ascending.
    """

    first: int
    second: int
    points: Ints


@dataclass(frozen=True)
class _Candidate:
    """A pair of images, the points that both observe, and their triangulation angles in degrees."""

    pair: tuple[int, int]
    points: Ints
    angles: Floats
    is_forward: bool

    def wide(self, angle: float) -> Ints:
        """The points to match the pair by, so that their median angle is large enough."""
        if np.median(self.angles) >= angle:
            return self.points
        return self.points[self.angles >= angle]


def initial_pair(
    point: Ints,
    view: Ints,
    xyz: Floats,
    images: Sequence[ModelImage],
) -> InitialPair | None:
    """Find the pair with the most points at a large angle, with sideways motion if possible.

    Args:
        point: int64 [num_observations] the point of each observation, ascending.
        view: int64 [num_observations] index of its image.
        xyz: float64 [num_points, 3] the points.
        images: the images with their poses.

    Returns:
        The pair; None if no pair that is tried has enough such points.
    """
    candidates = list(_candidates(point, view, xyz, images))
    for share in (1, 1 / 2, 1 / 4):
        angle = share * INITIAL_MARGIN * INITIAL_MIN_ANGLE
        for forward in (False, True):
            fit = [c for c in candidates if c.is_forward == forward]
            counts = [len(c.wide(angle)) for c in fit]
            if counts and max(counts) >= _ENOUGH:
                best = fit[int(np.argmax(counts))]
                return InitialPair(*best.pair, best.wide(angle))
    return None


def _candidates(
    point: Ints, view: Ints, xyz: Floats, images: Sequence[ModelImage]
) -> Iterator[_Candidate]:
    poses = np.array([image.cam_from_world for image in images])
    centres = camera_centres(poses)
    seen = [point[own] for own in groups(view, len(images))]
    for first in evenly_spread(len(images), _NUM_FIRST):
        for second in (first + span for span in _SPANS if first + span < len(images)):
            common = np.intersect1d(seen[first], seen[second], assume_unique=True)
            if len(common) < _ENOUGH:
                break
            rays = xyz[common] - centres[[first, second], None]
            rays /= np.linalg.norm(rays, axis=2, keepdims=True)
            cosine = np.clip((rays[0] * rays[1]).sum(axis=1), -1.0, 1.0)
            step = poses[second, 2, :3] @ (centres[second] - centres[first])
            length = np.linalg.norm(centres[second] - centres[first])
            yield _Candidate(
                (first, second),
                common,
                np.degrees(np.arccos(cosine)),
                bool(abs(step) > _FORWARD * length),
            )

"""Choose the pairs of images with which COLMAP's incremental mapper may begin."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_av1.geometry.colmap_model import relative_pose
from colmap_av1.matching.growth import Growth
from colmap_av1.matching.initial_pair_trial import InitialPairTrial, try_initial_pair
from colmap_av1.matching.mapper_limits import (
    DEFAULT_LIMITS,
    FORWARD_MOTION,
    INITIAL_FORWARD_TOLERANCE,
    INITIAL_MARGIN,
    INITIAL_MIN_ANGLE,
    INITIAL_MIN_INLIERS,
    INITIAL_SMALL_ANGLE,
    SMALL_ANGLES,
    InitialLimits,
)
from colmap_av1.matching.matched_images import MatchedImages
from colmap_av1.matching.pair_poses import (
    angle_if_contradicted,
    angle_if_wrong,
    is_wrong_rotation,
    pair_pose,
    rotations_of_homography,
    some_inliers,
    triangulation_angle,
)
from colmap_av1.util.arrays import Bools, Floats, Ints
from colmap_av1.util.progress import Clock
from colmap_av1.util.spread import evenly_spread

# If no pair meets the mapper's limits for an initial pair, it halves the number of inliers, then
# the angle.
_MIN_INLIERS = INITIAL_MIN_INLIERS // 2
# It halves both twice. These are the lowest limits if it begins with those of `SMALL_ANGLES`.
_LEAST_INLIERS, _LEAST_ANGLE = INITIAL_MIN_INLIERS // 4, INITIAL_SMALL_ANGLE / 4
# Number of inliers that a demoted pair keeps: too few until the mapper halves their number twice.
_FEW_INLIERS = _MIN_INLIERS - 1
# The mapper may accept a pair with this share of the angle that it requires.
_WIDE_SHARE = 0.75
# A model is large if it has this share of the images of the largest model that grows from any of
# this many pairs.
_LARGE = 0.8
_NUM_GROWN = 16
# The mapper should keep the intrinsics if they diverge with at least this number of pairs, and with
# more than this share of those with which it begins in a trial. On eight clips the share was 0, or
# at least a third where the angle of view is narrow or the parallax small.
_NUM_DIVERGING, _DIVERGING_SHARE = 3, 0.1
# With several threads, the mapper tries the pairs of up to 16 images at a time. Before it begins
# with the n-th pair of one image, counted from 0, it may find one of the first 2 n + 2 of another.
_NUM_THREADS = 16
# Neighbours are at most this many images apart. They connect the images, and are only demoted if
# their pose is wrong, or if the mapper begins badly with them.
_NEIGHBOURS = 2


@dataclass(frozen=True)
class PreparedStart:
    """Matches from which COLMAP's incremental mapper starts well.

    Attributes:
        matched: the images. Pairs that would be a bad initial pair have fewer inliers.
        limits: the limits of the initial pair that the mapper needs.
        is_certain: a pair certainly meets these limits. If not, the mapper may have to lower them.
        is_tried: the mapper begins well with the pair that it finds first, as trials have shown. It
            refined the intrinsics, except with `FORWARD_MOTION`.
        intrinsics_diverge: the intrinsics diverge with many of the tried pairs. They may then
            diverge even with a pair that begins well in a trial, so the mapper should keep them.
    """

    matched: MatchedImages
    limits: InitialLimits
    is_certain: bool
    is_tried: bool
    intrinsics_diverge: bool


def prepare_start(
    matched: MatchedImages,
    cameras: Sequence[pycolmap.Camera],
    clock: Clock,
    known: Sequence[Sequence[Floats | None]] = (),
) -> PreparedStart:
    """Limit the inliers of pairs with which the mapper should not begin, and choose its limits.

    COLMAP's mapper takes a pair's pose from its homography if that explains most of the matches
    (`EstimateTwoViewGeometryPose`). If the matches or known poses contradict the pose, a model that
    begins with the pair fails after a few images, and the mapper still writes it first. The same
    happens if the mapper finds another pose, or if the intrinsics diverge, see `try_initial_pair`.
    A demoted pair keeps enough inliers to connect its images; tracks continue through the pairs
    between. Pairs with a wrong pose are demoted if its angle is large enough for the mapper, others
    only if the mapper might find them before a good pair.

    Known poses also show with which limits the mapper begins with a pair that grows to the largest
    model, or nearly, see `Growth`. These limits are chosen, the default ones if possible, and those
    for forward motion only if necessary: somebody who walks through a room moves forward most of
    the time, but not always. Pairs that are worse, or whose pose is not known, and that the mapper
    would find earlier are demoted, except neighbours.

    If the limits are not the default ones, the mapper without options tries hundreds of pairs with
    few inliers. RANSAC may give any of them a wrong pose with a large angle. These pairs are
    demoted, too, except neighbours, which connect the images. With `SMALL_ANGLES` and one known
    model, all demoted pairs keep fewer inliers than the mapper ever accepts. With several models,
    images of fast turns might then not register; with forward motion, the mapper might find no
    pair.

    If poses are known of several models, the mapper begins several times. Pairs with a wrong pose
    and at least 50 inliers keep fewer inliers than it ever accepts, too, and bad pairs of each
    model are demoted as those of the first.

    Args:
        matched: the images. The pose of the homography is tested only for pairs with an essential
            matrix, which needs known focal lengths.
        cameras: the camera of each image.
        clock: gets the stage "verification".
        known: for each model with known poses, float64 [3, 4] cam_from_world of each image, None if
            it is not in the model. The relative pose of images in different models is not known.
    """
    with clock.measure("verification"):
        found = _Candidates.of(matched, cameras, known)
        if len(known) > 1:
            # The mapper lowers its limits for the images that its first models leave.
            is_bad = found.is_wrong & (found.angle >= _WIDE_SHARE * _LEAST_ANGLE)
            matched = with_demoted(matched, np.flatnonzero(is_bad), _LEAST_INLIERS - 1)
            found = replace(found, count=matched.num_inliers)
        limits = FORWARD_MOTION if matched.forward_motion else DEFAULT_LIMITS
        search, demote = None, set[int]()
        if known:
            search = _Search(matched, cameras, found, Growth(matched, cameras, known))
            certain_limits, demote = search.first_certain()
            is_certain = certain_limits is not None
            limits = certain_limits or limits
        else:
            is_certain = bool(found.certain(limits).any())
        lowest_angle = limits.init_min_tri_angle
        if not is_certain:
            lowest_angle = min(lowest_angle, INITIAL_MIN_ANGLE / 2)
        elif known:
            # Wrong pairs with smaller angles are demoted if the mapper would find them first.
            lowest_angle = max(lowest_angle, INITIAL_MIN_ANGLE / 2)
        is_bad = found.is_wrong & (found.angle >= _WIDE_SHARE * lowest_angle)
        demote |= set(np.flatnonzero(is_bad).tolist())
        most, is_tried = _FEW_INLIERS, False
        if search is not None and is_certain:
            if limits != DEFAULT_LIMITS:
                has_few = found.is_far & (found.count < INITIAL_MARGIN * INITIAL_MIN_INLIERS)
                demote |= set(np.flatnonzero(has_few).tolist())
            if limits == SMALL_ANGLES and len(known) == 1:
                most = _LEAST_INLIERS - 1
            # The demoted pairs change the order of the others.
            demote = search.bad_pairs_of_limits([limits], demote, most)
            if limits == SMALL_ANGLES:  # or the mapper begins without options
                default = [DEFAULT_LIMITS, *DEFAULT_LIMITS.relaxed]
                more = search.bad_pairs_of_limits(default, demote, most)
                more, has_good = search.bad_pairs(limits, more, most)
                # If all good pairs have about 8 degrees, none would be left for `limits`.
                demote = more if has_good else demote
            for number in range(1, len(known)):
                own = search.of_model(number)
                demote = own.bad_pairs_of_limits([limits, *limits.relaxed], demote, most)
            # With several models, the mapper may begin with another one than expected.
            is_tried = len(known) == 1 and not search.has_untried_pair
    return PreparedStart(
        matched=with_demoted(matched, demote, most),
        limits=limits,
        is_certain=is_certain,
        is_tried=is_tried,
        intrinsics_diverge=search is not None and search.intrinsics_diverge,
    )


def with_demoted(
    matched: MatchedImages, which: Iterable[int], most: int = _FEW_INLIERS
) -> MatchedImages:
    """Limit the inliers of pairs, and keep them evenly spread.

    Args:
        matched: the images.
        which: indices of the pairs.
        most: largest number of inliers.
    """
    geometries = list(matched.geometries)
    for k in which:
        own = geometries[k].inlier_matches
        if len(own) > most:
            chosen = evenly_spread(len(own), most, rounded=True)
            geometries[k] = replace(geometries[k], inlier_matches=own[chosen])
    return replace(matched, geometries=geometries)


@dataclass(frozen=True)
class _Candidates:
    """What decides whether the mapper may begin with each pair of images.

    Attributes:
        count: int64 [num_pairs] number of inliers.
        angle: float64 [num_pairs] triangulation angle in degrees by the pose of the two-view
            geometry; NaN if the pair has no pose or too few inliers.
        along: float64 [num_pairs] translation of this pose along the optical axis, as the mapper
            measures it: not as a share of the whole if the pose is from a homography.
        known_along: float64 [num_pairs] share of the translation of the known pose along the
            optical axis; NaN if it is not known.
        is_wrong: bool [num_pairs] whether the pose is wrong.
        is_sound: bool [num_pairs] whether nothing contradicts the pose. If poses of images are
            known, that of the pair must be.
        is_far: bool [num_pairs] whether the images are no neighbours.
        known_pose: for each pair, float64 [3, 4] pose of the second image relative to the first;
            None if it is not known.
    """

    count: Ints
    angle: Floats
    along: Floats
    known_along: Floats
    is_wrong: Bools
    is_sound: Bools
    is_far: Bools
    known_pose: list[Floats | None]

    @staticmethod
    def of(
        matched: MatchedImages,
        cameras: Sequence[pycolmap.Camera],
        known: Sequence[Sequence[Floats | None]],
    ) -> _Candidates:
        """Look at the poses of all pairs."""
        count = matched.num_inliers
        angle, along, known_along = np.full((3, len(count)), np.nan)
        is_wrong = np.zeros(len(count), np.bool_)
        poses: list[Floats | None] = [None] * len(count)
        for k in np.flatnonzero(count >= _MIN_INLIERS).tolist():
            pair, geometry = matched.pairs[k].tolist(), matched.geometries[k]
            some = some_inliers(matched, cameras, pair, geometry)
            pose = pair_pose(geometry, some)
            if pose is None:
                continue
            angle[k], along[k] = triangulation_angle(pose[:, :3], some.rays), abs(pose[2, 3])
            known_pose = _known_pose(known, pair)
            poses[k] = known_pose
            if known_pose is not None:
                known_along[k] = abs(known_pose[2, 3])
            wrong = angle_if_contradicted(geometry, some)
            if wrong is None and known_pose is not None:
                rotations = [pose[:, :3], *rotations_of_homography(geometry, some)]
                wrong = angle_if_wrong(rotations, known_pose[:, :3], some.rays)
            if wrong is not None:
                is_wrong[k], angle[k] = True, wrong
        is_sound = ~is_wrong & ~np.isnan(known_along if known else angle)
        is_far = are_far(matched.pairs)
        return _Candidates(count, angle, along, known_along, is_wrong, is_sound, is_far, poses)

    def certain(self, limits: InitialLimits) -> Bools:
        """Whether the mapper certainly accepts each pair, bool [num_pairs]."""
        is_certain = self.is_sound & self.possible(limits)
        is_certain &= self.count >= INITIAL_MARGIN * limits.init_min_num_inliers
        is_certain &= self.angle >= INITIAL_MARGIN * limits.init_min_tri_angle
        if limits.init_max_forward_motion < 1.0:
            along = np.fmax(self.along, self.known_along)
            is_certain &= along < limits.init_max_forward_motion - INITIAL_FORWARD_TOLERANCE
        return is_certain

    def possible(self, limits: InitialLimits) -> Bools:
        """Whether the mapper may accept each pair, bool [num_pairs]."""
        is_possible = self.count >= limits.init_min_num_inliers
        is_possible &= self.angle >= _WIDE_SHARE * limits.init_min_tri_angle
        return is_possible & (
            self.along < limits.init_max_forward_motion + INITIAL_FORWARD_TOLERANCE
        )


class _Search:
    """The mapper's search for an initial pair among images with known poses.

    Args:
        matched: the images.
        cameras: the camera of each image.
        found: what is known of the pairs.
        growth: the growth of models.

    Attributes:
        has_untried_pair: whether a pair was not tried because its images have different cameras.
        intrinsics_diverge: see `PreparedStart`.
    """

    def __init__(
        self,
        matched: MatchedImages,
        cameras: Sequence[pycolmap.Camera],
        found: _Candidates,
        growth: Growth,
    ) -> None:
        self._matched, self._cameras, self._found = matched, cameras, found
        self._growth = growth
        self.has_untried_pair = False
        self._known_large = dict[int, bool]()
        self._trials = dict[tuple[int, InitialLimits], InitialPairTrial | None]()
        some = np.flatnonzero(found.certain(FORWARD_MOTION))
        some = some[evenly_spread(len(some), _NUM_GROWN)]
        grown = [int(growth.registered(matched.pairs[k].tolist()).sum()) for k in some]
        self._large_size = math.ceil(_LARGE * max(grown, default=0))

    @property
    def intrinsics_diverge(self) -> bool:
        """See `PreparedStart`; decided by the pairs of all models tried so far."""
        begun = [(k, trial) for (k, _), trial in self._trials.items() if trial is not None]
        num_diverged = len({k for k, trial in begun if trial.diverged})
        num_begun = len({k for k, _ in begun})
        return num_diverged >= _NUM_DIVERGING and num_diverged > _DIVERGING_SHARE * num_begun

    def of_model(self, number: int) -> _Search:
        """The search among the images of one model, after the others are registered."""
        is_own = self._growth.model_of[self._matched.pairs] == number
        found = replace(self._found, count=np.where(is_own.all(axis=1), self._found.count, 0))
        own = _Search(self._matched, self._cameras, found, self._growth)
        own._trials = self._trials
        return own

    def first_certain(self) -> tuple[InitialLimits | None, set[int]]:
        """The first limits with which the mapper finds a good pair, and the bad pairs before it.

        Returns:
            The limits; None if no good pair certainly meets any of them. Indices of the pairs.
        """
        for limits in (DEFAULT_LIMITS, SMALL_ANGLES, FORWARD_MOTION):
            if self._found.certain(limits).any():
                bad, has_good = self.bad_pairs(limits)
                if has_good:
                    return limits, bad
        return None, set()

    def bad_pairs_of_limits(
        self, each: Iterable[InitialLimits], demoted: set[int], most: int
    ) -> set[int]:
        """Pairs that the mapper may find before a good one, with several limits in turn.

        Args:
            each: the limits, in the order in which the mapper tries them.
            demoted: indices of pairs that are demoted.
            most: number of inliers that demoted pairs keep.

        Returns:
            Indices of these pairs, including the demoted ones.
        """
        bad = demoted
        for limits in each:
            bad, has_good = self.bad_pairs(limits, bad, most)
            if has_good:
                break
        return bad

    def bad_pairs(
        self, limits: InitialLimits, demoted: Collection[int] = (), most: int = _FEW_INLIERS
    ) -> tuple[set[int], bool]:
        """Pairs that the mapper may find before it finds a good one.

        A pair is good if its pose is known and right, the mapper begins well with it, and a large
        model grows from it. If the limits are not the default ones, it must also meet them with
        certainty: RANSAC may get a pose wrong if the angle is only a few degrees.

        Args:
            limits: the limits of the initial pair.
            demoted: indices of pairs that are demoted.
            most: number of inliers that demoted pairs keep.

        Returns:
            Indices of bad pairs, including the demoted ones; neighbours only if their pose is wrong
            or the mapper begins badly with them. Whether a good pair certainly meets the limits.
        """
        found = self._found
        certain, possible = found.certain(limits), found.possible(limits)
        is_sound = found.is_sound if limits == DEFAULT_LIMITS else certain
        bad = set(demoted)
        while True:
            count = found.count.copy()
            count[list(bad)] = np.minimum(count[list(bad)], most)
            num_before = len(bad)
            order, rank, number = self._order(count)
            first = last = None  # indices in the order of the first and the latest certain pair
            for i, k in enumerate(order.tolist()):
                if not possible[k] or count[k] < limits.init_min_num_inliers:
                    continue
                if last is not None and rank[i] == rank[last]:
                    continue  # the mapper tries no further pair of this image
                if first is not None:
                    if rank[i] >= rank[first] + _NUM_THREADS:
                        break
                    if number[i] > 2 * number[first] + 1:
                        continue
                if is_sound[k]:
                    has_begun = self._begins(k, limits)
                    if has_begun is None:
                        continue  # the mapper rejects the pair
                    if has_begun and self._is_large(k):
                        if certain[k]:
                            first, last = i if first is None else first, i
                        continue
                    if not has_begun:
                        bad.add(k)
                if found.is_far[k] or found.is_wrong[k]:
                    bad.add(k)
            if first is None or len(bad) == num_before:
                return bad, first is not None

    def _order(self, count: Ints) -> tuple[Ints, Ints, Ints]:
        """The pairs in the order in which the mapper tries them.

        It tries the images by their number of matches, each with all others by the number of
        matches in common. COLMAP 4.2 tries several images at a time if it has several threads, and
        begins with the pair that it finds first.

        Returns:
            int64 [num_pairs] the pairs, the rank of the image with which each is tried, and its
            number among the pairs of that image.
        """
        pairs = self._matched.pairs
        total = np.bincount(pairs.ravel(), np.repeat(count, 2))
        rank = np.argsort(np.argsort(-total, kind="stable"))[pairs].min(axis=1)
        order = np.lexsort((-count, rank))
        rank = rank[order]
        return order, rank, np.arange(len(rank)) - np.searchsorted(rank, rank)

    def _is_large(self, k: int) -> bool:
        """Whether a large model grows from a pair."""
        if k not in self._known_large:
            pair = self._matched.pairs[k].tolist()
            grown = self._growth.registered(pair, max_images=self._large_size)
            self._known_large[k] = int(grown.sum()) >= self._large_size
        return self._known_large[k]

    def _begins(self, k: int, limits: InitialLimits) -> bool | None:
        """Whether the mapper begins well with a pair; None if it does not begin with it."""
        first, second = self._matched.pairs[k].tolist()
        # With a zoom, each image has its own camera. The mapper's first adjustment diverges then,
        # and most models grow nevertheless.
        if self._cameras[first] is not self._cameras[second]:
            self.has_untried_pair = True
            return True
        if (k, limits) not in self._trials:
            self._trials[k, limits] = self._trial(k, limits)
        begun = self._trials[k, limits]
        if begun is None:
            return None
        if begun.diverged:
            return False
        pose = self._found.known_pose[k]
        assert pose is not None
        angle = max(limits.init_min_tri_angle, float(self._found.angle[k]))
        return not is_wrong_rotation(begun.cam2_from_cam1[:, :3], pose[:, :3], angle)

    def _trial(self, k: int, limits: InitialLimits) -> InitialPairTrial | None:
        """The mapper's model of a pair; None if it does not begin with it."""
        pair = self._matched.pairs[k].tolist()
        inliers = self._matched.geometries[k].inlier_matches.T
        xy = [
            self._matched.keypoints[image].xy[own] for image, own in zip(pair, inliers, strict=True)
        ]
        refine = limits != FORWARD_MOTION
        return try_initial_pair(xy, self._cameras[pair[0]], limits, refine_intrinsics=refine)


def are_far(pairs: NDArray[np.int32]) -> Bools:
    """Whether the images of each pair, int32 [num_pairs, 2], are no neighbours."""
    return np.asarray(pairs[:, 1] - pairs[:, 0] > _NEIGHBOURS)


def _known_pose(models: Sequence[Sequence[Floats | None]], pair: Sequence[int]) -> Floats | None:
    """The pose of the second camera relative to the first, float64 [3, 4]; None if not known.

    The translation has length 1.
    """
    for cam_from_world in models:
        first, second = (cam_from_world[image] for image in pair)
        if first is not None and second is not None:
            pose = relative_pose(first, second)
            pose[:, 3] /= max(float(np.linalg.norm(pose[:, 3])), 1e-12)
            return pose
    return None

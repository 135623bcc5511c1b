"""The joint estimate of all poses, for `match` and `reconstruct`.

Poses are first estimated without further links, see `estimate_steps`. What they show decides where
links are looked for, whether links are used at all, and which of the mapper's models becomes the
first. The decisions are stages: a resumed run whose decisions are stored makes only the final
estimate.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, Literal, TypeVar

from colmap_av1.errors import ModelError, VideoError
from colmap_av1.geometry.posed_model import read_posed_model
from colmap_av1.images.image_set import ImageSet
from colmap_av1.images.track_images import VideoTracks
from colmap_av1.poses.estimate_steps import (
    Estimate,
    KeyImageModels,
    map_key_images,
    pose_images,
    split_at_seams,
)
from colmap_av1.poses.mapping_stage import num_nearest
from colmap_av1.poses.match_stage import matches_key
from colmap_av1.poses.run import Run
from colmap_av1.util.stages import run_stage

_Value = TypeVar("_Value")

# An estimate without further links must have this share of the images of the one with them.
_LEAST_SHARE = 0.5


@dataclass(frozen=True)
class _Plan:
    """What an estimate is made from.

    Attributes:
        doubted: frames after seams where links replace motion.
        links: "sift": look for loop closures in all videos; "none": use no links; None: as in the
            options of the run.
        model_file: file of the mapper's model to continue with; None for the largest.
    """

    doubted: tuple[int, ...] = ()
    links: Literal["sift", "none"] | None = None
    model_file: str | None = None


@dataclass(frozen=True)
class _FirstEstimate:
    """What the first estimate shows, which has no further links.

    Attributes:
        further: the plan with further links where they are needed.
        can_be_kept: whether no pictures contradict the poses, or a split may correct them.
    """

    further: _Plan
    can_be_kept: bool


_FIRST_PLAN = _Plan()


class _Last(Generic[_Value]):
    """The last result of a kind; freed before the next is made, because estimates are large."""

    def __init__(self) -> None:
        self._made: tuple[_Plan, _Value] | None = None

    def get(self, plan: _Plan, make: Callable[[], _Value]) -> _Value:
        """The last result if it has the same plan, else a new one."""
        if self._made is None or self._made[0] != plan:
            self._made = None
            self._made = plan, make()
        return self._made[1]


@dataclass(frozen=True)
class _Outcome:
    """What an estimate shows.

    Attributes:
        num_registered: number of registered images.
        is_contradicted: see `Estimate`.
        is_confirmed: see `Estimate`.
    """

    num_registered: int
    is_contradicted: bool
    is_confirmed: bool


class _Estimates:
    """Estimates by different plans.

    Attributes:
        run: the run.
        image_set: the images.
    """

    def __init__(self, run: Run, videos: Sequence[VideoTracks], image_set: ImageSet) -> None:
        self.run, self.image_set = run, image_set
        self._videos = videos
        self._mapped = _Last[KeyImageModels]()
        self._whole = _Last[Estimate]()
        self._split = _Last[Estimate]()

    def mapped(self, plan: _Plan) -> KeyImageModels:
        """The mapper's models of the key images."""
        return self._mapped.get(
            replace(plan, model_file=None),
            lambda: map_key_images(
                self._run(plan), self._videos, self.image_set, doubted=plan.doubted
            ),
        )

    def whole(self, plan: _Plan) -> Estimate:
        """The adjusted poses of the first of these models."""
        return self._whole.get(
            plan,
            lambda: pose_images(
                self._run(plan), self._videos, self.image_set, self.mapped(plan), plan.model_file
            ),
        )

    def split(self, plan: _Plan) -> Estimate:
        """These poses, split at doubtful seams."""
        return self._split.get(
            plan,
            lambda: split_at_seams(self._run(plan), self.whole(plan), self.image_set).estimate,
        )

    def outcome(self, plan: _Plan) -> _Outcome:
        """What the estimate shows after it is split."""
        estimate = self.split(plan)
        size = estimate.last.result.num_registered
        return _Outcome(size, estimate.is_contradicted, estimate.is_confirmed)

    def _run(self, plan: _Plan) -> Run:
        return _with_links(self.run, plan.links) if plan.links is not None else self.run


def estimate_poses(run: Run, videos: Sequence[VideoTracks], image_set: ImageSet) -> Estimate:
    """Estimate poses, and if they are doubtful estimate them again with further SIFT links.

    Links replace motion at seams that are doubtful or lose the scale. Loop closures are looked for
    if pictures far apart in time contradict the poses. A model that is still poorly connected is
    split, see `parts`.

    Raises:
        ModelError: no poses can be estimated.
        VideoError: nothing connects any two images.
    """
    key = [matches_key(run, videos, image_set), run.options.poses, run.options.moving != "keep"]
    estimates = _Estimates(run, videos, image_set)

    def decided(
        name: str, depends_on: Sequence[Any], kind: type[_Value], decide: Callable[[], _Value]
    ) -> _Value:
        stage = run_stage(
            run.stages, name, [key, *depends_on], kind, products=[], make=lambda _: decide()
        )
        return stage.result

    first = decided("first_estimate", [], _FirstEstimate, lambda: _first_estimate(estimates))
    further = decided("further_links", [first], _Plan, lambda: _further_links(estimates, first))
    used = decided("links", [further], _Plan, lambda: _used_links(estimates, further))
    plan = decided("first_model", [used], _Plan, lambda: _first_model(estimates, used))
    return estimates.split(plan)


def _first_estimate(estimates: _Estimates) -> _FirstEstimate:
    """Make the first estimate, and see where further links are needed."""
    run, estimate = estimates.run, estimates.whole(_FIRST_PLAN)
    further = _Plan(
        doubted=tuple(unlinked_seams(run, estimates.image_set, estimate)),
        links="sift" if _needs_loops(run, estimate) else None,
    )
    return _FirstEstimate(further, not estimate.is_contradicted or bool(estimate.seams_to_split))


def _further_links(estimates: _Estimates, first: _FirstEstimate) -> _Plan:
    """The plan with further links; the first plan if pictures contradict only the poses with them.

    Links may follow an object that moves.
    """
    if first.further == _FIRST_PLAN:
        return _FIRST_PLAN
    try:
        linked = estimates.outcome(first.further)
    except ModelError:  # the poses without them can be used
        return _FIRST_PLAN
    if not first.can_be_kept or not linked.is_contradicted:
        return first.further
    try:
        plain = estimates.outcome(_FIRST_PLAN)
    except ModelError:  # too few tracks agree with the poses after a split
        return first.further
    is_large = plain.num_registered >= _LEAST_SHARE * linked.num_registered
    return _FIRST_PLAN if is_large and not plain.is_contradicted else first.further


def _used_links(estimates: _Estimates, plan: _Plan) -> _Plan:
    """The same plan, or one without links if pictures contradict only the poses with links.

    Several videos, and photos, are connected by links only.
    """
    linked = estimates.outcome(plan)
    may_mislead = (
        estimates.run.options.match.links.links == "auto"
        and estimates.image_set.num_sequences == 1
        and estimates.split(plan).tracks.link_tracks.num_tracks > 0
    )
    if not (may_mislead and linked.is_contradicted):
        return plan
    without_links = _Plan(links="none")
    try:
        plain = estimates.outcome(without_links)
    except (ModelError, VideoError):  # without links, there may be nothing to match
        return plan
    is_large = plain.num_registered >= _LEAST_SHARE * linked.num_registered
    return without_links if is_large and plain.is_confirmed else plan


def _first_model(estimates: _Estimates, plan: _Plan) -> _Plan:
    """The same plan, or one with the mapper's second model if the first is split smaller."""
    if estimates.split(plan) is estimates.whole(plan):
        return plan
    size = estimates.outcome(plan).num_registered
    other = _larger_model(estimates, plan, size)
    if other is None:
        return plan
    with_other = replace(plan, model_file=other)
    try:
        second = estimates.outcome(with_other)
    except ModelError:  # too few tracks agree with its poses
        return plan
    is_better = second.num_registered > size and not second.is_contradicted
    return with_other if is_better else plan


def _larger_model(estimates: _Estimates, plan: _Plan, size: int) -> str | None:
    """The file of the mapper's second model; None if it has no more than `size` images."""
    found = estimates.mapped(plan)
    others = found.mapped.result.other_models  # sorted by size
    if not others:
        return None
    second = read_posed_model(estimates.run.stages / others[0])
    is_larger = num_nearest(second, estimates.image_set, found.key_images) > size
    return others[0] if is_larger else None


def _needs_loops(run: Run, estimate: Estimate) -> bool:
    """Whether pictures far apart contradict the poses, and no loop closures were looked for."""
    looked = run.options.match.links.links != "auto" or estimate.matches.result.links.searched_loops
    return estimate.is_contradicted and not looked


def _with_links(run: Run, links: Literal["sift", "none"]) -> Run:
    """The run with loop closures in all videos, or without links."""
    match = run.options.match
    match = replace(match, links=replace(match.links, links=links))
    return replace(run, options=replace(run.options, match=match))


def unlinked_seams(run: Run, image_set: ImageSet, estimate: Estimate) -> list[int]:
    """Frames after seams that are doubtful or lose the scale, where no links were looked for."""
    if estimate.adjustment is None or run.options.match.links.links == "none":
        return []
    frame_of = image_set.images.frame_of
    links, adjusted = estimate.matches.result.links, estimate.adjustment.result
    looked_at = [*links.frames_of_gaps(), *links.fast]
    seams = [
        (frame_of[first], frame_of[second])
        for first, second in {*adjusted.doubtful_seams, *adjusted.scale_lost_seams}
    ]
    return sorted(
        after
        for before, after in seams
        if not any(first <= before and after <= last for first, last in looked_at)
    )

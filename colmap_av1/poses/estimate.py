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
from colmap_av1.poses.track_stage import VideoTracks
from colmap_av1.util.stages import run_stage

_Value = TypeVar("_Value")

# An estimate without further links must have this share of the images of the one with them.
_LEAST_SHARE = 0.5


@dataclass(frozen=True)
class _FirstModel:
    """Which of the mapper's models becomes the first.

    Attributes:
        file: the file of the model; None for the largest before models are split.
    """

    file: str | None


@dataclass(frozen=True)
class _FurtherLinks:
    """Where links are looked for after the first estimate.

    Attributes:
        doubted: frames after doubtful seams where no links were looked for.
        loops: whether to look for loop closures, because pictures far apart in time contradict the
            poses, and none were looked for.
        none: whether no links are used at all, because only poses with links are contradicted.
    """

    doubted: tuple[int, ...] = ()
    loops: bool = False
    none: bool = False


@dataclass(frozen=True)
class _FirstEstimate:
    """What the estimate without further links shows.

    Attributes:
        links: where links are looked for.
        can_be_kept: whether no pictures contradict the poses, or a split may correct them.
    """

    links: _FurtherLinks
    can_be_kept: bool


_NOTHING_FURTHER = _FurtherLinks()


class _Last(Generic[_Value]):
    """The last result of a kind; freed before the next is made, because estimates are large."""

    def __init__(self) -> None:
        self._made: tuple[tuple[Any, ...], _Value] | None = None

    def get(self, key: tuple[Any, ...], make: Callable[[], _Value]) -> _Value:
        """The last result if it has the same key, else a new one."""
        if self._made is None or self._made[0] != key:
            self._made = None
            self._made = key, make()
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
    """Estimates with different links.

    Attributes:
        run: the run.
        image_set: the images.
    """

    def __init__(self, run: Run, videos: Sequence[VideoTracks], image_set: ImageSet) -> None:
        self.run, self.image_set = run, image_set
        self._videos = videos
        self._mapped, self._whole, self._split = (
            _Last[KeyImageModels](),
            _Last[Estimate](),
            _Last[Estimate](),
        )

    def mapped(self, links: _FurtherLinks) -> KeyImageModels:
        """The mapper's models of the key images."""
        run = self._run(links)

        def make() -> KeyImageModels:
            return map_key_images(run, self._videos, self.image_set, doubted=links.doubted)

        return self._mapped.get((links,), make)

    def whole(self, links: _FurtherLinks, first: str | None) -> Estimate:
        """The adjusted poses of one of these models, given by its file; None: the largest."""
        run = self._run(links)

        def make() -> Estimate:
            return pose_images(run, self._videos, self.image_set, self.mapped(links), first)

        return self._whole.get((links, first), make)

    def split(self, links: _FurtherLinks, first: str | None) -> Estimate:
        """These poses, split at doubtful seams."""
        run = self._run(links)

        def make() -> Estimate:
            return split_at_seams(run, self.whole(links, first), self.image_set).estimate

        return self._split.get((links, first), make)

    def outcome(self, links: _FurtherLinks, first: str | None = None) -> _Outcome:
        """What the estimate shows after it is split."""
        estimate = self.split(links, first)
        size = estimate.last.result.num_registered
        return _Outcome(size, estimate.is_contradicted, estimate.is_confirmed)

    def is_split(self, links: _FurtherLinks) -> bool:
        """Whether the largest model is split."""
        return self.split(links, None) is not self.whole(links, None)

    def _run(self, links: _FurtherLinks) -> Run:
        if links.none:
            return _with_links(self.run, "none")
        return _with_links(self.run, "sift") if links.loops else self.run


def estimate_poses(run: Run, videos: Sequence[VideoTracks], image_set: ImageSet) -> Estimate:
    """Estimate poses, and if they are doubtful estimate them again with further SIFT links.

    Links replace motion at doubtful seams. Loop closures are looked for if pictures far apart in
    time contradict the poses. A model that is still poorly connected is split, see `parts`.

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
    further = decided(
        "further_links", [first], _FurtherLinks, lambda: _further_links(estimates, first)
    )
    links = decided("links", [further], _FurtherLinks, lambda: _used_links(estimates, further))
    model = decided("first_model", [links], _FirstModel, lambda: _first_model(estimates, links))
    return estimates.split(links, model.file)


def _first_estimate(estimates: _Estimates) -> _FirstEstimate:
    """Make the first estimate, and see where further links are needed."""
    run, estimate = estimates.run, estimates.whole(_NOTHING_FURTHER, None)
    links = _FurtherLinks(
        doubted=tuple(_unlinked_seams(run, estimates.image_set, estimate)),
        loops=_needs_loops(run, estimate),
    )
    return _FirstEstimate(links, not estimate.is_contradicted or bool(estimate.seams_to_split))


def _further_links(estimates: _Estimates, first: _FirstEstimate) -> _FurtherLinks:
    """Whether to use further links: not if pictures contradict only the poses with them.

    Links may follow an object that moves.
    """
    if first.links == _NOTHING_FURTHER:
        return _NOTHING_FURTHER
    try:
        linked = estimates.outcome(first.links)
    except ModelError:  # the poses without them can be used
        return _NOTHING_FURTHER
    if not first.can_be_kept or not linked.is_contradicted:
        return first.links
    plain = estimates.outcome(_NOTHING_FURTHER)
    is_large = plain.num_registered >= _LEAST_SHARE * linked.num_registered
    return _NOTHING_FURTHER if is_large and not plain.is_contradicted else first.links


def _used_links(estimates: _Estimates, further: _FurtherLinks) -> _FurtherLinks:
    """Whether to use links at all: not if pictures contradict only the poses with links.

    Several videos, and photos, are connected by links only.
    """
    linked = estimates.outcome(further)
    may_mislead = (
        estimates.run.options.match.links.links == "auto"
        and estimates.image_set.num_sequences == 1
        and estimates.split(further, None).link_tracks.num_tracks > 0
    )
    if not (may_mislead and linked.is_contradicted):
        return further
    none = _FurtherLinks(none=True)
    try:
        plain = estimates.outcome(none)
    except (ModelError, VideoError):  # without links, there may be nothing to match
        return further
    is_large = plain.num_registered >= _LEAST_SHARE * linked.num_registered
    return none if is_large and plain.is_confirmed else further


def _first_model(estimates: _Estimates, links: _FurtherLinks) -> _FirstModel:
    """Which of the mapper's models becomes the first: the second, if the first is split smaller."""
    if not estimates.is_split(links):
        return _FirstModel(None)
    size = estimates.outcome(links).num_registered
    other = _larger_model(estimates, links, size)
    if other is None:
        return _FirstModel(None)
    try:
        second = estimates.outcome(links, other)
    except ModelError:  # too few tracks agree with its poses
        return _FirstModel(None)
    is_better = second.num_registered > size and not second.is_contradicted
    return _FirstModel(other if is_better else None)


def _larger_model(estimates: _Estimates, links: _FurtherLinks, size: int) -> str | None:
    """The file of the mapper's second model; None if it has no more than `size` images."""
    mapped = estimates.mapped(links)
    others = mapped.models.result.other_models  # sorted by size
    if not others:
        return None
    second = read_posed_model(estimates.run.stages / others[0])
    is_larger = num_nearest(second, estimates.image_set, mapped.keyed) > size
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


def _unlinked_seams(run: Run, image_set: ImageSet, estimate: Estimate) -> list[int]:
    """Frames after doubtful seams where no links were looked for."""
    if estimate.adjustment is None or run.options.match.links.links == "none":
        return []
    frame_of = image_set.images.frame_of
    links = estimate.matches.result.links
    looked_at = [*links.frames_of_gaps(), *links.fast]
    seams = [
        (frame_of[first], frame_of[second])
        for first, second in estimate.adjustment.result.doubtful_seams
    ]
    return [
        after
        for before, after in seams
        if not any(first <= before and after <= last for first, last in looked_at)
    ]

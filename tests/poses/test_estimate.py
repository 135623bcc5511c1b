"""What an estimate shows: whether it is doubtful, and where links may replace motion."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

import pytest
from image_sets import images, tracks_from
from stage_results import MATCHES

from colmap_av1.matching.gaps import Gap
from colmap_av1.matching.links.report import LinkReport
from colmap_av1.options import LinkOptions, MatchOptions, ReconstructOptions
from colmap_av1.poses.adjustment_stage import AdjustedResult
from colmap_av1.poses.estimate import unlinked_seams
from colmap_av1.poses.estimate_steps import Estimate
from colmap_av1.poses.estimate_tracks import EstimateTracks
from colmap_av1.poses.mapping_stage import MappedResult
from colmap_av1.poses.run import Run
from colmap_av1.util.run_context import RunContext
from colmap_av1.util.stages import Kept

# Every fifth frame of two videos of 100 frames is an image.
IMAGES = images(100, 100).some(range(0, 200, 5))
GAP = Gap("a/040.png", "a/045.png", ("doubtful motion",), (40, 45))
GAPS = LinkReport(gaps=(GAP,))
FAST = LinkReport(fast=((30, 60),))
SEAM = ("a/015.png", "a/020.png")


def estimate_with(links: LinkReport, adjusted: dict[str, Any] | None) -> Estimate:
    """An estimate with these links; the values of `adjusted` differ from those of a good model.

    The poses are not adjusted if it is None.
    """
    matches = replace(MATCHES, links=links)
    mapped = MappedResult("mapped.npz", 40, mapper="global", other_models=())
    sound: dict[str, Any] = {
        "doubtful_seams": (),
        "few_point_seams": (),
        "scale_lost_seams": (),
        "keeps_assumed_focal_length": False,
        "has_long_focal_length": False,
    }
    adjustment = None
    if adjusted is not None:
        result = AdjustedResult(
            "adjusted.npz",
            40,
            num_motion_points=1000,
            num_link_points=0,
            usual_scaled=500.0,
            seams_warning=None,
            **{**sound, **adjusted},
        )
        adjustment = Kept(result, digest="", resumed=False)
    nothing = tracks_from([], 200)
    return Estimate(
        Kept(matches, digest="", resumed=False),
        Kept(mapped, digest="", resumed=False),
        EstimateTracks(nothing, nothing, has_picture_positions=True),
        adjustment=adjustment,
    )


@pytest.mark.parametrize("links", [GAPS, FAST])
@pytest.mark.parametrize(
    "uncertain",
    [
        {"doubtful_seams": (SEAM,)},
        {"scale_lost_seams": (SEAM,)},
        {"keeps_assumed_focal_length": True},
    ],
)
def test_uncertain_model_is_doubtful_if_links_replace_motion(
    links: LinkReport, uncertain: dict[str, Any]
) -> None:
    assert estimate_with(links, uncertain).is_doubtful
    assert not estimate_with(links, {}).is_doubtful
    without = LinkReport(num_images=20, num_links=5, searched_loops=True)
    assert not estimate_with(without, uncertain).is_doubtful


@pytest.mark.parametrize("links", [LinkReport(), GAPS])
def test_long_focal_length_is_doubtful(links: LinkReport) -> None:
    assert estimate_with(links, {"has_long_focal_length": True}).is_doubtful


def test_poses_that_are_not_adjusted_are_not_doubtful() -> None:
    assert not estimate_with(GAPS, None).is_doubtful


def unlinked(
    links: LinkReport,
    adjusted: dict[str, Any] | None,
    option: Literal["auto", "sift", "none"] = "auto",
) -> list[int]:
    """Frames after the seams of an estimate where links are missing."""
    options = ReconstructOptions(match=MatchOptions(links=LinkOptions(links=option)))
    unused: Any = None
    run = Run(unused, (), (), unused, unused, options, RunContext())
    return unlinked_seams(run, IMAGES, estimate_with(links, adjusted))


def test_seams_that_are_doubtful_or_lose_the_scale_need_links() -> None:
    """Each is given once by the frame after it, counted through all videos."""
    other, of_second_video = ("a/080.png", "a/085.png"), ("b/005.png", "b/010.png")
    adjusted = {
        "doubtful_seams": (SEAM, of_second_video),
        "few_point_seams": (SEAM,),
        "scale_lost_seams": (other, SEAM),
    }
    assert unlinked(LinkReport(), adjusted) == [20, 85, 110]
    assert unlinked(LinkReport(), {}) == []


@pytest.mark.parametrize("kind", ["doubtful_seams", "scale_lost_seams"])
def test_seams_where_links_were_looked_for_need_no_further_ones(kind: str) -> None:
    seams = [(f"a/{frame:03}.png", f"a/{frame + 5:03}.png") for frame in range(0, 95, 5)]
    every = list(range(5, 100, 5))
    assert unlinked(GAPS, {kind: seams}) == [after for after in every if after != 45]
    # A seam at the edge of a fast stretch is only in part in it.
    inside = range(35, 65, 5)
    assert unlinked(FAST, {kind: seams}) == [after for after in every if after not in inside]
    unknown = Gap("a/040.png", "a/045.png", ("doubtful motion",))
    assert unlinked(LinkReport(gaps=(unknown,)), {kind: seams}) == every


def test_no_seam_needs_links_if_links_are_off_or_poses_are_not_adjusted() -> None:
    adjusted = {"doubtful_seams": (SEAM,)}
    assert unlinked(LinkReport(), adjusted, "sift") == [20]
    assert unlinked(LinkReport(), adjusted, "none") == []
    assert unlinked(LinkReport(), None) == []

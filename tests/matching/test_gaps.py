"""Gaps: neighbouring images of a video that motion connects badly."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from colmap_av1.matching.few_matches import few_match_gaps, few_matches_warning
from colmap_av1.matching.gaps import Gap, low_inter_frames, low_inter_gaps

NUM_IMAGES = 30
REACH = 6


def chain(thin: dict[int, float]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of a video and their match counts, reduced to a share across the given gaps."""
    pairs = np.array(
        [(i, j) for i in range(NUM_IMAGES) for j in range(i + 1, min(i + REACH, NUM_IMAGES))]
    )
    count = np.full(len(pairs), 1000)
    for gap, share in thin.items():
        across = (pairs[:, 0] <= gap) & (pairs[:, 1] > gap)
        count[across] = np.rint(share * count[across])
    return pairs, count


def names_of(folder: str) -> list[str]:
    # In alphabetical order, '9' comes after '10'.
    return [f"{folder}{i}.png" for i in range(NUM_IMAGES)]


def test_gaps_with_few_matches_are_found() -> None:
    names, rows = names_of(""), [0] * NUM_IMAGES
    assert few_match_gaps(*chain({}), names, rows) == ()
    assert few_match_gaps(*chain({9: 0.7}), names, rows) == ()
    (gap,) = few_match_gaps(*chain({9: 0.1}), names, rows)
    assert (gap.before, gap.after) == ("9.png", "10.png")
    assert gap.share < 0.15
    # A gap without any matches splits the images into separate models, which is reported elsewhere.
    assert few_match_gaps(*chain({9: 0.0}), names, rows) == ()


@pytest.mark.parametrize(
    ("num_links", "linked", "num_gaps"), [(1, 0, 1), (5000, 0, 0), (5000, 20, 1)]
)
def test_images_held_together_by_those_of_another_folder_have_no_gaps(
    num_links: int, linked: int, num_gaps: int
) -> None:
    """Photos are matched with images of a video. Links far from the gap do not count."""
    names = names_of("video/") + names_of("photos/")
    pairs, count = chain({})
    own, few = chain({9: 0.1})
    links = np.column_stack([np.arange(NUM_IMAGES), np.arange(NUM_IMAGES) + NUM_IMAGES])[linked:]
    found = few_match_gaps(
        np.concatenate([pairs, own + NUM_IMAGES, links]),
        np.concatenate([count, few, np.full(len(links), num_links)]),
        names,
        [name.split("/")[0] for name in names],
    )
    assert len(found) == num_gaps


def test_warning_names_gaps_and_the_smallest_share() -> None:
    assert few_matches_warning(()) is None
    gaps = [
        Gap(f"{i}.png", f"{i + 1}.png", ("few tracks",), share=0.3 - 0.05 * i) for i in range(5)
    ]
    warning = few_matches_warning(gaps)
    assert warning is not None
    assert "10%" in warning
    assert "'0.png' and '1.png'" in warning
    assert "2 more" in warning
    assert "\n" not in warning


@given(st.randoms(use_true_random=False), st.integers(8, 20))
def test_gaps_do_not_depend_on_the_order_of_images(random: object, gap: int) -> None:
    """A database may list images of several videos in any order."""
    names = names_of("a/") + names_of("b/")
    rows = [name[0] for name in names]
    first, second = chain({gap: 0.1}), chain({})
    pairs = np.concatenate([first[0], second[0] + NUM_IMAGES])
    count = np.concatenate([first[1], second[1]])
    expected = few_match_gaps(pairs, count, names, rows)
    assert len(expected) == 1
    assert expected[0].before.startswith("a/")
    order = list(range(len(names)))
    random.shuffle(order)  # type: ignore[attr-defined]
    place = np.argsort(order)
    shuffled = [names[i] for i in order]
    found = few_match_gaps(place[pairs][:, ::-1], count, shuffled, [rows[i] for i in order])
    assert found == expected
    # In the natural order of these names, the images of each half of a video are mixed.
    mixed = [f"{name[0]}/{(7 * k) % NUM_IMAGES}.png" for k, name in enumerate(names)]
    found = few_match_gaps(pairs, count, mixed, rows, order=range(len(names)))
    assert [(g.before, g.after) for g in found] == [(mixed[gap], mixed[gap + 1])]


def test_frames_with_an_unusually_low_inter_share_are_found() -> None:
    usual = np.full(30, 0.85, np.float32)
    usual[0] = 0
    assert not low_inter_frames(usual).any()
    jerk = usual.copy()
    jerk[12] = 0.18
    assert np.flatnonzero(low_inter_frames(jerk)).tolist() == [12]
    # A drive: usually half of the units are inter coded; a slow frame has a third.
    drive = np.full(30, 0.5, np.float32)
    drive[[0, 8, 20]] = 0, 0.33, 0.15
    assert np.flatnonzero(low_inter_frames(drive)).tolist() == [20]
    # In a clip that compresses well, half of the usual share is low.
    half = np.full(40, 0.94, np.float32)
    half[17], half[30] = 0.47, 0.62
    assert np.flatnonzero(low_inter_frames(half)).tolist() == [17]
    # If the camera is always too fast, all frames are low.
    assert low_inter_frames(np.full(9, 0.04, np.float32))[1:].all()


@pytest.mark.parametrize("num_frames", [0, 1, 2, 9, 50])
def test_inter_share_is_compared_with_the_median_of_nearby_frames(num_frames: int) -> None:
    share = np.random.default_rng(num_frames).random(num_frames, np.float32)
    usual = [np.median(share[max(1, i - 8) : i + 9]) for i in range(1, num_frames)]
    for certain, least in ((False, 0.55), (True, 0.4)):
        low = [own < max(0.25, least * x) for own, x in zip(share[1:], usual, strict=True)]
        found = low_inter_frames(share, certain=certain)
        assert found.tolist() == [False, *low][:num_frames]


def test_low_inter_gaps_lie_between_images() -> None:
    share = np.full(20, 0.9, np.float32)
    share[[7, 13]] = 0.05
    gaps = low_inter_gaps(share, np.array([0, 3, 6, 9, 12, 15, 18]))
    assert np.flatnonzero(gaps).tolist() == [2, 4]

"""Gaps between the images of a video that few matches cross."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from colmap_av1.matching.weak_gaps import ThinGap, thin_gap_warning, thin_gaps

NUM_IMAGES = 30
REACH = 6


def chain(thin: dict[int, float]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of a video and their matches, where only shares of these cross some gaps."""
    pairs = np.array(
        [(i, j) for i in range(NUM_IMAGES) for j in range(i + 1, min(i + REACH, NUM_IMAGES))]
    )
    count = np.full(len(pairs), 1000)
    for gap, share in thin.items():
        across = (pairs[:, 0] <= gap) & (pairs[:, 1] > gap)
        count[across] = np.rint(share * count[across])
    return pairs, count


def names_of(folder: str) -> list[str]:
    # '9' comes after '10' in the order of letters.
    return [f"{folder}{i}.png" for i in range(NUM_IMAGES)]


def test_gaps_that_few_matches_cross() -> None:
    names, rows = names_of(""), [0] * NUM_IMAGES
    assert thin_gaps(*chain({}), names, rows) == ()
    assert thin_gaps(*chain({9: 0.7}), names, rows) == ()
    (gap,) = thin_gaps(*chain({9: 0.1}), names, rows)
    assert (gap.before, gap.after) == ("9.png", "10.png")
    assert gap.share < 0.15
    # Beside a gap that nothing crosses images become separate models, which is said elsewhere.
    assert thin_gaps(*chain({9: 0.0}), names, rows) == ()


def test_several_gaps_are_told_in_one_line() -> None:
    assert thin_gap_warning(()) is None
    gaps = [ThinGap(f"{i}.png", f"{i + 1}.png", 0.3 - 0.05 * i) for i in range(5)]
    (one,) = [thin_gap_warning(gaps[:1])]
    assert one is not None
    assert "down to 30% of what is usual, cross between '0.png' and '1.png', where" in one
    told = thin_gap_warning(gaps)
    assert told is not None
    assert "down to 10%" in told
    assert "'2.png' and '3.png' and at 2 more places, where" in told
    assert "\n" not in told


@given(st.randoms(use_true_random=False), st.integers(8, 20))
def test_gaps_are_those_of_each_video_in_any_order_of_images(random: object, gap: int) -> None:
    """Images are numbered as a database happens to list them."""
    names = names_of("a/") + names_of("b/")
    rows = [name[0] for name in names]
    first, second = chain({gap: 0.1}), chain({})
    pairs = np.concatenate([first[0], second[0] + NUM_IMAGES])
    count = np.concatenate([first[1], second[1]])
    expected = thin_gaps(pairs, count, names, rows)
    assert len(expected) == 1
    assert expected[0].before.startswith("a/")
    order = list(range(len(names)))
    random.shuffle(order)  # type: ignore[attr-defined]
    place = np.argsort(order)
    shuffled = [names[i] for i in order]
    found = thin_gaps(place[pairs][:, ::-1], count, shuffled, [rows[i] for i in order])
    assert found == expected

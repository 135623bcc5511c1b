from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from image_sets import tracks_from
from synthetic_scene import make_scene

from colmap_av1.errors import ImageError
from colmap_av1.matching.pairs import (
    ImageKeypoints,
    covisible_pairs,
    image_keypoints,
    pair_matches,
    schedule_pairs,
)
from colmap_av1.options import PairOptions


def images_seeing(tracks_of_image: list[list[int]]) -> list[ImageKeypoints]:
    return [
        ImageKeypoints(np.zeros((len(t), 2), np.float32), np.array(sorted(t), np.int64))
        for t in tracks_of_image
    ]


def test_keypoints_are_those_of_the_chosen_frames() -> None:
    tracks = tracks_from([[0, 1, 2], [2, 3], [1, 3, 5], [4, 5, 6]])
    images = image_keypoints(tracks, [0, 2, 5])
    # Tracks 1, 2 and 3 are observed in only one of the frames.
    assert [k.track.tolist() for k in images] == [[0], [0], []]
    assert images[1].xy.tolist() == [[2.0, 0.0]]
    assert images[2].xy.shape == (0, 2)
    assert images[0].xy.dtype == np.float32


@given(
    st.lists(st.sets(st.integers(0, 9), min_size=1), max_size=20),
    st.sets(st.integers(0, 9)),
)
def test_keypoints_agree_with_a_simple_loop(spans: list[set[int]], chosen: set[int]) -> None:
    tracks = tracks_from([sorted(s) for s in spans])
    images = image_keypoints(tracks, sorted(chosen))
    kept = [t for t, span in enumerate(spans) if len(span & chosen) >= 2]
    for image, frame in zip(images, sorted(chosen), strict=True):
        expected = [t for t in kept if frame in spans[t]]
        assert image.track.tolist() == expected
        assert image.xy.tolist() == [[100 * t + frame, t] for t in expected]


@pytest.mark.parametrize("frames", [[0, 10], [-1, 3], [3, 3], [4, 2]])
def test_invalid_frames_are_refused(frames: list[int]) -> None:
    with pytest.raises(ImageError):
        image_keypoints(tracks_from([[0, 1]]), frames)


@given(st.sets(st.integers(0, 40)), st.sets(st.integers(0, 40)))
def test_matches_join_keypoints_of_a_track(a: set[int], b: set[int]) -> None:
    first, second = images_seeing([list(a), list(b)])
    matches = pair_matches(first, second)
    assert matches.dtype == np.uint32
    assert first.track[matches[:, 0]].tolist() == sorted(a & b)
    assert second.track[matches[:, 1]].tolist() == sorted(a & b)


def test_schedule_reaches_the_longest_span() -> None:
    # 20 tracks start at every image and are observed in 24 images.
    images = images_seeing(
        [[20 * s + k for s in range(max(0, i - 23), i + 1) for k in range(20)] for i in range(100)]
    )
    pairs = schedule_pairs(images)
    spans = sorted(set((pairs[:, 1] - pairs[:, 0]).tolist()))
    assert spans[:8] == [1, 2, 3, 4, 5, 6, 8, 10]
    assert spans[-1] == 23
    assert len(spans) <= 12
    assert all((i, i + 1) in set(map(tuple, pairs.tolist())) for i in range(99))
    assert pairs.tolist() == sorted(pairs.tolist())


def test_schedule_grows_linearly_even_if_tracks_never_end() -> None:
    images = images_seeing([list(range(20))] * 1200)
    half = len(schedule_pairs(images[:600]))
    assert len(schedule_pairs(images)) < 2.15 * half
    assert half < 18 * 600


def test_schedule_only_keeps_pairs_with_enough_matches() -> None:
    images = images_seeing([list(range(20)), list(range(5, 30)), list(range(6, 30)), []])
    assert schedule_pairs(images).tolist() == [[0, 1], [1, 2]]
    assert schedule_pairs(images, PairOptions(min_matches=14)).tolist() == [[0, 1], [0, 2], [1, 2]]
    assert schedule_pairs(images, PairOptions(min_matches=14, max_span=1)).tolist() == [
        [0, 1],
        [1, 2],
    ]
    assert schedule_pairs([]).shape == (0, 2)


def test_schedule_without_growth_uses_the_offsets() -> None:
    images = images_seeing([list(range(20))] * 12)
    pairs = schedule_pairs(images, PairOptions(offsets=(3, 1), growth=1.0))
    expected = [(i, j) for i, j in combinations(range(12), 2) if j - i in (1, 3)]
    assert pairs.tolist() == [list(p) for p in expected]


def test_images_without_tracks_have_no_pairs() -> None:
    images = images_seeing([[], [], []])
    assert len(covisible_pairs(images, 1)) == len(schedule_pairs(images)) == 0


def test_scene_pairs_share_tracks() -> None:
    images = image_keypoints(make_scene().tracks, range(16))
    for i, j in schedule_pairs(images):
        assert len(pair_matches(images[i], images[j])) >= 15

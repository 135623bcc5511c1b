from __future__ import annotations

import numpy as np
import pytest

from colmap_av1.images.key_images import key_images, spread_images
from colmap_av1.tracks.tracks import Tracks

_SIZE = (320, 240)
_SPACING = 16.0


def sliding_tracks(steps: list[float]) -> Tracks:
    """Tracks of a plane that slides to the left by these steps in pixels per frame."""
    travelled = np.concatenate([[0.0], np.cumsum(steps)])
    x, y = np.meshgrid(np.arange(4, _SIZE[0] + travelled[-1], 8), np.arange(4, _SIZE[1], 8))
    at = x.ravel()[:, None] - travelled
    track, frame = np.nonzero((at >= 0) & (at < _SIZE[0]))
    counts = np.bincount(track, minlength=x.size)
    xy = np.column_stack([at[track, frame], y.ravel()[track]]).astype(np.float32)
    return Tracks(
        len(travelled),
        *_SIZE,
        np.concatenate([[0], np.cumsum(counts)]),
        frame.astype(np.int32),
        xy,
        np.zeros(len(xy), np.float32),
        np.zeros(len(xy), np.bool_),
    )


def keys_of(tracks: Tracks, always: tuple[int, ...] = ()) -> list[int]:
    frames = np.arange(tracks.num_frames, dtype=np.int32)
    given = np.isin(frames, always)
    return key_images(tracks, frames, given, spacing=_SPACING, num_cells=600).tolist()


def test_neighbouring_key_images_share_seven_tenths_of_their_cells() -> None:
    key = keys_of(sliding_tracks([16.0] * 119))
    assert set(np.diff(key[:-1])) == {int(0.3 * _SIZE[0] / 16)}
    assert (key[0], key[-1]) == (0, 119)


def test_key_images_are_closer_where_motion_is_fast() -> None:
    key = keys_of(sliding_tracks([4.0] * 60 + [40.0] * 12 + [4.0] * 60))
    steps = np.diff(key)
    during = np.flatnonzero((np.array(key[:-1]) >= 60) & (np.array(key[1:]) <= 72))
    assert set(steps[during]) <= {1, 2}
    assert steps.max() == 6  # the limit for slow motion


@pytest.mark.parametrize(("num_images", "most_apart"), [(2, 1), (9, 1), (19, 2), (85, 6)])
def test_short_videos_have_at_least_ten_key_images(num_images: int, most_apart: int) -> None:
    key = keys_of(sliding_tracks([0.1] * (num_images - 1)))
    assert len(key) >= min(num_images, 10)
    assert np.diff(key).max() == most_apart


def test_requested_frames_are_key_images() -> None:
    key = keys_of(sliding_tracks([1.0] * 119), always=(50, 51, 53))
    assert {0, 50, 51, 53, 119} <= set(key)


def test_key_images_without_tracks() -> None:
    tracks = sliding_tracks([1.0] * 29)
    nothing = Tracks(
        30,
        *_SIZE,
        np.zeros(1, np.int64),
        tracks.frame[:0],
        tracks.xy[:0],
        tracks.sigma[:0],
        tracks.confirmed[:0],
    )
    assert keys_of(nothing)[-1] == 29


def test_images_of_a_long_video_include_key_images_and_are_even_in_parallax() -> None:
    # The second half is twice as fast.
    tracks = sliding_tracks([2.0] * 100 + [4.0] * 100)
    key = np.array([0, 7, 8, 9, 50, 120, 200])
    frames = spread_images(tracks, 40, key)
    assert set(key) <= set(frames.tolist())
    assert len(np.unique(frames)) == len(frames)
    # Three key images are where one image would suffice.
    assert 40 <= len(frames) <= 42
    assert np.median(np.diff(frames[(frames > 10) & (frames < 100)])) == 8
    assert np.median(np.diff(frames[frames > 100])) == 4


def test_there_are_at_most_as_many_images_as_frames() -> None:
    tracks = sliding_tracks([2.0] * 9)
    assert spread_images(tracks, 10, np.arange(10)).tolist() == list(range(10))
    assert spread_images(tracks, 3, np.arange(10)).tolist() == list(range(10))

from __future__ import annotations

import numpy as np

from colmap_av1.tracks.fast_frames import fast_frames
from colmap_av1.tracks.tracks import Tracks


def tracks_of_lengths(length: int, num_frames: int = 60) -> Tracks:
    """Twenty tracks of this length that begin in each frame."""
    first = np.repeat(np.arange(num_frames), 20)
    frames = [np.arange(f, min(num_frames, f + length)) for f in first.tolist()]
    count = sum(map(len, frames))
    return Tracks(
        num_frames=num_frames,
        width=64,
        height=64,
        offsets=np.cumsum([0, *map(len, frames)]).astype(np.int64),
        frame=np.concatenate(frames).astype(np.int32),
        xy=np.zeros((count, 2), np.float32),
        sigma=np.zeros(count, np.float32),
        confirmed=np.zeros(count, np.bool_),
    )


def test_frames_with_short_tracks_are_fast() -> None:
    assert fast_frames(tracks_of_lengths(6)).all()
    assert not fast_frames(tracks_of_lengths(40)).any()


def test_frames_after_the_last_image_are_not_fast() -> None:
    images = np.arange(0, 60, 8, dtype=np.int32)
    assert not fast_frames(tracks_of_lengths(40).keep_frames(images)).any()


def test_drive_with_evenly_short_tracks_is_not_fast() -> None:
    """On a road at ten frames per second, about a seventh of the tracks are long."""
    short, long = tracks_of_lengths(6, 160), tracks_of_lengths(40, 160)
    middle = np.arange(50, 110, dtype=np.int32)
    drive = Tracks.concatenate(long, *[short] * 28).subsample_frames(middle)
    assert not fast_frames(drive).any()
    # With a turn, the whole stretch is fast.
    turn = short.keep_tracks(abs(short.frame[short.offsets[:-1]] - 80) < 10)
    assert fast_frames(Tracks.concatenate(drive, *[turn.subsample_frames(middle)] * 40)).all()

"""Streams that show an existing frame again instead of coding a new one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import Encode, make_frames
from ivf_files import with_repeats

from colmap_av1 import MatchOptions, match
from colmap_av1.motion.reading import first_showings
from colmap_av1.options import ReadOptions
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.tracks.video_tracks import TrackedVideo, VideoSource, track_video
from colmap_av1.util.run_context import RunContext
from colmap_av1.video.decoding import decode_frames
from colmap_av1.video.facts import read_video

NUM_FRAMES = 20


@pytest.fixture(scope="module")
def videos(encode: Encode, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """A clip, and the same clip with frames shown again at once, later, and at the end."""
    folder = tmp_path_factory.mktemp("repeats")
    clip = encode(make_frames(NUM_FRAMES), folder / "clip.mp4")
    repeats = [(11, 5, 3), (12, 5, 2), (NUM_FRAMES - 1, 5, 4)]
    return [clip, with_repeats(clip, folder / "again.ivf", range(NUM_FRAMES), repeats)]


def tracked(path: Path, frames: np.ndarray | None = None) -> TrackedVideo:
    video = read_video(path)
    return track_video(
        VideoSource(video, video),
        MatchOptions().tracking,
        one_size=True,
        frames=frames,
        context=RunContext(),
    )


def observations(tracks: Tracks, frame: int) -> list[list[float]]:
    return sorted(tracks.xy[tracks.frame == frame].tolist())


def test_repeated_frames_have_the_observations_of_the_first(videos: list[Path]) -> None:
    _, again = videos
    first = first_showings(again, ReadOptions())
    pictures = [picture for _, picture in decode_frames(again)]
    assert len(pictures) == len(first) == NUM_FRAMES + 9
    repeats = np.flatnonzero(first != np.arange(len(first)))
    assert len(repeats) == 9
    for i in repeats:
        np.testing.assert_array_equal(pictures[i], pictures[first[i]])

    plain, found = (tracked(video) for video in videos)
    assert found.tracks.num_frames == len(first)
    for i in repeats:
        assert observations(found.tracks, i) == observations(found.tracks, first[i]) != []
    ordered = np.diff(found.tracks.frame) > 0
    ordered[found.tracks.offsets[1:-1] - 1] = True
    assert ordered.all()
    coded = np.setdiff1d(np.arange(len(first)), repeats).astype(np.int32)
    same = found.tracks.subsample_frames(coded)
    assert abs(same.num_observations / plain.tracks.num_observations - 1) < 0.1
    np.testing.assert_allclose(found.inter_share[coded], plain.inter_share)
    assert (found.inter_share[repeats] > 0.5).all()

    wanted = np.array([repeats[0], repeats[0] + 3, len(first) - 1], dtype=np.int32)
    chosen = tracked(again, wanted).tracks
    assert set(chosen.frame.tolist()) == set(wanted.tolist())


def test_repeated_frames_cause_no_gap(videos: list[Path], tmp_path: Path) -> None:
    report = match(tmp_path / "a.db", videos[1])
    assert report.num_images == NUM_FRAMES + 9
    assert report.links.gaps == ()
    assert not report.warnings

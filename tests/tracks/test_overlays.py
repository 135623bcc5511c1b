from __future__ import annotations

import subprocess
from pathlib import Path

import cv2
import imageio_ffmpeg
import numpy as np
import pytest
from conftest import PROJECT
from hypothesis import given
from hypothesis import strategies as st

import colmap_av1
from colmap_av1.tracks.overlays import remove_overlays
from colmap_av1.tracks.tracks import Tracks

SCENE = PROJECT / "examples" / "scene.mp4"


def make_tracks(paths: list[tuple[int, np.ndarray]], num_frames: int) -> Tracks:
    """Tracks from (first frame, positions [n, 2])."""
    lengths = [len(xy) for _, xy in paths]
    total = sum(lengths)
    return Tracks(
        num_frames=num_frames,
        width=640,
        height=480,
        offsets=np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
        frame=np.concatenate([f + np.arange(len(xy)) for f, xy in paths]).astype(np.int32),
        xy=np.concatenate([xy for _, xy in paths]).astype(np.float32),
        sigma=np.zeros(total, dtype=np.float32),
        confirmed=np.zeros(total, dtype=np.bool_),
    )


def moving(step: float, length: int) -> np.ndarray:
    return 100 + step * np.arange(length)[:, None] * [0.6, 0.8]


@given(
    step=st.floats(0, 20),
    length=st.integers(2, 20),
    num_still=st.integers(1, 4),
    at_rest=st.integers(0, 30),
)
def test_only_still_tracks_in_a_moving_picture_are_removed(
    step: float, length: int, num_still: int, at_rest: int
) -> None:
    still = [(at_rest, np.full((length, 2), 50.0 + i)) for i in range(num_still)]
    others = [(at_rest, moving(step, length)) for _ in range(num_still + 1)]
    # Tracks of the preceding frames, in which the camera does not move.
    resting = [(0, np.full((at_rest, 2), 9.0))] * (at_rest > 1)
    tracks = make_tracks(still + others + resting, at_rest + length)
    kept = remove_overlays(tracks)
    if step * (length - 1) >= 4.01:
        expected = make_tracks(others + resting, at_rest + length)
        np.testing.assert_array_equal(kept.offsets, expected.offsets)
        np.testing.assert_array_equal(kept.xy, expected.xy)
    elif step * (length - 1) < 3.99:
        assert kept is tracks


def test_motion_is_measured_between_kept_frames() -> None:
    """With observations in every fifth frame only, the total motion is the same."""
    paths = [(0, np.full((21, 2), 50.0)), (0, moving(0.25, 21)), (0, moving(0.25, 21))]
    tracks = make_tracks(paths, 21)
    some = tracks.keep_frames(np.arange(0, 21, 5, dtype=np.int32))
    kept = remove_overlays(some)
    assert kept.num_tracks == 2
    np.testing.assert_array_equal(kept.xy, some.xy[5:])


def test_short_tracks_show_that_the_picture_moves() -> None:
    """In distant frames, only the overlay is observed twice."""
    still = [(0, np.full((101, 2), 50.0))] * 3
    tracks = make_tracks([*still, *[(start, moving(2.0, 10)) for start in range(91)]], 101)
    some = tracks.keep_frames(np.arange(0, 101, 25, dtype=np.int32)).keep_long(2)
    is_end = np.zeros(tracks.num_observations, np.bool_)
    is_end[tracks.offsets[:-1]] = is_end[tracks.offsets[1:] - 1] = True
    assert some.num_tracks == 3
    assert remove_overlays(some, tracks.keep_observations(is_end)).num_tracks == 0


def test_no_tracks_remain_no_tracks() -> None:
    none = remove_overlays(Tracks.empty(5, (640, 480)))
    assert none.offsets.tolist() == [0]


@pytest.mark.slow
def test_tracks_on_a_logo_are_removed(tmp_path: Path) -> None:
    logo = np.zeros((80, 160, 4), dtype=np.uint8)
    cv2.putText(logo, "LOGO", (8, 60), cv2.FONT_HERSHEY_SIMPLEX, 1.8, (255, 255, 255, 255), 8)
    cv2.imwrite(str(tmp_path / "logo.png"), logo)
    clip = tmp_path / "clip.mp4"
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", str(SCENE), "-i"]
    command += [str(tmp_path / "logo.png"), "-filter_complex", "overlay=20:20", "-frames:v", "24"]
    command += ["-c:v", "libaom-av1", "-usage", "realtime", "-cpu-used", "8", "-lag-in-frames", "0"]
    subprocess.run([*command, "-crf", "20", "-b:v", "0", str(clip)], check=True)
    tracks = colmap_av1.build_tracks(colmap_av1.read_motion(clip))
    kept = remove_overlays(tracks)

    def still_in_logo(t: Tracks) -> int:
        begin, end = t.xy[t.offsets[:-1]], t.xy[t.offsets[1:] - 1]
        inside = np.all((begin > 28) & (begin < [172, 92]), axis=1)
        return int(np.count_nonzero(inside & (np.abs(end - begin).max(axis=1) <= 0.05)))

    assert still_in_logo(tracks) > 20
    # A few tracks on the logo jitter slightly.
    assert still_in_logo(kept) < 0.15 * still_in_logo(tracks)
    num_left_out = tracks.num_tracks - kept.num_tracks
    assert num_left_out < 2 * still_in_logo(tracks)

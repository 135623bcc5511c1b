"""Rolling shutter: the read-out time is estimated from tracks, and tracks are corrected."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import Ffmpeg
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from colmap_av1 import (
    CameraOptions,
    ImageOptions,
    MatchOptions,
    OptionError,
    ReconstructOptions,
    TriangulateOptions,
    match,
    reconstruct,
)
from colmap_av1.cli import main
from colmap_av1.images.orientation import ShownImages
from colmap_av1.matching.shutter import of_video
from colmap_av1.matching.shutter.correct import correct_rolling_shutter, rows_down
from colmap_av1.matching.shutter.estimate import ReadOut, estimate_read_out
from colmap_av1.tracks.shutter import correct_tracks, velocities
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.tracks.video_tracks import TrackedVideo, VideoSource
from colmap_av1.util.run_context import RunContext
from colmap_av1.video.display import Display

WIDTH, HEIGHT, FOCAL, NUM_FRAMES, RATE = 640, 480, 560.0, 60, 30.0
POINTS = np.random.default_rng(0).uniform([-9, -5, 8], [9, 5, 18], (900, 3))


def seen_at(frame: NDArray[np.float64]) -> NDArray[np.float64]:
    """Projections [n, 2] of the points at times [n] in frames, from a hand-held camera."""
    t = np.broadcast_to(frame, len(POINTS)) / RATE
    centre = np.column_stack([1.5 * t, 0.1 * np.sin(7 * t), 0.1 * np.sin(5 * t)])
    turn = np.column_stack(
        [0.03 * np.sin(9 * t), 0.05 * np.sin(6 * t) + 0.01 * np.sin(19 * t), 0.01 * np.sin(8 * t)]
    )
    local = Rotation.from_rotvec(turn).apply(POINTS - centre)
    return FOCAL * local[:, :2] / local[:, 2:] + np.array([WIDTH, HEIGHT]) / 2


def tracks_of(read_out: float, noise: float = 0.1, across: bool = False) -> Tracks:
    """Tracks with a read-out time in frames, by columns from the left if `across`, else by rows."""
    axis, length = (0, WIDTH) if across else (1, HEIGHT)
    xy = np.empty((len(POINTS), NUM_FRAMES, 2))
    for frame in range(NUM_FRAMES):
        at = np.full(len(POINTS), float(frame))
        for _ in range(4):  # the time at which the row that shows the point is read
            at = frame + read_out * (seen_at(at)[:, axis] / length - 0.5)
        xy[:, frame] = seen_at(at)
    xy += np.random.default_rng(1).normal(0, noise, xy.shape)
    inside = ((xy > 0) & (xy < [WIDTH, HEIGHT])).all(axis=(1, 2))
    count = int(inside.sum())
    return Tracks(
        num_frames=NUM_FRAMES,
        width=WIDTH,
        height=HEIGHT,
        offsets=np.arange(count + 1, dtype=np.int64) * NUM_FRAMES,
        frame=np.tile(np.arange(NUM_FRAMES), count).astype(np.int32),
        xy=xy[inside].reshape(-1, 2).astype(np.float32),
        sigma=np.zeros(count * NUM_FRAMES, np.float32),
        confirmed=np.zeros(count * NUM_FRAMES, np.bool_),
    )


@pytest.mark.parametrize(("read_out", "focal"), [(0.15, FOCAL), (-0.8, FOCAL), (0.45, None)])
def test_read_out_time_is_estimated(read_out: float, focal: float | None) -> None:
    found = estimate_read_out(tracks_of(read_out), (0, 1), focal)
    assert isinstance(found, ReadOut)
    assert found.frames == pytest.approx(read_out, rel=0.1, abs=0.01)


def test_no_read_out_time_is_found_without_a_rolling_shutter() -> None:
    tracks = tracks_of(0.0)
    assert isinstance(estimate_read_out(tracks, (0, 1), FOCAL), str)
    still = replace(tracks, xy=np.repeat(tracks.xy[::NUM_FRAMES], NUM_FRAMES, axis=0))
    assert isinstance(estimate_read_out(still, (0, 1), FOCAL), str)
    few = replace(tracks, num_frames=4, frame=tracks.frame[:4], xy=tracks.xy[:4])
    few = replace(few, offsets=np.array([0, 4]), sigma=few.sigma[:4], confirmed=few.confirmed[:4])
    assert isinstance(estimate_read_out(few, (0, 1), FOCAL), str)


@pytest.mark.parametrize("across", [False, True])
def test_tracks_are_corrected_to_the_middle_of_the_read_out(across: bool) -> None:
    seen, exact = tracks_of(0.5, 0.0, across), tracks_of(0.0, 0.0)
    assert len(seen.xy) == len(exact.xy)
    corrected = correct_tracks(seen, 0.5, (1, 0) if across else (0, 1))
    before, after = (np.linalg.norm(t.xy - exact.xy, axis=1) for t in (seen, corrected))
    assert np.sqrt(np.mean(before**2)) > 0.7
    assert np.sqrt(np.mean(after**2)) < 0.15 * np.sqrt(np.mean(before**2))


def test_velocities_at_the_ends_of_tracks() -> None:
    frame = np.array([3, 0, 1, 2, 3, 4, 5, 7, 8], np.int32)
    offsets = np.array([0, 1, 7, 9])
    x = np.concatenate([[5], 100 * np.arange(6) ** 2 / 25 + 40, [600, 606]])
    tracks = Tracks(
        num_frames=9,
        width=WIDTH,
        height=HEIGHT,
        offsets=offsets,
        frame=frame,
        xy=np.column_stack([x, np.full(9, 300.0)]).astype(np.float32),
        sigma=np.zeros(9, np.float32),
        confirmed=np.zeros(9, np.bool_),
    )
    exact = [
        0,
        4,
        8,
        16,
        24,
        32,
        36,
        6,
        6,
    ]  # 8 t inside the track, one-sided differences at its ends
    np.testing.assert_allclose(velocities(tracks)[:, 0], exact, atol=1e-3)
    np.testing.assert_allclose(velocities(tracks)[:, 1], 0, atol=1e-3)


def test_rows_follow_the_orientation_of_the_sensor() -> None:
    assert rows_down(Display(), (640, 480)) == (0, 1)
    # A program rotated the pictures in an unknown direction.
    for display in (Display(), Display(pixel_aspect=0.9), Display(crop=(0, 0, 0, 8))):
        assert rows_down(display, (480, 640)) == (1, 0)
    assert rows_down(Display(turn=((0, -1), (1, 0))), (480, 640)) == (-1, 0)
    assert rows_down(Display(turn=((-1, 0), (0, -1))), (640, 480)) == (0, -1)


def test_rolling_shutter_option() -> None:
    tracks = tracks_of(0.45)
    video = TrackedVideo(tracks, NUM_FRAMES, np.ones(NUM_FRAMES, np.float32), ())
    shown = ShownImages(Display(), (WIDTH, HEIGHT), (WIDTH, HEIGHT))
    for wanted, found in (("none", None), ("15", 15.0), ("-7.5", -7.5)):
        camera = CameraOptions(rolling_shutter=wanted)
        corrected = correct_rolling_shutter(video, shown, RATE, camera, RunContext())
        assert corrected.read_out == pytest.approx(found)
        assert (corrected.tracks is tracks) == (found is None)
        assert not corrected.warnings
    estimated = CameraOptions(
        rolling_shutter="estimate",
        camera_model="SIMPLE_PINHOLE",
        camera_params=f"{FOCAL},{WIDTH / 2},{HEIGHT / 2}",
    )
    corrected = correct_rolling_shutter(video, shown, RATE, estimated, RunContext())
    assert corrected.read_out == pytest.approx(15, abs=1.5)
    fisheye = CameraOptions(rolling_shutter="estimate", camera_model="OPENCV_FISHEYE")
    for rate, camera, word in ((None, estimated, "rate"), (RATE, fisheye, "fisheye")):
        unknown = correct_rolling_shutter(video, shown, rate, camera, RunContext())
        assert unknown.tracks is tracks
        assert unknown.read_out is None
        assert word in unknown.warnings[0]
    for wrong in ("soon", "101", "nan"):
        with pytest.raises(OptionError, match="milliseconds"):
            CameraOptions(rolling_shutter=wrong)


def test_match_command_reports_the_rolling_shutter(
    clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--video", str(clip), "--rolling_shutter=12.5"]
    assert main(["match", "--database", str(tmp_path / "a.db"), *words]) == 0
    printed = capsys.readouterr().out
    assert "rolling shutter\t12.5 ms" in printed
    report = match(tmp_path / "b.db", clip)
    assert report.read_outs == (None,)


def test_info_command_reports_the_read_out_time(
    clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["info", "--video", str(clip), "--report_json", str(tmp_path / "a.json")]
    assert main(words) == 0
    without = capsys.readouterr().out
    assert "rolling shutter" not in without
    words += ["--rolling_shutter", "estimate"]
    assert main(words) == 0
    printed = capsys.readouterr().out
    assert printed.startswith(without)
    assert printed[len(without) :].startswith("rolling shutter\t")

    def track(source: VideoSource, *_: object, **__: object) -> TrackedVideo:
        tracks = tracks_of(0.45)
        return TrackedVideo(tracks, NUM_FRAMES, np.ones(NUM_FRAMES, np.float32), ())

    monkeypatch.setattr(of_video, "track_video", track)
    found = of_video.estimate_video_read_out(clip)
    assert not isinstance(found, str)
    # The clip has 25 frames per second.
    assert found.milliseconds == pytest.approx(0.45 * 40, rel=0.1)
    assert abs(found.milliseconds - 0.45 * 40) < found.error < 4
    assert main(words) == 0
    row = capsys.readouterr().out.splitlines()[-1]
    assert row.startswith(f"rolling shutter\t{found.milliseconds:.1f} +- {found.error:.1f} ms")
    written = json.loads((tmp_path / "a.json").read_text())["read_out"]
    assert written == {"milliseconds": found.milliseconds, "error": found.error}


def test_poses_are_unchanged_if_no_read_out_time_is_found(ffmpeg: Ffmpeg, tmp_path: Path) -> None:
    scene = Path(__file__).resolve().parents[2] / "examples" / "scene.mp4"
    video = ffmpeg("-i", scene, "-frames:v", "8", "-c", "copy", tmp_path / "short.mp4")
    found = []
    for wanted in ("none", "estimate"):
        camera = CameraOptions(
            camera_model="PINHOLE", camera_params="520,520,320,180", rolling_shutter=wanted
        )
        options = ReconstructOptions(
            match=MatchOptions(images=ImageOptions(every=1), camera=camera),
            triangulate=TriangulateOptions(points="survey"),
            moving="keep",
        )
        report = reconstruct(video, tmp_path / wanted, options=options)
        assert report.read_outs == (None,)
        found.append((report.output / "sparse" / "0" / "images.bin").read_bytes())
    assert found[0] == found[1]

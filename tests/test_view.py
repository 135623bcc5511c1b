from __future__ import annotations

import os
import shutil
import sqlite3
import subprocess
import sys
import urllib.request
from collections.abc import Callable
from pathlib import Path

import av
import cv2
import numpy as np
import pycolmap
import pytest
from conftest import SHARED, Encode

from colmap_av1 import view
from colmap_av1.cli import main
from colmap_av1.errors import (
    ColmapAv1Error,
    LimitError,
    ModelError,
    OptionError,
    VideoError,
    WriteError,
)
from colmap_av1.match import match
from colmap_av1.motion.info import read_info
from colmap_av1.options import DensityOptions, MatchOptions, TrackOptions, ViewOptions
from colmap_av1.video.decoding import decode_frames
from colmap_av1.view import model as model_view


@pytest.fixture(scope="session")
def panning(encode: Encode, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A clip whose upper half moves right by 3 pixels per frame, and whose lower half left."""
    rng = np.random.default_rng(1)
    texture = cv2.resize(rng.integers(0, 256, (40, 160, 3), dtype=np.uint8), (640, 160))
    halves = [
        np.roll(texture, [3 * i, -3 * i][k], axis=1)[:, :256] for i in range(10) for k in (0, 1)
    ]
    frames = np.array(halves).reshape(10, 2 * 160, 256, 3)
    return encode(frames, tmp_path_factory.mktemp("view") / "panning.mp4")


def hue_of(picture: np.ndarray) -> np.ndarray:
    """Hues in degrees of the coloured pixels."""
    hsv = cv2.cvtColor(picture, cv2.COLOR_BGR2HSV).reshape(-1, 3)
    return hsv[hsv[:, 1] > 60, 0] * 2.0


def test_motion_is_coloured_by_direction(panning: Path, tmp_path: Path) -> None:
    output = tmp_path / "motion"
    options = ViewOptions(draw="motion")
    # The encoder uses large blocks that refer to the first frame.
    tracks = TrackOptions(max_block_area=None, max_uncoded_block_area=None, max_interval=None)
    assert view.view_video(panning, output, options=options, tracks=tracks) == 10
    names = sorted(p.name for p in output.iterdir())
    assert names == [f"frame_{i:06d}.png" for i in range(10)]
    picture = cv2.imread(str(output / "frame_000005.png"))
    assert picture.shape == (320, 256, 3)
    upper, lower = hue_of(picture[64:144, 64:]), hue_of(picture[176:300, 64:])
    assert len(upper) > 1000
    assert len(lower) > 1000
    # Red is motion to the right, the opposite hue to the left.
    assert np.median(np.minimum(upper, 360 - upper)) < 20
    assert abs(np.median(lower) - 180) < 20


def test_tails_show_past_positions_of_tracks(panning: Path, tmp_path: Path) -> None:
    view.view_video(panning, tmp_path / "t", options=ViewOptions(draw="tracks", tail=6))
    first = cv2.imread(str(tmp_path / "t" / "frame_000000.png"))
    later = cv2.imread(str(tmp_path / "t" / "frame_000007.png"))
    plain = next(image for i, image in decode_frames(panning) if i == 7)
    changed = np.any(later != plain, axis=2)
    # Tails of 6 frames at 3 pixels per frame.
    drawn = cv2.connectedComponentsWithStats(changed.astype(np.uint8))[2][1:]
    assert np.median(drawn[:, cv2.CC_STAT_WIDTH]) >= 15
    assert first.shape == later.shape


def test_mp4_shows_motion_and_tracks_and_is_reproducible(panning: Path, tmp_path: Path) -> None:
    for name in ("a.mp4", "b.mp4"):
        assert view.view_video(panning, tmp_path / name) == 10
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()
    with av.open(str(tmp_path / "a.mp4")) as container:
        pictures = list(container.decode(video=0))
        assert float(container.streams.video[0].average_rate or 0) == 25
    assert [(p.width, p.height) for p in pictures] == [(512, 320)] * 10


def test_mp4_does_not_depend_on_uninitialized_memory(clip: Path, tmp_path: Path) -> None:
    written = []
    for number in ("1", "165"):
        output = tmp_path / f"{number}.mp4"
        words = [*(sys.executable, "-m", "colmap_av1", "view", "--video", str(clip), "--quiet")]
        # glibc fills allocated memory with this number.
        environment = os.environ | {"MALLOC_PERTURB_": number}
        words += ["--output", str(output)]
        subprocess.run(words, check=True, env=environment, cwd=tmp_path)
        written.append(output.read_bytes())
    assert written[0] == written[1]


@pytest.mark.parametrize("when", ["tracks", "pictures"])
def test_changed_video_is_refused(panning: Path, tmp_path: Path, when: str) -> None:
    video = tmp_path / "v.mp4"
    shutil.copyfile(panning, video)

    def change(stage: str, done: int, total: int | None) -> None:
        if stage == when and done == 4:
            video.touch()

    with pytest.raises(VideoError, match="changed"):
        view.view_video(video, tmp_path / "drawn.mp4", progress=change)
    assert list(tmp_path.iterdir()) == [video]


def test_odd_sizes_are_padded(encode: Encode, tmp_path: Path) -> None:
    frames = np.random.default_rng(0).integers(0, 256, (4, 63, 95, 3), dtype=np.uint8)
    clip = encode(frames, tmp_path / "odd.mp4")
    view.view_video(clip, tmp_path / "odd_view.mp4", options=ViewOptions(draw="motion"))
    with av.open(str(tmp_path / "odd_view.mp4")) as container:
        assert {(p.width, p.height) for p in container.decode(video=0)} == {(96, 64)}


@pytest.mark.parametrize(
    ("output", "message", "error"),
    [("x.gif", r"\.mp4", OptionError), ("missing/x.mp4", "missing", WriteError)],
)
def test_invalid_outputs_are_refused_and_leave_nothing(
    panning: Path, tmp_path: Path, output: str, message: str, error: type[ColmapAv1Error]
) -> None:
    with pytest.raises(error, match=message):
        view.view_video(panning, tmp_path / output)
    assert list(tmp_path.iterdir()) == []


def test_matches_are_drawn_between_their_keypoints(clip: Path, tmp_path: Path) -> None:
    options = MatchOptions(density=DensityOptions(preset="dense"))
    match(tmp_path / "a.db", clip, image_path=tmp_path / "frames", options=options)
    before = (tmp_path / "a.db").read_bytes()
    for path in (tmp_path / "frames").iterdir():
        cv2.imwrite(str(path), np.zeros((128, 192, 3), np.uint8))
    names = ["frame_000002.png", "frame_000007.png"]
    words = ["view", "--database", str(tmp_path / "a.db"), "--image_path", str(tmp_path / "frames")]
    output = str(tmp_path / "pair.png")
    assert main([*words, "--pair", *names, "--output", output]) == 0
    assert (tmp_path / "a.db").read_bytes() == before
    # Wide pictures are stacked, and lines run from the upper to the lower one.
    lit = cv2.imread(output).any(axis=2)
    assert lit.shape == (256, 192)
    assert lit[120:136].any(axis=1).all()
    with sqlite3.connect(f"file:{tmp_path / 'a.db'}?mode=ro", uri=True) as connection:
        rows = connection.execute("SELECT data FROM keypoints WHERE image_id IN (3, 8)").fetchall()
    for (data,), top in zip(rows, (0, 128), strict=True):
        xy = np.frombuffer(data, "<f4").reshape(-1, 2)
        near = np.zeros((128, 192), dtype=bool)
        near[np.floor(xy[:, 1]).astype(int), np.floor(xy[:, 0]).astype(int)] = True
        # Dots are at the keypoints, and lines start there.
        assert (lit[top : top + 128] & near).sum() > 100
    swapped = view.view_database(tmp_path / "a.db", tmp_path / "frames", names[::-1])
    assert not np.array_equal(swapped.any(axis=2), lit)


@pytest.mark.parametrize(
    ("pair", "message"),
    [
        (["x.png", "frame_000000.png"], r"x\.png"),
        (["frame_000000.png", "frame_000001.png"], "missing"),
    ],
)
def test_invalid_pairs_are_refused(
    clip: Path, tmp_path: Path, pair: list[str], message: str
) -> None:
    match(tmp_path / "a.db", clip)
    with pytest.raises(ColmapAv1Error, match=message):
        view.view_database(tmp_path / "a.db", tmp_path, pair)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 6, 300
    reconstruction = pycolmap.synthesize_dataset(options)
    for point in reconstruction.points3D.values():
        point.color = np.array([10, 200, 30], dtype=np.uint8)
    path = tmp_path_factory.mktemp("model")
    reconstruction.write(path)
    return path


def test_model_shows_coloured_points_and_the_camera_path(model: Path, tmp_path: Path) -> None:
    assert main(["view", "--model", str(model), "--output", str(tmp_path / "m.png")]) == 0
    picture = cv2.imread(str(tmp_path / "m.png"))
    assert picture.shape == (1200, 1600, 3)
    for panel in (
        picture[:600, :800],
        picture[:600, 800:],
        picture[600:, :800],
        picture[600:, 800:],
    ):
        assert np.count_nonzero(np.all(panel == (30, 200, 10), axis=2)) > 200
        assert np.count_nonzero(np.all(panel == model_view._PATH_COLOUR, axis=2)) > 50


def test_model_is_served_to_a_browser(model: Path) -> None:
    pytest.importorskip("viser")
    server = view.serve_model(model, port=18080)
    try:
        with urllib.request.urlopen("http://127.0.0.1:18080", timeout=10) as page:
            assert page.status == 200
        with pytest.raises(OptionError, match="18080"):
            view.serve_model(model, port=18080)
    finally:
        server.stop()


def test_view_names_missing_arguments(
    model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["view", "--model", str(model)]) == 2
    assert "--output" in capsys.readouterr().err
    for port in (0, 65536):
        with pytest.raises(OptionError, match=str(port)):
            view.serve_model(model, port=port)
    with pytest.raises(ModelError, match="no COLMAP model"):
        view.view_model(tmp_path)
    with pytest.raises(OptionError, match=r"\.png"):
        view.write_picture(view.view_model(model), tmp_path / "m.tiff")


@pytest.mark.shared
@pytest.mark.parametrize("read", [read_info, lambda video: view.view_video(video, "drawn.mp4")])
def test_too_large_frames_are_refused_before_decoding(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, read: Callable[[Path], object]
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(LimitError, match="limit"):
        read(SHARED / "conformance" / "bad" / "huge_dimensions.ivf")
    assert list(tmp_path.iterdir()) == []

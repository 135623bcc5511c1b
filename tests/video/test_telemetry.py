"""Positions in the metadata of a video are copied to its converted stream."""

from __future__ import annotations

import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
from conftest import Encode, Ffmpeg, make_frames
from telemetry import dji_text, gps5, grav, with_gpmf

from colmap_av1.cli import main
from colmap_av1.options import EncodeOptions
from colmap_av1.video.container import read_file
from colmap_av1.video.encode import encode as encode_video
from colmap_av1.video.encode import stream_of
from colmap_av1.video.metadata.positions import read_positions

PLACES = np.array([[59.33 + k * 1e-5, 18.07 - k * 2e-5, 20 + k * 0.1] for k in range(10)])
FAST = EncodeOptions(speed=9)
APPLE = "com.apple.quicktime.location.ISO6709=+59.3300+018.0700+020.000/"


@pytest.fixture(scope="module")
def filmed(
    clip: Path, encode: Encode, ffmpeg: Ffmpeg, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Path]:
    """Clips with the telemetry of a GoPro, a DJI drone and a phone."""
    folder = tmp_path_factory.mktemp("filmed")
    phone = encode(make_frames(12, 96, 64), folder / "h264.mp4", "-c:v", "libx264")
    subtitles = folder / "positions.srt"
    subtitles.write_text(dji_text(PLACES, 25))
    tagged = ("-c", "copy", "-movflags", "use_metadata_tags", "-metadata", APPLE)
    down = np.tile([0.0, 1.0, 0.0], (5, 1))
    return {
        "gopro": with_gpmf(clip, folder / "gopro.mp4", [(0.4, gps5(PLACES) + grav(down))]),
        "dji": ffmpeg(
            *("-i", phone, "-i", subtitles, "-map", "0:v", "-map", "1", "-c:v", "copy"),
            *("-c:s", "mov_text", folder / "dji.mp4"),
        ),
        "phone": ffmpeg("-i", phone, *tagged, folder / "phone.mp4"),
    }


@pytest.mark.parametrize(
    ("camera", "ending"),
    [("gopro", "mp4"), ("dji", "mp4"), ("dji", "mkv"), ("phone", "mp4"), ("phone", "mkv")],
)
def test_positions_are_copied(
    filmed: dict[str, Path], tmp_path: Path, camera: str, ending: str
) -> None:
    source, output = filmed[camera], tmp_path / f"stream.{ending}"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        encode_video(source, output, options=FAST)
    before, after = (read_positions(read_file(path)) for path in (source, output))
    assert before is not None
    assert after is not None
    if camera == "dji":  # also with frames coded out of order
        np.testing.assert_allclose(before.times, np.arange(10) / 25, atol=1e-3)
    np.testing.assert_allclose(after.times, before.times, atol=1e-3)
    np.testing.assert_array_equal(after.places, before.places)
    np.testing.assert_array_equal(after.gravity, before.gravity)
    assert after.place == before.place
    # The tag of the encoder is written, too.
    assert dict(read_file(output).tags)["comment"].startswith("colmap-av1 encoder=")


@pytest.mark.parametrize(
    ("camera", "ending"), [("gopro", "mkv"), ("gopro", "webm"), ("dji", "webm"), ("phone", "ivf")]
)
def test_container_without_positions_is_reported(
    filmed: dict[str, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    camera: str,
    ending: str,
) -> None:
    source, output = filmed[camera], tmp_path / f"stream.{ending}"
    words = ["encode", "--video", str(source), "--output", str(output), "--speed", "9"]
    assert main([*words, "--quiet"]) == 0
    message = capsys.readouterr().err.strip()
    assert message.endswith(
        f"{output} does not contain the positions of {source}: give an output that ends in .mp4, "
        "or give later commands the video itself"
    )
    assert "\n" not in message
    assert read_positions(read_file(output)) is None


def test_srt_file_next_to_the_video_is_named(
    filmed: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    video, output = tmp_path / "DJI_0001.mp4", tmp_path / "stream.mp4"
    shutil.copyfile(filmed["phone"], video)
    video.with_suffix(".SRT").write_text(dji_text(PLACES, 25))
    words = ["encode", "--video", str(video), "--output", str(output), "--speed", "9", "--quiet"]
    assert main(words) == 0
    message = capsys.readouterr().err.strip()
    assert message.endswith(
        f"{video.with_suffix('.SRT')} holds the positions of {video}, which the stream lacks: copy "
        f"it to {output.with_suffix('.srt')}, too"
    )
    # Following the message makes the positions available.
    shutil.copyfile(video.with_suffix(".SRT"), output.with_suffix(".srt"))
    found = read_positions(read_file(output))
    assert found is not None
    np.testing.assert_allclose(found.places, PLACES, atol=1e-7)


def test_kept_stream_causes_no_warning(filmed: dict[str, Path], tmp_path: Path) -> None:
    """With a kept stream the video itself is given, so positions are read from it."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        made = stream_of(filmed["dji"], tmp_path / "kept.mkv", options=FAST)
    assert read_positions(read_file(made.output)) is None

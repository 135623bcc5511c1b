"""Focal lengths in container metadata, compared with those estimated from tracks."""

from __future__ import annotations

from pathlib import Path

import pytest
from conftest import Ffmpeg

from colmap_av1 import CameraOptions, MatchOptions, match
from colmap_av1.database.reading import read_cameras
from colmap_av1.matching.cameras import _initial_focal_length
from colmap_av1.video.metadata.lens import container_focal_length, implausible_focal_length

TAG = "com.apple.quicktime.camera.focal_length.35mm_equivalent"


@pytest.mark.parametrize(
    ("value", "focal_length"),
    [("26", 1323.8), ("26.5", 1349.2), ("0", None), ("9999", None), ("wide", None), ("", None)],
)
def test_35mm_equivalent_is_converted_to_pixels(value: str, focal_length: float | None) -> None:
    found = container_focal_length(((TAG, value),), (1920, 1080))
    assert found == (None if focal_length is None else pytest.approx(focal_length, abs=0.1))
    assert container_focal_length((("comment", value),), (1920, 1080)) is None


@pytest.mark.parametrize("value", ["0", "10000", "-26", "wide\x1b[2J"])
def test_implausible_focal_length_is_reported(
    clip: Path, ffmpeg: Ffmpeg, tmp_path: Path, value: str
) -> None:
    assert implausible_focal_length(((TAG, "26"),)) is None
    assert implausible_focal_length((("comment", value),)) is None
    tags = ["-metadata", f"{TAG}={value}", "-metadata", "location=+95.0000+018.0686/"]
    how = ["-i", clip, "-c", "copy", "-movflags", "use_metadata_tags", *tags]
    report = match(tmp_path / "a.db", ffmpeg(*how, tmp_path / "phone.mp4"))
    place, lens = report.warnings
    assert "+95.0000+018.0686/" in place
    assert value[:4] in lens
    assert lens.isprintable()
    (camera,) = read_cameras(tmp_path / "a.db").values()
    assert not camera.has_prior_focal_length


def test_estimate_from_tracks_overrides_the_container() -> None:
    assert _initial_focal_length(1400.0, 1300.0, None) == (1400.0, [])
    used, (warning,) = _initial_focal_length(1800.0, 1300.0, None)
    assert used == 1800.0
    assert "1300 px" in warning
    used, (warning,) = _initial_focal_length(None, 1300.0, "RADIAL")
    assert used == 1300.0
    assert "1300 px" in warning
    assert _initial_focal_length(None, 1300.0, "OPENCV_FISHEYE") == (None, [])
    assert _initial_focal_length(None, None, None) == (None, [])


def test_container_focal_length_is_used_if_motion_gives_none(
    clip: Path, ffmpeg: Ffmpeg, tmp_path: Path
) -> None:
    tagged = ffmpeg(
        *("-i", clip, "-c", "copy", "-movflags", "use_metadata_tags"),
        *("-metadata", f"{TAG}=30", tmp_path / "phone.mp4"),
    )
    report = match(tmp_path / "a.db", tagged)
    assert report.focal_length is None  # none from the tracks
    assert any("container" in warning for warning in report.warnings)
    (camera,) = read_cameras(tmp_path / "a.db").values()
    assert camera.mean_focal_length() == pytest.approx(30 / 43.267 * 230.76, abs=0.1)
    assert camera.has_prior_focal_length
    options = MatchOptions(
        camera=CameraOptions(camera_model="SIMPLE_PINHOLE", camera_params="200,96,64")
    )
    report = match(tmp_path / "b.db", tagged, options=options)
    assert not any("container" in warning for warning in report.warnings)
    (camera,) = read_cameras(tmp_path / "b.db").values()
    assert camera.mean_focal_length() == 200

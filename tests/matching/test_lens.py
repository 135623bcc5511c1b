"""The focal length that a container says, beside that of the tracks."""

from __future__ import annotations

from pathlib import Path

import pytest
from conftest import Ffmpeg

from colmap_av1 import CameraOptions, MatchOptions, match
from colmap_av1.database.reading import read_cameras
from colmap_av1.matching.cameras import Shape, _initial_focal_length
from colmap_av1.video.metadata.lens import container_focal_length, implausible_focal_length

TAG = "com.apple.quicktime.camera.focal_length.35mm_equivalent"


@pytest.mark.parametrize(
    ("said", "focal_length"),
    [("26", 1323.8), ("26.5", 1349.2), ("0", None), ("9999", None), ("wide", None), ("", None)],
)
def test_equivalent_of_film(said: str, focal_length: float | None) -> None:
    found = container_focal_length(((TAG, said),), (1920, 1080))
    assert found == (None if focal_length is None else pytest.approx(focal_length, abs=0.1))
    assert container_focal_length((("comment", said),), (1920, 1080)) is None


@pytest.mark.parametrize("said", ["0", "10000", "-26", "wide\x1b[2J"])
def test_a_focal_length_of_no_lens_is_told(
    clip: Path, ffmpeg: Ffmpeg, tmp_path: Path, said: str
) -> None:
    assert implausible_focal_length(((TAG, "26"),)) is None
    assert implausible_focal_length((("comment", said),)) is None
    tags = ["-metadata", f"{TAG}={said}", "-metadata", "location=+95.0000+018.0686/"]
    how = ["-i", clip, "-c", "copy", "-movflags", "use_metadata_tags", *tags]
    report = match(tmp_path / "a.db", ffmpeg(*how, tmp_path / "phone.mp4"))
    place, lens = report.warnings
    assert "+95.0000+018.0686/" in place
    assert said[:4] in lens
    assert lens.isprintable()
    (camera,) = read_cameras(tmp_path / "a.db").values()
    assert not camera.has_prior_focal_length


def test_tracks_go_before_the_container() -> None:
    shape = Shape((1920, 1080), 1.0, 1300.0)
    assert _initial_focal_length(1400.0, shape, None) == (1400.0, [])
    used, (warning,) = _initial_focal_length(1800.0, shape, None)
    assert used == 1800.0
    assert "1300 px" in warning
    used, (warning,) = _initial_focal_length(None, shape, "RADIAL")
    assert used == 1300.0
    assert "1300 px" in warning
    assert _initial_focal_length(None, shape, "OPENCV_FISHEYE") == (None, [])
    assert _initial_focal_length(None, Shape((1920, 1080), 1.0, None), None) == (None, [])


def test_where_motion_does_not_determine_it(clip: Path, ffmpeg: Ffmpeg, tmp_path: Path) -> None:
    tagged = ffmpeg(
        *("-i", clip, "-c", "copy", "-movflags", "use_metadata_tags"),
        *("-metadata", f"{TAG}=30", tmp_path / "phone.mp4"),
    )
    report = match(tmp_path / "a.db", tagged)
    assert report.focal_length is None  # by the tracks
    assert any("container" in words for words in report.warnings)
    (camera,) = read_cameras(tmp_path / "a.db").values()
    assert camera.mean_focal_length() == pytest.approx(30 / 43.267 * 230.76, abs=0.1)
    assert camera.has_prior_focal_length
    options = MatchOptions(
        camera=CameraOptions(camera_model="SIMPLE_PINHOLE", camera_params="200,96,64")
    )
    report = match(tmp_path / "b.db", tagged, options=options)
    assert not any("container says" in words for words in report.warnings)
    (camera,) = read_cameras(tmp_path / "b.db").values()
    assert camera.mean_focal_length() == 200

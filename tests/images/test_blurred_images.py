"""A warning is given if all images are blurred."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import PROJECT, QUICK_AV1, SHARED, Encode
from numpy.typing import NDArray

from colmap_av1.images.blur import blur_warning
from colmap_av1.match import match
from colmap_av1.options import ImageOptions, MatchOptions
from colmap_av1.video.decoding import decode_frames

SCENE = PROJECT / "examples" / "scene.mp4"


def gaussian(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), 8.0), np.uint8)


@pytest.fixture(scope="module")
def sharp() -> list[NDArray[np.uint8]]:
    return [picture for index, picture in decode_frames(SCENE) if index < 12]


def test_sharp_images_cause_no_warning_at_any_size(
    sharp: list[NDArray[np.uint8]], tmp_path: Path
) -> None:
    files = [tmp_path / "a.png", tmp_path / "b.png"]
    for scale in (0.5, 1.0, 4.0):
        for file, picture in zip(files, sharp, strict=False):
            cv2.imwrite(str(file), cv2.resize(picture, None, fx=scale, fy=scale))
        assert blur_warning(files) is None


def test_blurred_images_are_reported(sharp: list[NDArray[np.uint8]], tmp_path: Path) -> None:
    files = [tmp_path / f"{index}.png" for index in range(len(sharp))]
    for file, picture in zip(files, sharp, strict=True):
        cv2.imwrite(str(file), gaussian(picture))
    warning = blur_warning(files)
    assert warning is not None
    assert warning.startswith(f"{tmp_path}: the images are blurred")
    # A single blurred image is not reported.
    for file, picture in zip(files[1:], sharp[1:], strict=True):
        cv2.imwrite(str(file), picture)
    assert blur_warning(files) is None


def along_a_line(picture: NDArray[np.uint8], length: int, radians: float) -> NDArray[np.uint8]:
    """The picture with motion blur along a line and sensor noise."""
    half = length / 2
    ends = half + half * np.array([[-1], [1]]) * [np.cos(radians), np.sin(radians)]
    kernel = np.zeros((length + 1, length + 1), np.float32)
    cv2.line(kernel, *np.rint(ends).astype(int).tolist(), 1.0)
    smeared = cv2.filter2D(picture, -1, kernel / kernel.sum())
    noise = np.random.default_rng(length).normal(0, 2, picture.shape)
    return np.clip(smeared + noise, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("length", [25, 80])
@pytest.mark.parametrize("radians", [0.0, 0.4, np.pi / 2, 2.0])
def test_motion_blur_is_reported(
    sharp: list[NDArray[np.uint8]], tmp_path: Path, length: int, radians: float
) -> None:
    files = [tmp_path / f"{index}.png" for index in range(3)]
    for file, picture in zip(files, sharp, strict=False):
        cv2.imwrite(str(file), along_a_line(picture, length, radians))
    warning = blur_warning(files)
    assert warning is not None
    assert "blurred" in warning


@pytest.mark.shared
@pytest.mark.parametrize("name", ["street", "shelfbox", "kitchen"])
def test_recorded_sequences_cause_no_warning(name: str) -> None:
    files = sorted((SHARED / "sequences" / name / "frames").iterdir())
    assert len(files) > 30
    assert blur_warning(files) is None


def test_match_reports_blurred_images_that_it_writes(
    sharp: list[NDArray[np.uint8]], encode: Encode, tmp_path: Path
) -> None:
    blurred = [cv2.resize(gaussian(p), None, fx=0.5, fy=0.5) for p in sharp]
    video = encode(np.array(blurred), tmp_path / "blurred.mp4", *QUICK_AV1)
    options = MatchOptions(images=ImageOptions(every=1))
    report = match(tmp_path / "a.db", video, image_path=tmp_path / "images", options=options)
    assert any("the images are blurred" in warning for warning in report.warnings)
    assert report.num_pairs > 0

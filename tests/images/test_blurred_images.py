"""Images that are all blurred are told."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import PROJECT, Encode
from numpy.typing import NDArray

from colmap_av1.images.files import blur_warning
from colmap_av1.match import match
from colmap_av1.options import ImageOptions, MatchOptions
from colmap_av1.video.decoding import decode_frames

SCENE = PROJECT / "examples" / "scene.mp4"


def gaussian(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), 8.0), np.uint8)


@pytest.fixture(scope="module")
def sharp() -> list[NDArray[np.uint8]]:
    return [picture for index, picture in decode_frames(SCENE) if index < 12]


def test_sharp_images_are_sharp_at_any_size(sharp: list[NDArray[np.uint8]], tmp_path: Path) -> None:
    files = [tmp_path / "a.png", tmp_path / "b.png"]
    for scale in (0.5, 1.0, 4.0):
        for file, picture in zip(files, sharp, strict=False):
            cv2.imwrite(str(file), cv2.resize(picture, None, fx=scale, fy=scale))
        assert blur_warning(files) is None


def test_blurred_images_are_told(sharp: list[NDArray[np.uint8]], tmp_path: Path) -> None:
    files = [tmp_path / f"{index}.png" for index in range(len(sharp))]
    for file, picture in zip(files, sharp, strict=True):
        cv2.imwrite(str(file), gaussian(picture))
    told = blur_warning(files)
    assert told is not None
    assert told.startswith(f"{tmp_path}: the images are blurred")
    # One that is blurred among sharp ones is nothing to tell.
    for file, picture in zip(files[1:], sharp[1:], strict=True):
        cv2.imwrite(str(file), picture)
    assert blur_warning(files) is None


def test_match_tells_of_images_that_it_writes(
    sharp: list[NDArray[np.uint8]], encode: Encode, tmp_path: Path
) -> None:
    video = encode(np.array([gaussian(picture) for picture in sharp]), tmp_path / "blurred.mp4")
    options = MatchOptions(images=ImageOptions(every=1))
    report = match(tmp_path / "a.db", video, image_path=tmp_path / "images", options=options)
    assert any("the images are blurred" in warning for warning in report.warnings)
    assert report.num_pairs > 0

from __future__ import annotations

import itertools
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from conftest import Encode, Ffmpeg, make_frames
from numpy.typing import NDArray

from colmap_av1.errors import BitstreamError
from colmap_av1.match import match
from colmap_av1.options import EncodeOptions
from colmap_av1.video.decoding import decode_frames
from colmap_av1.video.deinterlacing import deinterlaced
from colmap_av1.video.encode import encode as encode_video
from colmap_av1.video.facts import read_video
from colmap_av1.video.stored_frames import decode

COUNT = 16


@pytest.fixture(scope="module")
def moments() -> NDArray[np.uint8]:
    return make_frames(2 * COUNT, 192, 128)


@pytest.fixture(scope="module", params=["top", "bottom"])
def camcorder(
    request: pytest.FixtureRequest,
    moments: NDArray[np.uint8],
    encode: Encode,
    ffmpeg: Ffmpeg,
    tmp_path_factory: pytest.TempPathFactory,
) -> Path:
    """Interlaced H.264 in a transport stream, with the top or bottom field first."""
    folder = tmp_path_factory.mktemp("camcorder")
    single = encode(moments, folder / "single.mkv", "-c:v", "ffv1")
    first = {"top": ("tff=1", "interleave_top"), "bottom": ("bff=1", "interleave_bottom")}
    order, mode = first[request.param]
    return ffmpeg(
        *("-i", single, "-vf", f"tinterlace=mode={mode}", "-c:v", "libx264", "-crf", "12"),
        *("-flags", "+ilme+ildct", "-x264opts", order, "-bf", "2", folder / "camcorder.ts"),
    )


def nearest(pictures: Sequence[NDArray[np.uint8]], moments: NDArray[np.uint8]) -> list[int]:
    """The index of the most similar moment for each picture."""
    return [
        int(np.argmax([cv2.PSNR(picture, moment) for moment in moments])) for picture in pictures
    ]


def test_decoded_pictures_show_the_first_field(camcorder: Path, moments: NDArray[np.uint8]) -> None:
    assert read_video(camcorder).is_interlaced
    pictures = dict(decode_frames(camcorder))
    assert list(pictures) == list(range(COUNT))
    assert nearest(list(pictures.values()), moments) == list(range(0, 2 * COUNT, 2))
    some = dict(decode_frames(camcorder, wanted=[3, COUNT - 1], num_threads=1))
    assert list(some) == [3, COUNT - 1]
    for index, picture in some.items():
        np.testing.assert_array_equal(picture, pictures[index])


def test_converted_stream_shows_the_same_moments(
    camcorder: Path, moments: NDArray[np.uint8], tmp_path: Path
) -> None:
    report = encode_video(camcorder, tmp_path / "out.mp4", options=EncodeOptions(quality=5))
    assert report.num_frames == COUNT
    assert not read_video(report.output).is_interlaced
    converted = [picture for _, picture in decode_frames(report.output)]
    assert nearest(converted, moments) == list(range(0, 2 * COUNT, 2))
    for (_, before), after in zip(decode_frames(camcorder), converted, strict=True):
        assert cv2.PSNR(before, after) > 30
    found = match(tmp_path / "a.db", camcorder)
    assert found.num_images == COUNT
    assert found.conversion is not None
    assert found.conversion.endswith(", deinterlaced")


def test_pictures_before_damage_are_deinterlaced(camcorder: Path) -> None:
    def damaged() -> Generator[Any, None, None]:
        yield from itertools.islice(decode(camcorder, 0, 1), 6)
        raise BitstreamError("damaged")

    frames = deinterlaced(damaged())
    assert len([next(frames) for _ in range(6)]) == 6
    with pytest.raises(BitstreamError, match="damaged"):
        next(frames)


def test_pictures_of_another_size_are_deinterlaced(
    camcorder: Path, ffmpeg: Ffmpeg, tmp_path: Path
) -> None:
    words = ("-c:v", "libx264", "-flags", "+ilme+ildct", "-x264opts", "tff=1")
    large = ffmpeg("-i", camcorder, "-vf", "scale=384:256", *words, tmp_path / "large.ts")

    def frames() -> Generator[Any, None, None]:
        yield from decode(camcorder, 0, 1)
        yield from decode(large, 0, 1)

    widths = [frame.width for frame in deinterlaced(frames())]
    assert widths == [192] * COUNT + [384] * COUNT


def test_progressive_video_is_unchanged(
    moments: NDArray[np.uint8], encode: Encode, tmp_path: Path
) -> None:
    video = encode(moments[:6], tmp_path / "plain.mkv", "-c:v", "ffv1", "-g", "1")
    assert not read_video(video).is_interlaced
    assert nearest([picture for _, picture in decode_frames(video)], moments) == list(range(6))

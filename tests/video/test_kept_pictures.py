"""Kept pictures are identical to the decoded ones and are decoded only once."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import av
import numpy as np
import pytest
from conftest import Ffmpeg
from hypothesis import given
from hypothesis import strategies as st

from colmap_av1.errors import BitstreamError
from colmap_av1.video.decoding import decode_frames
from colmap_av1.video.kept_pictures import KeptPictures

NOISE = np.random.default_rng(0).integers(0, 256, (60, 7, 11, 3), dtype=np.uint8)
WANTED = [0, 8, 16, 39]
SCENE = Path(__file__).resolve().parents[2] / "examples" / "scene.mp4"


class Video:
    """Yields pictures like a decoder and records which were decoded."""

    def __init__(self, pictures: np.ndarray | list[np.ndarray] = NOISE) -> None:
        self.pictures = pictures
        self.decoded: list[int] = []

    def frames(self, wanted: list[int]) -> Iterator[tuple[int, av.VideoFrame]]:
        for frame, picture in enumerate(self.pictures):
            self.decoded.append(frame)
            if frame in wanted:
                yield frame, av.VideoFrame.from_ndarray(picture, format="bgr24")


def taken(kept: KeptPictures, video: Video, wanted: list[int], most: int | None = None):
    """Take at most `most` pictures and stop after the last, as callers do."""
    found = {}
    pictures = kept.of(wanted, video.frames(wanted))
    for frame, picture in pictures:
        found[frame] = picture.to_ndarray().copy()
        if len(found) == (most or len(wanted)):
            break
    pictures.close()
    return found


@given(st.sets(st.integers(0, 59), min_size=1, max_size=8), st.data())
def test_kept_pictures_equal_the_decoded_ones(
    tmp_path_factory: pytest.TempPathFactory, wanted: set[int], data: st.DataObject
) -> None:
    kept = KeptPictures(tmp_path_factory.mktemp("kept") / "pictures.raw")
    video = Video()
    some = sorted(data.draw(st.sets(st.sampled_from(sorted(wanted)), min_size=1)))
    for asked in (sorted(wanted), some):
        found = taken(kept, video, asked)
        assert list(found) == asked
        assert all(np.array_equal(picture, NOISE[frame]) for frame, picture in found.items())


def test_kept_pictures_are_not_decoded_again(tmp_path: Path) -> None:
    kept, video = KeptPictures(tmp_path / "pictures.raw"), Video()
    taken(kept, video, WANTED)
    assert video.decoded == list(range(40))
    taken(kept, video, WANTED[1:3])
    taken(kept, video, WANTED)
    assert video.decoded == list(range(40))
    taken(kept, video, [*WANTED, 41])
    assert video.decoded == [*range(40), *range(42)]


def test_pictures_are_decoded_again_if_not_all_were_taken(tmp_path: Path) -> None:
    kept, video = KeptPictures(tmp_path / "pictures.raw"), Video()
    taken(kept, video, WANTED, most=2)
    assert len(taken(kept, video, WANTED)) == 4
    assert video.decoded == [*range(9), *range(40)]


def test_missing_pictures_of_a_damaged_video_are_requested_again(tmp_path: Path) -> None:
    class Damaged(Video):
        def frames(self, wanted: list[int]) -> Iterator[tuple[int, av.VideoFrame]]:
            yield from Video(self.pictures[:10]).frames(wanted)
            raise BitstreamError("damaged")

    kept = KeptPictures(tmp_path / "pictures.raw")
    for _ in range(2):
        with pytest.raises(BitstreamError, match="damaged"):
            taken(kept, Damaged(), WANTED)
    assert len(taken(kept, Video(NOISE[:20]), WANTED)) == 3


def test_pictures_of_another_size_are_passed_through(tmp_path: Path) -> None:
    kept = KeptPictures(tmp_path / "pictures.raw")
    pictures = [*NOISE[:16], *np.zeros((44, 8, 8, 3), np.uint8)]
    for _ in range(2):
        found = taken(kept, Video(pictures), WANTED)
        assert [found[frame].shape[:2] for frame in WANTED] == [(7, 11), (7, 11), (8, 8), (8, 8)]


# Pixel formats of cameras: 8 bits, HDR of phones with 10 bits, the full range of JPEG, a palette,
# and RGB, which needs no conversion.
KINDS = {
    "plain": ["-c:v", "libx264", "-pix_fmt", "yuv420p"],
    "odd": ["-vf", "crop=317:179:exact=1", "-c:v", "libx264", "-pix_fmt", "yuv444p"],
    "hdr": ["-c:v", "libx264", "-pix_fmt", "yuv420p10le", "-colorspace", "bt2020nc"],
    "jpeg": ["-c:v", "mjpeg", "-pix_fmt", "yuvj422p"],
    "palette": ["-c:v", "png", "-pix_fmt", "pal8"],
    "colours": ["-c:v", "rawvideo", "-pix_fmt", "bgr24"],
}


@pytest.mark.parametrize("kind", KINDS)
def test_all_pixel_formats_are_kept_exactly(tmp_path: Path, ffmpeg: Ffmpeg, kind: str) -> None:
    video, wanted = tmp_path / "video.nut", [0, 3, 7]
    ffmpeg("-i", SCENE, "-frames:v", "8", *KINDS[kind], video)
    kept = KeptPictures(tmp_path / "pictures.raw")
    plain, first, again = (
        dict(decode_frames(video, wanted=wanted, kept=own)) for own in (None, kept, kept)
    )
    assert list(plain) == list(first) == list(again) == wanted
    for frame, picture in plain.items():
        assert np.array_equal(picture, first[frame])
        assert np.array_equal(picture, again[frame])


def test_kept_pictures_need_no_decoder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept = KeptPictures(tmp_path / "pictures.raw")
    assert [frame for frame, _ in decode_frames(SCENE, wanted=WANTED, kept=kept)] == WANTED
    monkeypatch.setattr("colmap_av1.video.decoding.decode", lambda *_: pytest.fail("decoded"))
    again = decode_frames(SCENE, wanted=WANTED[1:3], kept=kept)
    assert [frame for frame, _ in again] == WANTED[1:3]


def test_no_pictures_are_given_if_none_are_wanted(tmp_path: Path) -> None:
    kept = KeptPictures(tmp_path / "pictures.raw")
    for _ in range(2):
        assert list(decode_frames(SCENE, wanted=[], kept=kept)) == []
        assert len(list(decode_frames(SCENE, wanted=[1], kept=kept))) == 1

"""Pictures that are kept are those that were decoded, and decoded once."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from colmap_av1.errors import BitstreamError
from colmap_av1.video.decoding import decode_frames
from colmap_av1.video.kept_pictures import KeptPictures

NOISE = np.random.default_rng(0).integers(0, 256, (60, 7, 11, 3), dtype=np.uint8)
WANTED = [0, 8, 16, 39]
SCENE = Path(__file__).resolve().parents[2] / "examples" / "scene.mp4"


class Video:
    """Gives pictures, and remembers which."""

    def __init__(self, pictures: np.ndarray | list[np.ndarray] = NOISE) -> None:
        self.pictures = pictures
        self.decoded: list[int] = []

    def frames(self, wanted: list[int]) -> Iterator[tuple[int, np.ndarray]]:
        for frame, picture in enumerate(self.pictures):
            self.decoded.append(frame)
            if frame in wanted:
                yield frame, picture


def taken(kept: KeptPictures, video: Video, wanted: list[int], most: int | None = None):
    """The pictures of frames, up to the last or to so many, as those who stop there take them."""
    found = {}
    pictures = kept.of(wanted, video.frames(wanted))
    for frame, picture in pictures:
        found[frame] = picture
        if len(found) == (most or len(wanted)):
            break
    pictures.close()
    return found


@given(st.sets(st.integers(0, 59), min_size=1, max_size=8), st.data())
def test_pictures_are_those_that_were_decoded(
    tmp_path_factory: pytest.TempPathFactory, wanted: set[int], data: st.DataObject
) -> None:
    kept = KeptPictures(tmp_path_factory.mktemp("kept") / "pictures.nut")
    video = Video()
    some = sorted(data.draw(st.sets(st.sampled_from(sorted(wanted)), min_size=1)))
    for asked in (sorted(wanted), some):
        found = taken(kept, video, asked)
        assert list(found) == asked
        assert all(np.array_equal(picture, NOISE[frame]) for frame, picture in found.items())


def test_what_is_kept_is_not_decoded_again(tmp_path: Path) -> None:
    kept, video = KeptPictures(tmp_path / "pictures.nut"), Video()
    taken(kept, video, WANTED)
    assert video.decoded == list(range(40))
    taken(kept, video, WANTED[1:3])
    taken(kept, video, WANTED)
    assert video.decoded == list(range(40))
    taken(kept, video, [*WANTED, 41])
    assert video.decoded == [*range(40), *range(42)]


def test_nothing_is_kept_where_most_frames_are_wanted(tmp_path: Path) -> None:
    kept, video = KeptPictures(tmp_path / "pictures.nut"), Video()
    for _ in range(2):
        taken(kept, video, list(range(0, 30, 2)))
    assert video.decoded == [*range(29)] * 2
    assert list(tmp_path.iterdir()) == []


def test_pictures_that_were_not_all_taken_are_decoded_again(tmp_path: Path) -> None:
    kept, video = KeptPictures(tmp_path / "pictures.nut"), Video()
    taken(kept, video, WANTED, most=2)
    assert len(taken(kept, video, WANTED)) == 4
    assert video.decoded == [*range(9), *range(40)]


def test_what_a_damaged_video_lacks_is_asked_for_again(tmp_path: Path) -> None:
    class Damaged(Video):
        def frames(self, wanted: list[int]) -> Iterator[tuple[int, np.ndarray]]:
            yield from Video(self.pictures[:10]).frames(wanted)
            raise BitstreamError("damaged")

    kept = KeptPictures(tmp_path / "pictures.nut")
    for _ in range(2):
        with pytest.raises(BitstreamError, match="damaged"):
            taken(kept, Damaged(), WANTED)
    assert len(taken(kept, Video(NOISE[:20]), WANTED)) == 3


def test_pictures_of_another_size_are_passed_on(tmp_path: Path) -> None:
    kept = KeptPictures(tmp_path / "pictures.nut")
    pictures = [*NOISE[:16], *np.zeros((44, 8, 8, 3), np.uint8)]
    for _ in range(2):
        found = taken(kept, Video(pictures), WANTED)
        assert [found[frame].shape[:2] for frame in WANTED] == [(7, 11), (7, 11), (8, 8), (8, 8)]


def test_real_pictures_are_kept_exactly(tmp_path: Path) -> None:
    kept, wanted = KeptPictures(tmp_path / "pictures.nut"), [0, 9, 20]
    decoded, again = (dict(kept.of(wanted, decode_frames(SCENE, wanted=wanted))) for _ in range(2))
    assert list(again) == wanted
    assert all(np.array_equal(decoded[frame], again[frame]) for frame in wanted)

from __future__ import annotations

import itertools
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import PROJECT, Ffmpeg
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from colmap_av1.errors import ImageError
from colmap_av1.images.recognising import (
    _ascending_assignment,
    check_content,
    frames_by_content,
    is_turned_back,
)
from colmap_av1.video.decoding import decode_frames
from colmap_av1.video.display import Display, shown_picture

EXAMPLE = PROJECT / "examples" / "scene.mp4"


def pan(num_frames: int, step: float, seed: int = 0) -> list[np.ndarray]:
    """A smooth random scene, seen by a camera that pans by `step` px per frame."""
    rng = np.random.default_rng(seed)
    scene = rng.uniform(0, 255, (180, int(240 + step * num_frames) + 2, 3)).astype(np.float32)
    scene = cv2.normalize(cv2.GaussianBlur(scene, (0, 0), 8), None, 0, 255, cv2.NORM_MINMAX)
    shifts = [np.array([[1.0, 0, -step * i], [0, 1, 0]]) for i in range(num_frames)]
    return [cv2.warpAffine(scene, shift, (240, 180)).astype(np.uint8) for shift in shifts]


_PAN = pan(30, 2)


def write(folder: Path, pictures: list[np.ndarray], ending: str = "png") -> list[Path]:
    folder.mkdir(exist_ok=True)
    paths = [folder / f"{number:03d}.{ending}" for number in range(len(pictures))]
    for path, picture in zip(paths, pictures, strict=True):
        how = [cv2.IMWRITE_JPEG_QUALITY, 60] if ending == "jpg" else []
        cv2.imwrite(str(path), picture, how)
    return paths


@settings(deadline=None)
@given(st.data())
def test_ascending_assignment_is_optimal(data: st.DataObject) -> None:
    num_images = data.draw(st.integers(1, 4))
    num_frames = data.draw(st.integers(num_images, 7))
    values = st.lists(st.integers(0, 9), min_size=num_frames, max_size=num_frames)
    rows = data.draw(st.lists(values, min_size=num_images, max_size=num_images))
    likeness = np.array(rows, dtype=np.float32)
    found = _ascending_assignment(likeness)
    assert np.all(np.diff(found) > 0)
    best = max(
        likeness[np.arange(num_images), list(frames)].sum()
        for frames in itertools.combinations(range(num_frames), num_images)
    )
    assert likeness[np.arange(num_images), found].sum() == best


@settings(
    max_examples=20,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    frames=st.sets(st.integers(0, 29), min_size=1, max_size=12),
    scale=st.sampled_from([0.25, 0.5, 1.0, 1.5]),
    ending=st.sampled_from(["png", "jpg"]),
    shuffled=st.booleans(),
)
def test_frames_are_found_at_any_scale_order_and_format(
    tmp_path: Path, frames: set[int], scale: float, ending: str, shuffled: bool
) -> None:
    pictures = _PAN
    order = sorted(frames)
    if shuffled:
        np.random.default_rng(len(order)).shuffle(order)
    written = [
        cv2.resize(pictures[f], None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        for f in order
    ]
    files = write(tmp_path / "images", written, ending)
    assert frames_by_content(files, enumerate(pictures))[1].tolist() == order


@pytest.mark.parametrize(
    "how",
    [
        ["-vf", "fps=7"],
        ["-vf", "fps=4,scale=320:-1", "-q:v", "2"],
        ["-vf", "thumbnail=6,setpts=N/TB", "-fps_mode", "passthrough"],
    ],
    ids=["fps", "half", "thumbnail"],
)
def test_frames_selected_by_ffmpeg_are_found(
    ffmpeg: Ffmpeg, tmp_path: Path, how: list[str]
) -> None:
    (tmp_path / "cut").mkdir()
    ffmpeg("-i", EXAMPLE, *how, tmp_path / "cut" / "%03d.jpg")
    files = sorted((tmp_path / "cut").iterdir())
    pictures = list(decode_frames(EXAMPLE))
    _, found = frames_by_content(files, iter(pictures))
    assert len(found) > 8
    for path, frame in zip(files, found, strict=True):
        cut = cv2.imread(str(path)).astype(int)
        height, width = cut.shape[:2]
        around = range(max(0, frame - 1), min(len(pictures), frame + 2))
        difference = {
            f: np.abs(cv2.resize(pictures[f][1], (width, height)).astype(int) - cut).mean()
            for f in around
        }
        assert min(difference, key=lambda f: difference[f]) == frame


def test_frame_that_appears_again_is_left_out_or_refused(tmp_path: Path) -> None:
    """ffmpeg repeats a frame where timestamps have a gap."""
    pictures = pan(12, 2)
    files = write(tmp_path / "repeated", [pictures[i] for i in (0, 4, 4, 8)])
    kept, frames = frames_by_content(files, enumerate(pictures))
    assert (kept, frames.tolist()) == ([0, 1, 3], [0, 4, 8])
    files = write(tmp_path / "later", [pictures[i] for i in (0, 4, 8, 4)])
    with pytest.raises(ImageError, match="order") as info:
        frames_by_content(files, enumerate(pictures))
    assert "\n" not in str(info.value)


def test_frames_of_a_pausing_camera_are_found(tmp_path: Path) -> None:
    moving = pan(10, 2)
    pictures = [moving[0]] * 8 + moving
    files = write(tmp_path / "images", [pictures[i] for i in (0, 5, 10, 15)])
    _, found = frames_by_content(files, enumerate(pictures))
    assert np.all(np.diff(found) > 0)
    assert found[1] <= 8
    assert found[2:].tolist() == [10, 15]


def test_repeated_scene_is_ambiguous(tmp_path: Path) -> None:
    there = pan(8, 2)
    files = write(tmp_path / "images", [there[i] for i in (1, 4)])
    with pytest.raises(ImageError, match=r"frame [14] .* frame (9|12)"):
        frames_by_content(files, enumerate(there + there))


def test_unrelated_images_are_refused(tmp_path: Path) -> None:
    files = write(tmp_path / "images", pan(3, 2, seed=1))
    with pytest.raises(ImageError, match="no frame"):
        frames_by_content(files, enumerate(pan(12, 2)))
    with pytest.raises(ImageError, match="3 images"):
        frames_by_content(files, enumerate(pan(2, 2)))
    files[0].write_bytes(b"no image")
    with pytest.raises(ImageError, match="not an image"):
        frames_by_content(files, enumerate(pan(12, 2)))


def test_content_check_detects_an_offset_of_one_frame(tmp_path: Path) -> None:
    pictures = pan(12, 2)
    files = write(tmp_path / "images", [pictures[3], pictures[9]], "jpg")
    check_content(files, [3, 9], enumerate(pictures))
    with pytest.raises(ImageError, match=r"000\.jpg: .*frame 3"):
        check_content(files, [2, 9], enumerate(pictures))
    with pytest.raises(ImageError, match=r"001\.jpg: .*frame 9"):
        check_content(files, [3, 11], enumerate(pictures))
    with pytest.raises(ImageError, match="another"):
        check_content(files, [3, 9], enumerate(pan(12, 2, seed=1)))


def test_flat_pictures_at_a_fade_are_recognised(tmp_path: Path) -> None:
    pictures = [np.zeros_like(picture) for picture in pan(3, 2)] + pan(12, 2)
    files = write(tmp_path / "images", [pictures[k] for k in (0, 5, 9)], "jpg")
    check_content(files, [0, 5, 9], enumerate(pictures))
    with pytest.raises(ImageError, match=r"000\.jpg"):
        check_content(files, [4, 5, 9], enumerate(pictures))
    files = write(tmp_path / "all", [pictures[k] for k in (2, 5, 9)])
    assert frames_by_content(files, enumerate(pictures))[1].tolist()[1:] == [5, 9]


@pytest.mark.parametrize("turn", [((-1, 0), (0, -1)), ((1, 0), (0, -1)), ((0, 1), (1, 0))])
def test_unrotated_images_are_recognised(
    tmp_path: Path, turn: tuple[tuple[int, int], tuple[int, int]]
) -> None:
    display = Display(turn=turn)
    stored = pan(12, 2)
    shown = [shown_picture(picture, display) for picture in stored]
    as_shown, as_stored = write(tmp_path / "images", [shown[7], stored[7]])
    assert not is_turned_back(as_shown, enumerate(shown), display)
    assert is_turned_back(as_stored, enumerate(shown), display)

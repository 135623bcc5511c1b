from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from conftest import Encode, Ffmpeg, make_frames
from databases import keypoints_of
from hypothesis import given, settings
from hypothesis import strategies as st

from colmap_av1.errors import ImageError, OptionError
from colmap_av1.images.blur import skip_blurred
from colmap_av1.images.choosing import (
    choose_frames,
    choose_images,
    read_frame_list,
    spread_in_parallax,
)
from colmap_av1.images.parallax import parallax
from colmap_av1.match import match
from colmap_av1.match_report import MatchReport
from colmap_av1.motion.reading import frame_times
from colmap_av1.options import DensityOptions, ImageOptions, MatchOptions, VerifyOptions
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.video.decoding import decode_frames

# All tracks are used, so the observations of an image do not depend on the other images.
DENSE = MatchOptions(density=DensityOptions(preset="dense"), verify=VerifyOptions(verify="pairs"))
LOSSLESS = ["-c:v", "libaom-av1", "-cpu-used", "8", "-lag-in-frames", "0", "-crf", "1"]


def tracks_from(paths: np.ndarray, size: tuple[int, int] = (640, 480)) -> Tracks:
    """Tracks observed in every frame: paths [num_tracks, num_frames, 2]."""
    num_tracks, num_frames = paths.shape[:2]
    count = num_tracks * num_frames
    return Tracks(
        num_frames=num_frames,
        width=size[0],
        height=size[1],
        offsets=np.arange(0, count + 1, num_frames, dtype=np.int64),
        frame=np.tile(np.arange(num_frames, dtype=np.int32), num_tracks),
        xy=paths.reshape(-1, 2).astype(np.float32),
        sigma=np.full(count, 0.5, np.float32),
        confirmed=np.zeros(count, bool),
    )


def project(centres: np.ndarray, angles: np.ndarray) -> Tracks:
    """Tracks of points at depths 4 to 20, for cameras at x = centre, rotated about y."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-3, -2, 4], [3, 2, 20], (300, 3))
    paths = []
    for centre, angle in zip(centres, angles, strict=True):
        x, y, z = (points - [centre, 0, 0]).T
        c, s = np.cos(angle), np.sin(angle)
        turned = np.stack([c * x - s * z, y, s * x + c * z])
        paths.append(768 * turned[:2] / turned[2] + [[320], [240]])
    return tracks_from(np.array(paths).transpose(2, 0, 1))


@settings(deadline=None)
@given(st.integers(2, 60), st.integers(2, 60), st.randoms(use_true_random=False))
def test_any_number_of_images_is_spread_evenly_in_time(
    num_frames: int, wanted: int, random: object
) -> None:
    rng = np.random.default_rng(random.getrandbits(32))  # type: ignore[attr-defined]
    times = np.cumsum(rng.exponential(1.0, num_frames) ** 3 + 1e-3)
    options = ImageOptions(num_images=wanted)
    if wanted > num_frames:
        with pytest.warns(UserWarning, match="all of its frames"):
            frames = choose_frames(num_frames, options, times)
        assert frames.tolist() == list(range(num_frames))
        return
    frames = choose_frames(num_frames, options, times)
    assert len(frames) == wanted
    assert np.all(np.diff(frames) > 0)
    assert (frames[0], frames[-1]) == (0, num_frames - 1)


def test_spread_is_even_in_time_if_times_are_known() -> None:
    # The first second has 30 frames, the second one 10.
    times = np.concatenate([np.arange(30) / 30, 1 + np.arange(11) / 10])
    frames = choose_frames(41, ImageOptions(num_images=5), times)
    assert frames.tolist() == [0, 15, 30, 35, 40]
    assert choose_frames(41, ImageOptions(num_images=5)).tolist() == [0, 10, 20, 30, 40]
    assert choose_frames(41, ImageOptions(every=20), times).tolist() == [0, 20, 40]
    for fps in (100, 2e9):
        assert len(choose_frames(41, ImageOptions(fps=fps), times)) == 41


@pytest.mark.parametrize("fps", [2, 5, 7, 12.5, 20])
def test_fps_selects_the_same_frames_as_ffmpeg(
    encode: Encode, ffmpeg: Ffmpeg, tmp_path: Path, fps: float
) -> None:
    clip = encode(make_frames(25, 96, 64), tmp_path / "clip.mp4")
    ffmpeg("-i", clip, "-vf", f"fps={fps}", tmp_path / "%04d.png")
    frames = choose_frames(25, ImageOptions(fps=fps), frame_times(clip))
    pictures = [picture for _, picture in decode_frames(clip)]
    cut = [cv2.imread(str(path)) for path in sorted(tmp_path.glob("*.png"))]
    shown = [int(np.argmin([np.abs(c.astype(int) - p).mean() for p in pictures])) for c in cut]
    assert frames.tolist() == shown


def test_parallax_is_nearly_independent_of_rotation() -> None:
    turning = parallax(project(np.zeros(11), np.linspace(0, 0.2, 11)))
    moving = parallax(project(np.linspace(0, 0.5, 11), np.zeros(11)))
    both = parallax(project(np.linspace(0, 0.5, 11), np.linspace(0, 0.2, 11)))
    # Rotation moves points by 15 px per frame, of which a tenth counts as parallax; the parallax of
    # the translation is the same with and without rotation.
    assert np.median(turning) < 2
    assert np.median(moving) > 1.0
    np.testing.assert_allclose(np.median(both) - np.median(turning), np.median(moving), atol=0.6)


def test_images_are_spread_evenly_in_parallax() -> None:
    # The camera stands still for a while, then moves.
    centres = np.concatenate([np.zeros(20), np.linspace(0, 1, 21)])
    frames = spread_in_parallax(project(centres, np.zeros(41)), 6)
    assert frames[0] == 0
    np.testing.assert_allclose(frames[1:], [24, 28, 32, 36, 40], atol=1)


def test_blurred_frames_are_replaced_by_sharp_neighbours() -> None:
    sharp = np.full(41, 10.0)
    sharp[[10, 20, 21, 30]] = 1.0
    sharp[22] = 12.0
    asked: list[int] = []

    def sharpness(frames: object) -> np.ndarray:
        asked.extend(frames)  # type: ignore[call-overload]
        return sharp[list(frames)]  # type: ignore[call-overload]

    frames = np.array([0, 10, 20, 30, 40], dtype=np.int32)
    assert skip_blurred(frames, sharpness).tolist() == [0, 8, 22, 28, 40]
    assert asked == sorted(set(asked))


def test_frame_list_is_read(tmp_path: Path) -> None:
    path = tmp_path / "list.txt"
    path.write_text("# mine\n\n9 last one.png\n0\n2, img1.png\n3,img2.png\nimg_0005.jpg\n")
    chosen = read_frame_list(path, 10, ImageOptions(first_number=1))
    assert chosen.frames.tolist() == [0, 2, 3, 4, 9]
    names = ["frame_000000.png", "img1.png", "img2.png", "img_0005.jpg", "last one.png"]
    assert chosen.names == names


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0\n10\n", "line 2"),
        ("0\n3\n3 b.png\n", "twice"),
        ("0 a.png\n3 a.png\n", "twice"),
        ("first.png\n", "first.png"),
        ("5\n", "10"),
        ("", "no frame"),
        ("0\n-1\n", "line 2"),
        ("0,5\n", "line 1"),
        ("0, 5, 7\n", "line 1"),
        ("img1.png 0\n", "line 1"),
        ("img1.png,0\n", "line 1"),
        ("1.5\n", "line 1"),
        (b"\xff\xd8\xff\xe0", r"list\.txt"),
        (None, r"list\.txt"),
    ],
)
def test_invalid_frame_lists_are_refused(
    tmp_path: Path, text: str | bytes | None, message: str
) -> None:
    if text is not None:
        (tmp_path / "list.txt").write_bytes(text if isinstance(text, bytes) else text.encode())
    options = ImageOptions(frame_list=str(tmp_path / "list.txt"))
    with pytest.raises(ImageError, match=message):
        choose_images(
            10, options, existing=(), folder=None, times=lambda: None, decode=lambda _: ()
        )


def test_fps_needs_frame_times() -> None:
    with pytest.raises(OptionError, match="time"):
        choose_frames(10, ImageOptions(fps=2))


@pytest.fixture(scope="module")
def cut(clip: Path) -> list[np.ndarray]:
    return [picture for _, picture in decode_frames(clip)]


def test_existing_folder_is_used_without_changes(
    clip: Path, cut: list[np.ndarray], tmp_path: Path
) -> None:
    # A script wrote every third frame at half size as JPEG, numbered from 1.
    folder = tmp_path / "input"
    folder.mkdir()
    for number, picture in enumerate(cut[1::3], start=1):
        half = cv2.resize(picture, (96, 64), interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(folder / f"img {number}.jpg"), half, [cv2.IMWRITE_JPEG_QUALITY, 80])
    before = {p.name: p.read_bytes() for p in folder.iterdir()}
    report = match(tmp_path / "a.db", clip, image_path=folder, options=DENSE)
    assert report.num_images == 5
    assert report.num_written_images == 0
    assert {p.name: p.read_bytes() for p in folder.iterdir()} == before
    (tmp_path / "list.txt").write_text("".join(f"{frame}\n" for frame in range(1, 16, 3)))
    listed = ImageOptions(frame_list=str(tmp_path / "list.txt"))
    options = replace(DENSE, images=listed)
    wanted = match(tmp_path / "b.db", clip, options=options)
    assert report.num_matches == wanted.num_matches
    ours, theirs = keypoints(tmp_path / "a.db"), keypoints(tmp_path / "b.db")
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(a * 2, b, atol=1e-4)


def keypoints(database: Path) -> list[np.ndarray]:
    return list(keypoints_of(database).values())


def save(folder: Path, pictures: Sequence[np.ndarray], name: str = "x%d.png") -> Path:
    folder.mkdir(exist_ok=True)
    for number, picture in enumerate(pictures):
        cv2.imwrite(str(folder / (name % number)), picture)
    return folder


def test_images_that_match_no_frame_or_many_are_refused(
    clip: Path, cut: list[np.ndarray], encode: Encode, tmp_path: Path
) -> None:
    folder = save(tmp_path / "others", [255 - cut[3 * number] for number in range(5)])
    with pytest.raises(ImageError, match="no frame"):
        match(tmp_path / "a.db", clip, image_path=folder)
    save(folder, [cut[0]] * 5)
    with pytest.raises(ImageError, match=r"x0\.png"):
        match(tmp_path / "a.db", clip, image_path=folder)
    twice = encode(np.concatenate([make_frames(8)] * 2), tmp_path / "twice.mp4", *LOSSLESS)
    save(folder, [picture for _, picture in decode_frames(twice)][1:6])
    with pytest.raises(ImageError, match=r"x0\.png"):
        match(tmp_path / "a.db", twice, image_path=folder)
    assert not (tmp_path / "a.db").exists()


def test_images_with_our_names_may_be_numbered_from_one(
    clip: Path, ffmpeg: Ffmpeg, tmp_path: Path
) -> None:
    """ffmpeg numbers images from 1, so each shows the frame before its number."""
    (tmp_path / "cut").mkdir()
    ffmpeg("-i", clip, tmp_path / "cut" / "frame_%06d.png")
    report = match(tmp_path / "a.db", clip, image_path=tmp_path / "cut", options=DENSE)
    assert (report.num_images, report.num_written_images) == (16, 0)
    match(tmp_path / "b.db", clip, options=DENSE)
    found, wanted = keypoints(tmp_path / "a.db"), keypoints(tmp_path / "b.db")
    for ours, theirs in zip(found, wanted, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    # Two images are missing: the frames of the others are found by content.
    for number in (3, 16):
        (tmp_path / "cut" / f"frame_{number:06d}.png").unlink()
    report = match(tmp_path / "c.db", clip, image_path=tmp_path / "cut", options=DENSE)
    assert report.num_images == 14
    kept = [k for i, k in enumerate(wanted) if i not in (2, 15)]
    for ours, theirs in zip(keypoints(tmp_path / "c.db"), kept, strict=True):
        assert set(map(tuple, ours)) <= set(map(tuple, theirs))


def test_folder_of_another_video_is_refused(
    clip: Path, cut: list[np.ndarray], tmp_path: Path
) -> None:
    folder = save(tmp_path / "other", [picture[::-1] for picture in cut])
    with pytest.raises(ImageError, match=r"x0\.png"):
        match(tmp_path / "a.db", clip, image_path=folder)
    # Also with our own names.
    folder = save(tmp_path / "ours", [picture[::-1] for picture in cut[:3]], "frame_%06d.png")
    with pytest.raises(ImageError, match=r"frame_000000\.png"):
        match(tmp_path / "a.db", clip, image_path=folder)
    assert len(list(folder.iterdir())) == 3
    # The number of images is right, but one is missing and another one exists twice.
    folder = save(tmp_path / "odd", [*cut[:4], *cut[5:], cut[2]])
    with pytest.raises(ImageError, match=r"x\d+\.png"):
        match(tmp_path / "a.db", clip, image_path=folder)
    folder = save(tmp_path / "middle", [*cut[:4], *cut[5:12], cut[11], *cut[12:]])
    with pytest.raises(ImageError, match=r"x\d+\.png"):
        match(tmp_path / "a.db", clip, image_path=folder)


@pytest.mark.parametrize("ending", ["png", "jpg"])
def test_repeated_images_in_a_folder_are_reported(
    clip: Path, ffmpeg: Ffmpeg, tmp_path: Path, ending: str
) -> None:
    """ffmpeg repeats frames at a higher rate; JPEG files of the same picture may differ."""
    folder = tmp_path / "fps"
    folder.mkdir()
    ffmpeg("-i", clip, "-vf", "fps=30", folder / f"%04d.{ending}")
    num_files = len(list(folder.iterdir()))
    assert num_files > 16
    with pytest.warns(UserWarning, match=f"{num_files - 16} images"):
        report = match(tmp_path / "a.db", clip, image_path=folder, options=DENSE)
    assert (report.num_images, report.num_written_images) == (16, 0)
    assert len(list(folder.iterdir())) == num_files


def test_read_only_folder_of_images_is_used(
    clip: Path, cut: list[np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = save(tmp_path / "cut", cut)
    access = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: path != folder and access(path, mode))
    assert match(tmp_path / "a.db", clip, image_path=folder, options=DENSE).num_images == 16
    empty = save(tmp_path / "empty", ())
    monkeypatch.setattr(os, "access", lambda path, mode: path != empty and access(path, mode))
    with pytest.raises(ImageError, match="permission"):
        match(tmp_path / "b.db", clip, image_path=empty)


@pytest.mark.parametrize(
    ("name", "error"),
    [
        ("../a.png", ImageError),
        ("/a.png", ImageError),
        ("a.tif", OptionError),
        (f"{'a' * 220}.png", ImageError),
    ],
)
def test_unwritable_image_names_are_refused(
    clip: Path, tmp_path: Path, name: str, error: type[Exception]
) -> None:
    (tmp_path / "list.txt").write_text(f"0 {name}\n3 b.png\n")
    options = MatchOptions(images=ImageOptions(frame_list=str(tmp_path / "list.txt")))
    with pytest.raises(error, match=re.escape(name)):
        match(tmp_path / "a.db", clip, image_path=tmp_path / "images", options=options)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["list.txt"]


def test_images_may_be_stored_without_rotation(
    clip: Path, cut: list[np.ndarray], ffmpeg: Ffmpeg, tmp_path: Path
) -> None:
    """Some programs do not rotate pictures; this is detected by size or content."""
    match(tmp_path / "plain.db", clip, options=DENSE)
    expected = keypoints(tmp_path / "plain.db")
    folder = save(tmp_path / "stored", cut)
    for angle in (90, 180):
        turned = ffmpeg(
            *("-display_rotation", str(angle), "-i", clip, "-c", "copy"), tmp_path / f"{angle}.mp4"
        )
        database = tmp_path / f"{angle}.db"
        assert match(database, turned, image_path=folder, options=DENSE).num_written_images == 0
        for ours, theirs in zip(keypoints(database), expected, strict=True):
            np.testing.assert_allclose(ours, theirs, atol=1e-4)
    upright = save(tmp_path / "upright", [picture[::-1, ::-1] for picture in cut])
    match(tmp_path / "upright.db", turned, image_path=upright, options=DENSE)
    for ours, theirs in zip(keypoints(tmp_path / "upright.db"), expected, strict=True):
        np.testing.assert_allclose(ours, [192, 128] - theirs, atol=1e-4)


def test_every_applies_to_existing_images(
    clip: Path, cut: list[np.ndarray], tmp_path: Path
) -> None:
    folder = save(tmp_path / "step", cut[::3])

    def run(name: str, **images: Any) -> MatchReport:
        options = replace(DENSE, images=ImageOptions(**images))
        return match(tmp_path / name, clip, image_path=folder, options=options)

    assert run("a.db", every=3).num_images == 6
    # One image was removed: its number shows which, if the first number is given.
    (folder / "x2.png").unlink()
    assert run("b.db", every=3, first_number=0).num_images == 5
    kept = [k for i, k in enumerate(keypoints(tmp_path / "a.db")) if i != 2]
    for ours, theirs in zip(keypoints(tmp_path / "b.db"), kept, strict=True):
        assert set(map(tuple, ours)) <= set(map(tuple, theirs))
    with pytest.raises(ImageError, match=r"x1\.png"):
        run("c.db", every=3)
    with pytest.raises(ImageError, match=r"x4\.png"):
        run("c.db", every=4, first_number=0)
    with pytest.raises(OptionError, match="num_images"):
        run("c.db", num_images=3)
    assert not (tmp_path / "c.db").exists()


def test_content_is_checked_if_images_are_missing(
    clip: Path, cut: list[np.ndarray], tmp_path: Path
) -> None:
    folder = save(tmp_path / "step", cut[::3])
    database = tmp_path / "a.db"
    pycolmap.Database.open(database).close()
    pycolmap.import_images(database, folder, pycolmap.CameraMode.SINGLE)
    (folder / "x1.png").unlink()
    before = database.read_bytes()
    with pytest.raises(ImageError, match="should show frame 4"):
        match(database, clip, image_path=folder, options=_every(2))
    with pytest.raises(ImageError, match=r"x1\.png"):
        match(database, clip, image_path=folder, options=DENSE)
    assert database.read_bytes() == before
    assert not (folder / "x1.png").exists()
    assert match(database, clip, image_path=folder, options=_every(3)).num_written_images == 1


def _every(step: int) -> MatchOptions:
    return replace(DENSE, images=ImageOptions(every=step))


@pytest.mark.parametrize("choice", [{"fps": 10}, {"frame_list": "list.txt"}])
def test_missing_images_of_an_earlier_run_are_written_again(
    clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, choice: dict[str, Any]
) -> None:
    """Frame 0 need not be among them."""
    monkeypatch.chdir(tmp_path)
    Path("list.txt").write_text("2 a.png\n4 b.png\n6\n8\n10\n")
    options = replace(DENSE, images=ImageOptions(**choice))
    first = match("0.db", clip, image_path="images", options=options)
    names = sorted(path.name for path in Path("images").iterdir())
    assert "frame_000000.png" not in names
    assert first.num_written_images == len(names) > 3
    for number, num_missing in enumerate((0, 2), start=1):
        for name in names[:num_missing]:
            (Path("images") / name).unlink()
        again = match(f"{number}.db", clip, image_path="images", options=options)
        assert (again.num_images, again.num_written_images) == (len(names), num_missing)
    assert sorted(path.name for path in Path("images").iterdir()) == names


@pytest.mark.parametrize(
    "choice",
    [{"num_images": 5}, {"fps": 10}, {"num_images": 5, "select": "parallax"}],
)
def test_a_choice_can_be_repeated_on_its_own_database(
    clip: Path, tmp_path: Path, choice: dict[str, Any]
) -> None:
    options = replace(DENSE, images=ImageOptions(**choice), on_existing="replace")
    database, folder = tmp_path / "a.db", tmp_path / "images"
    first = match(database, clip, image_path=folder, options=options)
    again = match(database, clip, image_path=folder, options=options)
    assert (again.num_images, again.num_written_images) == (first.num_images, 0)
    assert again.num_matches == first.num_matches > 0
    other = replace(options, images=ImageOptions(num_images=7))
    with pytest.raises(OptionError, match="exist"):
        match(database, clip, image_path=folder, options=other)
    last = sorted(folder.iterdir())[-1]
    cv2.imwrite(str(last), np.full((128, 192, 3), 99, np.uint8))
    with pytest.raises(ImageError, match=last.name):
        match(database, clip, image_path=folder, options=options)


def test_images_that_cannot_be_read_cause_a_warning(clip: Path, tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "0.webp").write_bytes(b"RIFF")
    with pytest.warns(UserWarning, match=r"0\.webp"):
        match(tmp_path / "a.db", clip, image_path=tmp_path / "images")


def test_ignored_subfolders_cause_a_warning(clip: Path, tmp_path: Path) -> None:
    (tmp_path / "images" / "camera").mkdir(parents=True)
    (tmp_path / "images" / "camera" / "1.png").touch()
    with pytest.warns(UserWarning, match="camera"):
        match(tmp_path / "a.db", clip, image_path=tmp_path / "images")


@pytest.mark.parametrize("missing", [(), ("x0.png",)])
def test_orientation_is_that_of_the_images_that_are_there(
    clip: Path, cut: list[np.ndarray], ffmpeg: Ffmpeg, tmp_path: Path, missing: tuple[str, ...]
) -> None:
    """Both orientations have the same shape, so the content of an image decides."""
    turned = ffmpeg(*("-display_rotation", "180", "-i", clip, "-c", "copy"), tmp_path / "t.mp4")
    folder, database = save(tmp_path / "stored", cut[::5]), tmp_path / "a.db"
    pycolmap.Database.open(database).close()
    pycolmap.import_images(database, folder, pycolmap.CameraMode.SINGLE)
    for name in missing:
        (folder / name).unlink()
    report = match(database, turned, image_path=folder, options=_every(5))
    assert report.num_written_images == len(missing)
    np.testing.assert_array_equal(cv2.imread(str(folder / "x0.png")), cut[0])


def test_images_that_another_program_numbered_from_1_are_not_of_an_earlier_run(
    clip: Path, ffmpeg: Ffmpeg, tmp_path: Path
) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    ffmpeg("-i", clip, "-vf", "fps=5", folder / "frame_%06d.png")
    before = sorted(folder.iterdir())
    for choice in (ImageOptions(fps=5), ImageOptions(num_images=3)):
        with pytest.raises(OptionError, match="exist"):
            match(tmp_path / "a.db", clip, image_path=folder, options=replace(DENSE, images=choice))
    assert sorted(folder.iterdir()) == before
    assert match(tmp_path / "a.db", clip, image_path=folder, options=DENSE).num_images > 2

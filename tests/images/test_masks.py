"""Masks select which pixels of frames and images are used."""

from __future__ import annotations

import sqlite3
from dataclasses import replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pytest
from conftest import Encode, make_frames
from databases import keypoints_of
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from colmap_av1.cli import main
from colmap_av1.database.reading import image_ids_from_pair_id
from colmap_av1.errors import ColmapAv1Error, ImageError
from colmap_av1.geometry.masks import Mask, make_mask
from colmap_av1.images.masks import mask_tracks, read_masks
from colmap_av1.match import match
from colmap_av1.options import DensityOptions, ImageOptions, LinkOptions, MaskOptions, MatchOptions
from colmap_av1.tracks.tracks import Tracks

WIDTH, HEIGHT, NUM_FRAMES = 192, 128, 16
# Excludes most of the left half.
LEFT = np.full((HEIGHT, WIDTH), 255, np.uint8)
LEFT[:100, :90] = 0


def options(path: Path, **images: object) -> MatchOptions:
    return MatchOptions(masks=MaskOptions(mask_path=path), images=ImageOptions(**images))


def write(path: Path, mask: NDArray[np.uint8]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), mask)
    return path


def positions(database: Path) -> dict[str, NDArray[np.int64]]:
    """The keypoints of each image, rounded down to pixels."""
    return {name: xy.astype(np.int64) for name, xy in keypoints_of(database).items()}


def num_on_black(xy: NDArray[np.int64], mask: NDArray[np.uint8]) -> int:
    return int(np.count_nonzero(mask[xy[:, 1], xy[:, 0]] == 0))


@pytest.fixture(scope="module")
def whole(clip: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, NDArray[np.int64]]:
    """Keypoints without masks."""
    database = tmp_path_factory.mktemp("whole") / "a.db"
    match(database, clip)
    return positions(database)


def test_single_mask_applies_to_all_frames(
    clip: Path, whole: dict[str, NDArray[np.int64]], tmp_path: Path
) -> None:
    mask = write(tmp_path / "mask.png", LEFT)
    match(tmp_path / "a.db", clip, options=options(mask))
    found = positions(tmp_path / "a.db")
    assert found.keys() == whole.keys()
    for name, xy in found.items():
        assert num_on_black(whole[name], LEFT) > 50
        assert num_on_black(xy, LEFT) == 0
        # Apart from the black pixels, only tracks that cross the edge are lost.
        assert len(xy) > 0.8 * (len(whole[name]) - num_on_black(whole[name], LEFT))


def test_masks_of_images_are_read_in_each_layout(clip: Path, tmp_path: Path) -> None:
    """COLMAP appends .png to the image name; trainers replace the extension by .png."""
    names = [f"frame_{i:06d}.jpg" for i in range(0, NUM_FRAMES, 3)]
    found = []
    for layout, ending in (("colmap", ".jpg.png"), ("of_png", ".png.png"), ("trainers", ".png")):
        for i, name in enumerate(names):
            file = Path(name).stem + ending
            write(tmp_path / layout / file, LEFT if i == 0 else LEFT * 0 + 1)
        how = options(tmp_path / layout, every=3, image_name="frame_%06d.jpg")
        match(tmp_path / f"{layout}.db", clip, options=how)
        found.append(positions(tmp_path / f"{layout}.db"))
    assert list(found[0]) == names
    for i, name in enumerate(names):
        assert (num_on_black(found[0][name], LEFT) == 0) == (i == 0)
        assert all(np.array_equal(found[0][name], other[name]) for other in found[1:])


@pytest.mark.parametrize("preset", ["default", "dense"])
def test_masks_of_frames_end_tracks_between_images(
    preset: Literal["default", "dense"], clip: Path, tmp_path: Path
) -> None:
    """No track crosses a frame with a black mask, even if the frame is not an image.

    With many tracks, some are not observed in this frame, but before and after it.
    """
    for i in range(NUM_FRAMES):
        write(tmp_path / "masks" / f"{i + 1}.png", LEFT * 0 if i == 7 else LEFT * 0 + 255)
    how = replace(
        options(tmp_path / "masks", every=2),
        links=LinkOptions(links="none"),
        density=DensityOptions(preset=preset),
    )
    match(tmp_path / "a.db", clip, options=how)
    crossing = []
    for name in ("a", "b"):
        if name == "b":
            match(tmp_path / "b.db", clip, options=replace(how, masks=MaskOptions()))
        with sqlite3.connect(tmp_path / f"{name}.db") as database:
            pairs = [
                image_ids_from_pair_id(i)
                for (i,) in database.execute("SELECT pair_id FROM matches")
            ]
        crossing.append([(i, j) for i, j in pairs if i <= 4 < j])
    assert crossing[0] == []
    assert crossing[1] != []
    report = match(tmp_path / "c.db", clip, options=options(tmp_path / "masks", every=2))
    assert report.links.frames_of_gaps() == [(6, 8)]


def test_only_black_pixels_are_excluded(
    clip: Path, whole: dict[str, NDArray[np.int64]], tmp_path: Path
) -> None:
    """Dark colours and transparent pixels are not excluded."""
    dark = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
    dark[..., 0] = 1
    match(tmp_path / "a.db", clip, options=options(write(tmp_path / "dark.png", dark)))
    found = positions(tmp_path / "a.db")
    assert all(np.array_equal(found[name], xy) for name, xy in whole.items())


def test_a_mask_in_the_alpha_channel_is_refused(clip: Path, tmp_path: Path) -> None:
    white = np.full((HEIGHT, WIDTH, 4), 255, np.uint8)
    white[..., 3] = LEFT
    with pytest.raises(ImageError, match="alpha"):
        match(tmp_path / "a.db", clip, options=options(write(tmp_path / "rgba.png", white)))


def test_links_use_no_features_on_masks(encode: Encode, tmp_path: Path) -> None:
    """SIFT features at gaps in the motion respect the masks."""
    frames = make_frames(12)
    frames[6:] = make_frames(24)[18:]
    clip = encode(frames, tmp_path / "jerk.mp4")
    mask = write(tmp_path / "mask.png", LEFT)
    report = match(tmp_path / "a.db", clip, options=options(mask))
    assert report.links.num_images > 0
    assert sum(num_on_black(xy, LEFT) for xy in positions(tmp_path / "a.db").values()) == 0


def bad_masks(kind: str, folder: Path) -> Path:
    """Masks that do not fit a clip of 16 frames of 192x128."""
    if kind == "size":
        return write(folder / "small.png", LEFT[:64])
    if kind == "number":
        for i in range(NUM_FRAMES - 2):
            write(folder / "some" / f"mask{i}.png", LEFT)
        return folder / "some"
    if kind == "images":
        for i in range(NUM_FRAMES - 2):
            write(folder / "named" / f"frame_{i:06d}.png.png", LEFT)
        return folder / "named"
    if kind == "black":
        for i in range(NUM_FRAMES):
            write(folder / "black" / f"{i}.png", LEFT * 0)
        return folder / "black"
    if kind == "text":
        (folder / "text.png").write_text("no picture")
        return folder / "text.png"
    if kind == "cut":
        data = write(folder / "whole.png", LEFT).read_bytes()
        (folder / "cut.png").write_bytes(data[:40])
        return folder / "cut.png"
    if kind == "empty":
        (folder / "empty").mkdir()
        return folder / "empty"
    return folder / "missing"


WORDS = {
    "size": "192x64",
    "number": "frame_000000.png.png",
    "images": "frame_000014.png.png",
    "black": "black",
    "text": "read",
    "cut": "read",
    "empty": "PNG",
    "missing": "no such",
}


@pytest.mark.parametrize("kind", WORDS)
def test_unusable_masks_are_refused_in_one_line(
    kind: str,
    clip: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def long_work(*_: object, **__: object) -> None:
        raise AssertionError("masks are refused before the long work")

    monkeypatch.setattr("colmap_av1.images.preparing.track_chosen_images", long_work)
    path = bad_masks(kind, tmp_path)
    words = ["match", "--database", str(tmp_path / "a.db"), "--video", str(clip)]
    assert main([*words, f"--mask_path={path}"]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert str(path) in lines[0]
    assert WORDS[kind] in lines[0]
    assert not (tmp_path / "a.db").exists()


def test_each_video_has_its_own_masks(tmp_path: Path) -> None:
    for name in ("a/1.png", "a/2.png", "b/x.jpg.png", "photos/y.png"):
        write(tmp_path / name, LEFT)
    write(tmp_path / ".thumbnails/1.png", LEFT[::2, ::2])
    masks = read_masks(tmp_path, ["a", "b", "c"], [2, 2, 2], ["photos/y.jpg", "photos/z.jpg"])
    a, b = masks.of_video("a"), masks.of_video("b")
    assert a is not None
    assert b is not None
    assert len(a.of_frames) == 2
    assert list(b.of_images or {}) == ["x.jpg"]
    assert masks.of_video("c") is None
    assert masks.of_photo("photos/y.jpg", (WIDTH, HEIGHT)) is not None
    assert masks.of_photo("photos/z.jpg", (WIDTH, HEIGHT)) is None
    with pytest.raises(ImageError, match="10x10"):
        masks.of_photo("photos/y.jpg", (10, 10))
    with pytest.raises(ColmapAv1Error, match="no mask"):
        read_masks(tmp_path, ["d", "e"], [2, 2])


@pytest.mark.parametrize("names", [("1.png", "2.png"), ("x.jpg.png", "y.jpg.png")])
def test_masks_of_photos_are_not_masks_of_the_only_video(
    names: tuple[str, ...], tmp_path: Path
) -> None:
    for name in (*names, "photos/z.PNG"):
        write(tmp_path / name, LEFT)
    masks = read_masks(tmp_path, [""], [2], ["photos/z.jpg"])
    own = masks.of_video("")
    assert own is not None
    assert len(own.of_frames) + len(own.of_images or {}) == 2
    assert masks.of_photo("photos/z.jpg", (WIDTH, HEIGHT)) is not None


@given(
    st.integers(1, 40),
    st.integers(1, 30),
    st.integers(0, 2**31),
)
def test_masks_are_stored_exactly(width: int, height: int, seed: int) -> None:
    kept = np.random.default_rng(seed).random((height, width)) < 0.5
    mask = make_mask(kept)
    assert np.array_equal(mask.kept, kept)
    y, x = np.mgrid[0:height, 0:width].reshape(2, -1) + 0.5
    xy = np.column_stack([x, y]).astype(np.float32)
    assert np.array_equal(mask.keeps(xy, mask.size), kept.ravel())
    assert np.array_equal(mask.keeps(2 * xy, (2 * width, 2 * height)), kept.ravel())
    edge = np.array([[width, height]], np.float32)
    assert mask.keeps(edge, mask.size) == kept[-1, -1]


@given(st.lists(st.lists(st.booleans(), min_size=1, max_size=9), min_size=1, max_size=6))
def test_tracks_are_cut_at_masks(tracks: list[list[bool]]) -> None:
    """Each observation is on a white or a black pixel; the runs on white pixels remain."""
    flat = np.concatenate([np.array(t) for t in tracks])
    mask = make_mask(np.array([[True, False]]))
    n = len(flat)
    given_tracks = Tracks(
        num_frames=9,
        width=2,
        height=1,
        offsets=np.cumsum([0, *map(len, tracks)]),
        frame=np.concatenate([np.arange(len(t)) for t in tracks]).astype(np.int32),
        xy=np.column_stack([np.where(flat, 0.5, 1.5), np.full(n, 0.5)]).astype(np.float32),
        sigma=np.arange(n, dtype=np.float32),
        confirmed=np.zeros(n, np.bool_),
    )
    runs, at = [], 0
    for track in tracks:
        run: list[int] = []
        for white in [*track, False]:
            if white:
                run.append(at)
            elif run:
                runs.append(run)
                run = []
            at += 1
        at -= 1
    masks: list[Mask | dict[int, Mask]] = [mask, dict.fromkeys(range(9), mask)]
    for least in (1, 2):
        wanted = [run for run in runs if len(run) >= least or flat.all()]
        for given_masks in masks:
            found = mask_tracks(given_tracks, given_masks, least)
            pieces = np.split(found.sigma.astype(int), found.offsets[1:-1])
            assert [p.tolist() for p in pieces if len(p)] == wanted


@given(
    st.lists(st.sets(st.integers(0, 8), min_size=1), min_size=1, max_size=6),
    st.dictionaries(st.integers(0, 8), st.lists(st.booleans(), min_size=4, max_size=4)),
    st.integers(0, 2**31),
)
def test_tracks_are_cut_at_masks_of_frames_between_observations(
    frames: list[set[int]], white: dict[int, list[bool]], seed: int
) -> None:
    """Between two observations, a track is assumed to move along a straight line."""
    seen = [sorted(own) for own in frames]
    lengths = [len(own) for own in seen]
    # Neither these positions nor interpolated ones are on the edges of pixels.
    x = np.random.default_rng(seed).integers(0, 4, sum(lengths)) + np.float32(0.45)
    given_tracks = Tracks(
        num_frames=9,
        width=4,
        height=1,
        offsets=np.cumsum([0, *lengths]),
        frame=np.concatenate(seen).astype(np.int32),
        xy=np.column_stack([x, np.full(len(x), 0.5, np.float32)]),
        sigma=np.arange(len(x), dtype=np.float32),
        confirmed=np.zeros(len(x), np.bool_),
    )
    masks = {frame: make_mask(np.array([row])) for frame, row in white.items()}
    pieces: list[list[int]] = []
    at = 0
    for own in seen:
        piece: list[int] = []
        for k, frame in enumerate(own):
            before = own[k - 1] if k else frame
            passed = range(before + 1, frame + 1) if k else [frame]
            where = np.interp(passed, [before, frame], [x[at - 1], x[at]]) if k else [x[at]]
            counts = [
                white.get(f, [True] * 4)[int(to)] for f, to in zip(passed, where, strict=True)
            ]
            if not all(counts):
                pieces.append(piece)
                piece = []
            if counts[-1]:
                piece.append(at)
            at += 1
        pieces.append(piece)
    found = mask_tracks(given_tracks, masks, 1)
    split = np.split(found.sigma.astype(int), found.offsets[1:-1])
    assert [p.tolist() for p in split if len(p)] == [p for p in pieces if p]

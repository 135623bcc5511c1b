"""Messages name the cause of an error in one line."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import PROJECT, Encode, Ffmpeg, make_frames

from colmap_av1.cli import main
from colmap_av1.database.reading import read_images
from colmap_av1.errors import ColmapAv1Error
from colmap_av1.geometry.colmap_model import read_model
from colmap_av1.images.files import image_size, read_image
from colmap_av1.interop.hloc import read_hloc
from colmap_av1.video.container import open_stream
from colmap_av1.video.encode import stream_of

LAYERS = PROJECT / "tests" / "data" / "conformance" / "svc_L2T1.ivf"
posix = pytest.mark.skipif(os.name != "posix", reason="Windows has no such files or users")


def error_of(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """The one-line error message of a command that refuses its input."""
    try:
        status: object = main(words)
    except SystemExit as end:  # raised by argparse
        status = end.code
    out, err = capsys.readouterr()
    assert (status, out, err.count("\n")) == (2, "", 1)
    return err


@posix
def test_pipes_are_refused(clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pipe, database = str(tmp_path / "pipe"), str(tmp_path / "a.db")
    os.mkfifo(pipe)
    for command in (["info"], ["match", "--database", database], ["encode", "--output", "x.mp4"]):
        error = error_of([*command, "--video", pipe], capsys)
        assert "pipe" in error
    words = ["match", "--database", database, "--video", str(clip), "--frame_list", pipe]
    assert "regular file" in error_of(words, capsys)
    assert os.listdir(tmp_path) == ["pipe"]


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_lists_may_have_a_byte_order_mark(clip: Path, tmp_path: Path, encoding: str) -> None:
    (tmp_path / "list.txt").write_text("0 é0.png\n5 é5.png\n9 é9.png\n", encoding=encoding)
    words = ["match", "--database", str(tmp_path / "a.db"), "--video", str(clip), "--quiet"]
    assert main([*words, "--frame_list", str(tmp_path / "list.txt")]) == 0
    names = [image.name for image in read_images(tmp_path / "a.db")]
    assert names == ["é0.png", "é5.png", "é9.png"]


@pytest.mark.parametrize(
    ("words", "remedy"),
    [
        (["--cosine", "-1e-3"], "--cosine=-1e-3"),
        (["--camera-params", "-1,2,3"], "--camera_params=-1,2,3"),
        (["--image_name", "-x%d.png"], "--image_name=-x%d.png"),
        (["--database", "-a.db"], "--database=-a.db"),
    ],
)
def test_values_that_look_like_options_are_explained(
    words: list[str], remedy: str, capsys: pytest.CaptureFixture[str]
) -> None:
    error = error_of(["match", "--video", "none.mp4", "--database", "a.db", *words], capsys)
    assert remedy in error


@pytest.mark.parametrize(
    "words",
    [
        ["match", "--video", "v.mp4", "--database", "a.db", "--image_path", ""],
        ["match", "--video", "v.mp4", "--database", "a.db", "--mask_path="],
        ["reconstruct", "--video", "v.mp4", "--output", ""],
        ["batch", "--task", "info", "--inputs", "v.mp4", "", "--output", "out"],
        ["batch", "--task", "match", "--inputs", "v.mp4", "--output", "out", "--mask_path="],
        ["view", "--model", "", "--output", "out.html"],
    ],
)
def test_empty_paths_are_refused(
    words: list[str],
    tmp_path: Path,
    clip: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Unset shell variables cause empty paths."""
    monkeypatch.chdir(tmp_path)
    shutil.copyfile(clip, "v.mp4")
    assert "empty" in error_of(words, capsys)
    assert os.listdir() == ["v.mp4"]


def test_negative_numbers_are_accepted_as_values(capsys: pytest.CaptureFixture[str]) -> None:
    for words in (["--cosine", "-0.5"], ["--cosine=-1e-3"], ["--cosine", "-1"]):
        error = error_of(["match", "--video", "none.mp4", "--database", "a.db", *words], capsys)
        assert "none.mp4" in error


def test_invalid_operating_points_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    for command in (["info"], ["match", "--database", "a.db"], ["reconstruct", "--output", "out"]):
        error = error_of([*command, "--video", "none.mp4", "--operating_point", "99"], capsys)
        assert "operating_point" in error


def test_operating_points_missing_in_the_stream_are_refused(
    clip: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for video, point in ((clip, 1), (LAYERS, 2)):
        error = error_of(["info", "--video", str(video), "--operating_point", str(point)], capsys)
        assert f"operating_point {point}" in error


def test_unknown_colour_space_does_not_prevent_matching(
    clip: Path, ffmpeg: Ffmpeg, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With reserved matrix coefficients, motion is read but pictures cannot be converted."""
    reserved = ffmpeg(
        *("-i", clip, "-c", "copy", "-bsf:v", "av1_metadata=matrix_coefficients=3"),
        tmp_path / "v.mp4",
    )
    words = ["match", "--quiet", "--video", str(reserved), "--database"]
    assert main([*words, str(tmp_path / "a.db")]) == 0
    with_images = [*words, str(tmp_path / "b.db"), "--image_path", str(tmp_path / "images")]
    assert "colour matrix" in error_of(with_images, capsys)
    assert sorted(os.listdir(tmp_path)) == ["a.db", "v.mp4"]


def test_info_of_a_single_frame(
    encode: Encode, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    video = encode(make_frames(1), tmp_path / "one.mp4")
    assert main(["info", "--video", str(video)]) == 0
    table = dict(line.split("\t") for line in capsys.readouterr().out.splitlines())
    assert "nan" not in " ".join(table.values())
    assert table["median motion"] == "none"
    assert table["for matching"] != "good"


@pytest.fixture
def others(clip: Path) -> Iterator[Path]:
    """A folder of files that this process may not read without root permissions."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shutil.copyfile(clip, folder / "v.mp4")
        cv2.imwrite(str(folder / "a.png"), np.zeros((8, 8, 3), np.uint8))
        for file in ("a.h5", "s.mp4", "cameras.bin", "images.bin", "points3D.bin"):
            (folder / file).write_bytes(b"content")
        for file in folder.iterdir():
            file.chmod(0)
        shutil.copyfile(clip, folder / "open.mp4")
        folder.chmod(0o755)
        user = os.geteuid()
        if user == 0:
            os.seteuid(65534)
        try:
            yield folder
        finally:
            os.seteuid(user)


READERS: list[tuple[str, Callable[[Path], object]]] = [
    ("a.png", lambda folder: image_size(folder / "a.png")),
    ("a.png", lambda folder: read_image(folder / "a.png")),
    ("a.h5", lambda folder: read_hloc(folder / "a.h5", folder / "a.h5")),
    ("cameras.bin", read_model),
    ("v.mp4", lambda folder: open_stream(folder / "v.mp4")),
    ("s.mp4", lambda folder: stream_of(folder / "open.mp4", folder / "s.mp4")),
]


@posix
@pytest.mark.parametrize(("name", "read"), READERS)
def test_unreadable_files_are_reported(
    name: str, read: Callable[[Path], object], others: Path
) -> None:
    with pytest.raises(ColmapAv1Error, match=f"{name}: .*permission"):
        read(others)

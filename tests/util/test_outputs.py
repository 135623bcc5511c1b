"""What may be written over, whatever names lead to it."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from colmap_av1.errors import OptionError
from colmap_av1.util.outputs import check_files, check_folder


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder to work in, with an input file, a folder of inputs and a file of nobody."""
    (tmp_path / "images" / "far").mkdir(parents=True)
    for name in ("video.mp4", "images/a.png", "images/far/b.png", "notes.txt", "own.txt"):
        (tmp_path / name).write_text(name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def check(output: str | Path, *, overwrite: bool = False) -> None:
    check_files(
        [Path(output)],
        ["video.mp4", "images", None, "absent"],
        is_own=lambda path: path.name == "own.txt",
        overwrite=overwrite,
    )


def test_what_exists_is_kept_unless_it_is_own_or_told_otherwise(folder: Path) -> None:
    check("new.txt")
    check("own.txt")
    check("images/new.txt")
    check("notes.txt", overwrite=True)
    with pytest.raises(OptionError, match=r"notes.txt: exists: give another output, or --overwr"):
        check("notes.txt")
    for output in ("images", os.devnull):
        with pytest.raises(OptionError, match="exists and is no file"):
            check(output, overwrite=True)


@pytest.mark.parametrize(
    "output",
    ["video.mp4", "./video.mp4", "images/../video.mp4", "link", "hard", "linked/video.mp4"],
)
def test_an_input_is_refused_by_any_name(folder: Path, output: str) -> None:
    (folder / "link").symlink_to("video.mp4")
    (folder / "hard").hardlink_to("video.mp4")
    (folder / "linked").symlink_to(".", target_is_directory=True)
    for path in (Path(output), folder / output):
        with pytest.raises(OptionError, match="is the input itself"):
            check(path, overwrite=True)


@pytest.mark.parametrize(
    "output", ["images/a.png", "images/far/b.png", "pictures/a.png", "link", "hard"]
)
def test_a_file_of_a_folder_that_is_read_is_refused(folder: Path, output: str) -> None:
    (folder / "pictures").symlink_to("images", target_is_directory=True)
    (folder / "link").symlink_to("images/far/b.png")
    (folder / "hard").hardlink_to("images/far/b.png")
    with pytest.raises(OptionError, match="is read, in images"):
        check(output, overwrite=True)


def test_a_link_within_a_folder_that_is_read_protects_what_it_leads_to(folder: Path) -> None:
    (folder / "images" / "link.png").symlink_to(folder / "notes.txt")
    (folder / "hard.txt").hardlink_to("notes.txt")
    with pytest.raises(OptionError, match="is read, in images"):
        check("hard.txt", overwrite=True)


def test_folders_that_are_or_hold_an_input(folder: Path) -> None:
    (folder / "here").symlink_to(".", target_is_directory=True)
    check_folder(Path("new"), ["video.mp4", "images", None])
    check_folder(Path("images/far/new"), ["video.mp4", "images"])
    check_folder(Path("images/far"), ["images/far/../a.png", "images/far/../../video.mp4"])
    for output in ("images", ".", "here", "images/..", folder):
        with pytest.raises(OptionError, match="is or holds the input images"):
            check_folder(Path(output), ["images"])
    with pytest.raises(OptionError, match="is or holds the input"):
        check_folder(Path("absent"), [folder / "absent" / "images"])

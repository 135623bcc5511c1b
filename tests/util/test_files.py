from __future__ import annotations

import errno
import os
import re
import sys
import threading
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from killed_runs import kill_while_replacing, kill_while_writing

from colmap_av1.errors import OptionError
from colmap_av1.options.images import LONGEST_NAME
from colmap_av1.util.files import (
    check_apart,
    check_new_file,
    check_new_folder,
    remove_leftovers,
    scratch_folder,
    whole_file,
    whole_folder,
)
from colmap_av1.util.stages import open_stages

locks = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such file locks")
ANY = re.compile(".*")


def names_in(folder: Path) -> list[str]:
    return sorted(os.listdir(folder))


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with an input file, a folder of inputs and an unrelated file."""
    (tmp_path / "images" / "far").mkdir(parents=True)
    for name in ("video.mp4", "images/a.png", "notes.txt"):
        (tmp_path / name).write_text(name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_existing_files_are_refused_without_overwrite(folder: Path) -> None:
    check_new_file(Path("new.txt"), ["video.mp4", "absent", None])
    check_new_file(Path("notes.txt"), ["video.mp4"], overwrite=True)
    with pytest.raises(OptionError, match="--overwrite"):
        check_new_file(Path("notes.txt"))
    for output in ("images", os.devnull):
        with pytest.raises(OptionError, match="is not a file"):
            check_new_file(Path(output), overwrite=True)


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have other limits")
def test_hidden_file_of_the_longest_name_is_created(tmp_path: Path) -> None:
    longest = "x" * LONGEST_NAME
    with whole_file(tmp_path / longest):
        pass
    assert names_in(tmp_path) == [longest]
    with pytest.raises(OSError, match="too long"), whole_file(tmp_path / f"{longest}x"):
        pass


@pytest.mark.parametrize("output", ["video.mp4", "images/../video.mp4", "link", "hard"])
def test_input_is_refused_as_output_under_any_name(folder: Path, output: str) -> None:
    (folder / "link").symlink_to("video.mp4")
    (folder / "hard").hardlink_to("video.mp4")
    for path in (Path(output), folder / output):
        with pytest.raises(OptionError, match="input"):
            check_new_file(path, ["video.mp4"], overwrite=True)


def test_folders_that_contain_an_input_are_refused(folder: Path) -> None:
    (folder / "here").symlink_to(".", target_is_directory=True)
    check_apart(Path("new"), ["video.mp4", "images", None])
    check_apart(Path("images/far/new"), ["video.mp4", "images"])
    for output in ("images", ".", "here", "images/..", folder):
        with pytest.raises(OptionError, match="input images"):
            check_apart(Path(output), ["images"])
    with pytest.raises(OptionError, match="input"):
        check_apart(Path("absent"), [folder / "absent" / "images"])


def test_folder_appears_when_complete(tmp_path: Path) -> None:
    output = tmp_path / "new" / "model"
    with whole_folder(output) as partial:
        (partial / "points").write_text("1")
        assert not output.exists()
    assert (output / "points").read_text() == "1"
    assert list(output.parent.iterdir()) == [output]
    with pytest.raises(KeyError), whole_folder(tmp_path / "other") as partial:
        {}[(partial / "points").write_text("2")]
    assert [p.name for p in tmp_path.iterdir()] == ["new"]


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no locks")
@pytest.mark.parametrize("write", [whole_file, whole_folder, scratch_folder])
def test_interrupt_before_the_body_leaves_nothing(
    write: Callable[[Path], Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(_: int) -> bool:
        raise KeyboardInterrupt

    monkeypatch.setattr("colmap_av1.util.files._lock", interrupt)
    with pytest.raises(KeyboardInterrupt), write(tmp_path / "output"):
        pytest.fail("the body runs")
    assert not list(tmp_path.iterdir())


def test_existing_folder_is_filled(tmp_path: Path) -> None:
    output = tmp_path / "model"
    output.mkdir()
    (tmp_path / "link").symlink_to("model")
    number = output.stat().st_ino
    for content in ("1", "2"):
        with whole_folder(tmp_path / "link", ANY if content == "2" else None) as partial:
            (partial / f"points{content}").write_text(content)
            (partial / "0").mkdir()
        assert sorted(p.name for p in output.iterdir()) == ["0", f"points{content}"]
    assert output.stat().st_ino == number
    assert sorted(p.name for p in tmp_path.iterdir()) == ["link", "model"]
    with pytest.raises(KeyError), whole_folder(output, ANY) as partial:
        {}[(partial / "points3").write_text("3")]
    assert (output / "points2").read_text() == "2"


@pytest.mark.parametrize("number", range(7))
def test_interrupted_exchange_keeps_the_old_content(
    tmp_path: Path, number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The interrupt comes before one of seven moves: of three old and of four new files."""
    output = tmp_path / "model"
    output.mkdir()
    for name in ("0", "1", "2"):
        (output / name).write_text("old")
    calls = count()
    move = Path.replace

    def interrupted(entry: Path, target: Path) -> Path:
        if next(calls) == number:
            raise KeyboardInterrupt
        return move(entry, target)

    def replace_content() -> None:
        with whole_folder(output, ANY) as partial:
            for name in ("0", "1", "2", "3"):
                (partial / name).write_text("new")
            monkeypatch.setattr(Path, "replace", interrupted)

    with pytest.raises(KeyboardInterrupt):
        replace_content()
    monkeypatch.undo()
    remove_leftovers(tmp_path)
    assert {path.name: path.read_text() for path in output.iterdir()} == dict.fromkeys("012", "old")
    assert [path.name for path in tmp_path.iterdir()] == ["model"]


@pytest.mark.parametrize("is_there", [False, True])
def test_file_written_meanwhile_by_another_program_is_kept(tmp_path: Path, is_there: bool) -> None:
    output = tmp_path / "a.mp4"
    if is_there:
        output.write_text("old")

    def write_both() -> None:
        with whole_file(output) as ours, whole_file(output) as theirs:
            ours.write_text("ours")
            theirs.write_text("theirs")

    with pytest.raises(FileExistsError, match="meanwhile"):
        write_both()
    assert output.read_text() == "theirs"
    assert names_in(tmp_path) == ["a.mp4"]


@pytest.mark.parametrize("is_there", [False, True])
@pytest.mark.parametrize("own", [None, re.compile("points")])
def test_folder_written_meanwhile_by_another_program_is_kept_like_the_new_content(
    tmp_path: Path, is_there: bool, own: re.Pattern[str] | None
) -> None:
    output = tmp_path / "model"
    if is_there:
        output.mkdir()
        (output / "points").write_text("old")

    def write_both() -> None:
        with whole_folder(output, own) as partial:
            (partial / "points").write_text("new")
            (output / "checkpoints").mkdir(parents=True)
            (output / "checkpoints" / "30000.ckpt").touch()

    with pytest.raises(FileExistsError, match="meanwhile") as refused:
        write_both()
    assert (output / "checkpoints" / "30000.ckpt").exists()
    assert not is_there or (output / "points").read_text() == "old"
    (kept,) = {*names_in(tmp_path)} - {"model"}
    assert kept in str(refused.value)
    remove_leftovers(tmp_path)
    assert (tmp_path / kept / "points").read_text() == "new"


@locks
@pytest.mark.parametrize("how", ["whole_file", "whole_folder", "scratch_folder"])
def test_leftovers_of_killed_processes_are_removed(how: str, tmp_path: Path) -> None:
    for name in ("model [1]", "other"):
        kill_while_writing(how, tmp_path / name)
    assert len(names_in(tmp_path)) == 2
    with whole_file(tmp_path / "model [1]"):
        remove_leftovers(tmp_path, "model [1]")
        # Files that are being written are kept, also those of other threads or processes.
        assert len(names_in(tmp_path)) == 2
    assert [name for name in names_in(tmp_path) if "other" not in name] == ["model [1]"]
    remove_leftovers(tmp_path)
    assert names_in(tmp_path) == ["model [1]"]


@locks
@pytest.mark.parametrize("how", [whole_file, scratch_folder])
def test_files_being_written_are_not_leftovers(how: Callable[[Path], Any], tmp_path: Path) -> None:
    """Shards of a batch start at the same time in one folder, and each removes leftovers there."""
    ended = threading.Event()

    def look() -> None:
        while not ended.is_set():
            remove_leftovers(tmp_path)

    thread = threading.Thread(target=look)
    thread.start()
    try:
        for _ in range(300):
            with how(tmp_path / "video") as partial:
                assert partial.exists()
                (partial if partial.is_file() else partial / "points").write_text("1")
    finally:
        ended.set()
        thread.join()


@locks
def test_files_of_other_programs_are_kept(tmp_path: Path) -> None:
    """Even if their names look like leftovers."""
    others = [".model.1.partial", ".model.99999999999999999999999.partial", ".model.partial"]
    others += [".model.x.partial", ".model.colmap-av1-0000ffffffff.partial"]
    for name in others:
        (tmp_path / name).mkdir()
        (tmp_path / name / "mine").touch()
    remove_leftovers(tmp_path)
    remove_leftovers(tmp_path, "model")
    with scratch_folder(tmp_path / "model"):
        pass
    assert names_in(tmp_path) == sorted(others)
    assert all(names_in(tmp_path / name) == ["mine"] for name in others)


@locks
@pytest.mark.parametrize("steps", range(9))
def test_killed_replacement_keeps_the_old_or_new_content(steps: int, tmp_path: Path) -> None:
    output = tmp_path / "model"
    output.mkdir()
    old, new = {"a": "old", "b": "old"}, {"a": "new", "c": "new"}
    for name, text in old.items():
        (output / name).write_text(text)
    kill_while_replacing(output, steps)
    remove_leftovers(tmp_path, "model")
    assert {p.name: p.read_text() for p in output.iterdir()} in (old, new)
    assert names_in(tmp_path) == ["model"]


@locks
def test_files_added_to_a_half_replaced_folder_are_kept(tmp_path: Path) -> None:
    output = tmp_path / "model"
    output.mkdir()
    (output / "a").write_text("old")
    kill_while_replacing(output, 2)
    (output / "a").write_text("mine")
    remove_leftovers(tmp_path, "model")
    assert (output / "a").read_text() == "mine"
    texts = [p.read_text() for p in tmp_path.rglob("a")]
    assert sorted(texts) == ["mine", "old"]


def test_folder_with_other_files_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "a.bin").touch()
    own = re.compile(r"\w+\.bin")
    with pytest.raises(OptionError, match="--overwrite"):
        check_new_folder(tmp_path / "model", own)
    check_new_folder(tmp_path / "model", own, overwrite=True)
    (tmp_path / "model" / "notes.txt").touch()
    with pytest.raises(OptionError, match=r"notes.txt"):
        check_new_folder(tmp_path / "model", own, overwrite=True)


def test_mount_point_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rename = Path.rename

    def on_mounts(source: Path, target: Path) -> Path:
        if source.parent != target.parent:
            raise OSError(errno.EXDEV, os.strerror(errno.EXDEV))
        return rename(source, target)

    (tmp_path / "out").mkdir()
    check_new_folder(tmp_path / "out", ANY)
    monkeypatch.setattr(Path, "rename", on_mounts)
    check_new_folder(tmp_path / "out" / "new", ANY)
    with pytest.raises(OptionError, match="mount"):
        check_new_folder(tmp_path / "out", ANY)
    assert [*tmp_path.rglob("*")] == [tmp_path / "out"]


@locks
def test_second_run_in_the_same_folder_is_refused(tmp_path: Path) -> None:
    output = tmp_path / "out"
    with open_stages(output, "a"):
        with (
            pytest.raises(OptionError, match="another run"),
            open_stages(output, "a"),
        ):
            pass
        with open_stages(tmp_path / "other", "a"):
            pass
    with pytest.raises(OptionError, match="output of a"), open_stages(output, "b"):
        pass
    kill_while_writing("whole_file", output / "report.json")
    with open_stages(output, "a"):
        assert names_in(output) == [".stages"]

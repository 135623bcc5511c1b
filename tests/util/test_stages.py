from __future__ import annotations

import itertools
import json
import os
import re
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from colmap_av1.errors import OptionError
from colmap_av1.options import MapOptions, MatchOptions, ReadOptions, RunOptions
from colmap_av1.util import digests, stages
from colmap_av1.util.digests import code_digest, digest_of, file_digest
from colmap_av1.util.stages import Kept, open_stages, run_stage, run_stage_in


@dataclass(frozen=True)
class Found:
    found: int
    sizes: tuple[int, ...]


@dataclass
class Twice:
    """A stage of either kind in a folder, with a count of its runs."""

    folder: Path
    run: Callable[..., Kept]
    record: Path
    products: list[Path]
    calls: int = 0
    stop: bool = False


@pytest.fixture(params=["aside", "in place"])
def stage(request: pytest.FixtureRequest, tmp_path: Path) -> Twice:
    """A stage that writes an .npz file and two images and was run once."""

    def make(folder: Path) -> Found:
        twice.calls += 1
        (folder / "images").mkdir()
        for name in ("a.png", "b.png"):
            (folder / "images" / name).write_bytes(name.encode() * 1000)
        if twice.stop:
            raise KeyboardInterrupt
        np.savez(folder / "tracks.npz", xy=np.arange(1000.0))
        return Found(3, (1, 2))

    def run_aside(depends_on: Any = "same") -> Kept:
        with open_stages(tmp_path / "out", "test") as folder:
            return run_stage(
                folder,
                "tracks",
                [depends_on],
                Found,
                into=tmp_path / "out",
                products=["images", "tracks.npz"],
                make=make,
            )

    def run_in_place(depends_on: Any = "same", **how: Any) -> Kept:
        folder = tmp_path / "out"
        products = [folder / "images", folder / "tracks.npz"]
        return run_stage_in(
            folder, [depends_on], Found, lambda: make(folder), products=products, **how
        )

    folder = tmp_path / "out"
    aside = request.param == "aside"
    twice = Twice(
        folder,
        run_aside if aside else run_in_place,
        folder / (".stages/tracks.json" if aside else "result.json"),
        [folder / "images" / "a.png", folder / "images" / "b.png", folder / "tracks.npz"],
    )
    first = twice.run()
    assert not first.resumed
    assert first.result == Found(3, (1, 2))
    return twice


def check_resumed(stage: Twice) -> None:
    before = stage.calls
    assert stage.run().resumed
    assert stage.calls == before


def check_made_again(stage: Twice) -> None:
    """Check that the stage runs once more and gives the same products."""
    before = stage.calls
    again = stage.run()
    assert not again.resumed
    assert stage.calls == before + 1
    a, b, tracks = stage.products
    assert (a.read_bytes(), b.read_bytes()) == (b"a.png" * 1000, b"b.png" * 1000)
    with np.load(tracks) as file:
        assert file["xy"].sum() == 499500
    check_resumed(stage)


def test_finished_stage_is_not_run_again(stage: Twice) -> None:
    written = [p.stat().st_mtime_ns for p in stage.products]
    first = stage.run()
    assert stage.run() == first
    assert first.resumed
    assert first.result == Found(3, (1, 2))
    assert [p.stat().st_mtime_ns for p in stage.products] == written
    assert not stage.run("other").resumed
    assert not stage.run().resumed


def test_interrupted_stage_is_run_again(stage: Twice) -> None:
    stage.stop = True
    with pytest.raises(KeyboardInterrupt):
        stage.run("other")
    stage.stop = False
    assert not stage.run("other").resumed
    assert stage.run("other").resumed


def overwrite(path: Path) -> None:
    """Write other content of the same length, and keep the date."""
    status, content = path.stat(), path.read_bytes()
    path.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))


@pytest.mark.parametrize("index", range(3))
def test_damaged_products_are_made_again(stage: Twice, index: int) -> None:
    product = stage.products[index]
    product.unlink()
    check_made_again(stage)
    os.truncate(product, product.stat().st_size // 2)
    check_made_again(stage)
    overwrite(product)
    check_made_again(stage)
    product.unlink()
    product.mkdir()
    check_made_again(stage)


def test_old_products_are_checked_by_their_dates(
    stage: Twice, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are not read, but a change that keeps the date is noticed."""
    now = time.time_ns()
    monkeypatch.setattr(digests.time, "time_ns", lambda: now + 10_000_000_000)
    stage.run("long ago")
    reads: list[Path] = []
    read = digests._read_digest
    with monkeypatch.context() as patch:
        patch.setattr(digests, "_read_digest", lambda path: reads.append(path) or read(path))
        code_digest.cache_clear()
        code_digest(".")
        reads.clear()
        assert stage.run("long ago").resumed
        assert reads == []
        for product in stage.products:
            product.touch()
        assert stage.run("long ago").resumed
        assert sorted(reads) == sorted(stage.products)
    if os.name == "posix":
        overwrite(stage.products[0])
        assert not stage.run("long ago").resumed


def test_copied_folder_with_additional_files_is_resumed(stage: Twice, tmp_path: Path) -> None:
    (stage.folder / "images" / "c.png").touch()
    shutil.copytree(stage.folder, tmp_path / "copy")
    shutil.rmtree(stage.folder)
    shutil.copytree(tmp_path / "copy", stage.folder)
    check_resumed(stage)


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: "",
        lambda text: text[: len(text) // 2],
        lambda text: "[" * 100_000,
        lambda text: "\0" * len(text),
        lambda text: "[]",
        lambda text: "3",
        lambda text: "null",
        lambda text: '"key"',
        lambda text: "{}",
        lambda text: json.dumps({**json.loads(text), "facts": []}),
        lambda text: json.dumps({**json.loads(text), "files": None}),
        lambda text: json.dumps({"key": json.loads(text)["key"], "facts": {"found": 3}}),
        lambda text: text.replace('"found": 3', '"found": 4'),
    ],
)
def test_damaged_record_is_made_again(stage: Twice, damage: Callable[[str], str]) -> None:
    stage.record.write_text(damage(stage.record.read_text()))
    check_made_again(stage)
    stage.record.write_bytes(b"\xff\xfe" + stage.record.read_bytes())
    check_made_again(stage)
    stage.record.unlink()
    (stage.record / "folder").mkdir(parents=True)
    check_made_again(stage)


@pytest.mark.parametrize(
    "changes",
    [
        {"files": ["images/a.png"]},
        {"files": {"images/a.png": 5}},
        {"files": {"images/a.png": {"bytes": 5000}}},
        {"files": {"images/\0": None}},
        {"result": 5},
        {"result": {"found": "x", "sizes": None}},
        {"result": None, "files": {}},
    ],
)
def test_forged_record_is_not_trusted(tmp_path: Path, changes: dict[str, object]) -> None:
    """The digest and the key of the record are correct."""
    output = tmp_path / "out"
    run_with(output, 1, ["images/a.png"])
    record = output / ".stages" / "a.json"
    body = {**json.loads(record.read_text()), **changes}
    del body["digest"]
    shutil.rmtree(output / "images")
    record.write_text(json.dumps({**body, "digest": stages._json_digest(body)}))
    assert not run_with(output, 1, ["images/a.png"]).resumed
    assert texts(output) == {"images/a.png": "1"}


def test_options_without_effect_do_not_rerun_a_stage(stage: Twice) -> None:
    options = MatchOptions()
    assert not stage.run(options).resumed
    threads = replace(options, run=RunOptions(num_threads=7), read=ReadOptions(num_threads=3))
    assert stage.run(threads).resumed
    assert not stage.run(replace(options, read=ReadOptions(strict=True))).resumed
    assert not stage.run(MapOptions(num_threads=1)).resumed
    assert not stage.run(MapOptions(num_threads=2)).resumed  # changes the last digits


def test_number_of_threads_reruns_a_timed_stage(tmp_path: Path) -> None:
    def run(num_threads: int) -> bool:
        options = MatchOptions(run=RunOptions(num_threads=num_threads))
        folder = tmp_path / "a"
        return run_stage_in(folder, [options], None, lambda: None, products=[], timed=True).resumed

    assert [run(1), run(1), run(2)] == [False, True, False]


def test_upgrade_reruns_a_stage(stage: Twice, monkeypatch: pytest.MonkeyPatch) -> None:
    check_resumed(stage)
    for name in ("code_digest", "package_version"):
        with monkeypatch.context() as patch:
            patch.setattr(stages, name, lambda *_: "another")
            check_made_again(stage)
        check_made_again(stage)


def test_code_digest_depends_on_all_code_in_the_folders(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(digests, "PACKAGE", tmp_path)

    def digest(*folders: str) -> str:
        code_digest.cache_clear()
        return code_digest(*folders)

    try:
        for room in ("motion", "evaluate/report"):
            (tmp_path / room).mkdir(parents=True)
        seen = {digest("."), digest("evaluate")}
        for name in ("match.py", "motion/reading.py", "evaluate/report/tables.py", "_core.abi3.so"):
            (tmp_path / name).write_bytes(b"1")
            seen.add(digest("."))
            (tmp_path / name).write_bytes(b"2")
            seen.add(digest("."))
        (tmp_path / "match.py").rename(tmp_path / "other.py")
        assert len(seen | {digest(".")}) == 1 + 2 * 4 + 1
        report = digest("evaluate/report")
        (tmp_path / "motion" / "reading.py").write_bytes(b"3")
        assert digest("evaluate/report") == report
        with pytest.raises(ValueError, match="nowhere"):
            digest("nowhere")
    finally:
        code_digest.cache_clear()


def test_code_digest_includes_the_compiled_core() -> None:
    files = {p for p in digests.PACKAGE.rglob("*") if p.suffix in digests._CODE}
    assert {p.name for p in files} >= {"match.py", "stages.py", "tables.py"}
    assert any(re.match(r"_core\..*(so|pyd)$", p.name) for p in files)
    assert digests.PACKAGE.name == "colmap_av1"


def test_different_values_have_different_digests() -> None:
    values: list[Any] = [
        *(None, True, 1, 1.0, "1", (1,), ("1",), [[1]], {"1": 1}, {1: 1}, (), {}, "", "a,b"),
        *(("a", "b"), MatchOptions(), ReadOptions(), {}.fromkeys("ab"), ("None",), (None,)),
    ]
    assert len({digest_of([value]) for value in values}) == len(values)
    assert digest_of([{"a": 1, "b": 2}]) == digest_of([{"b": 2, "a": 1}])
    assert digest_of([Path("a") / "b"]) == digest_of([str(Path("a/b"))])
    with pytest.raises(TypeError, match="plain"):
        digest_of([object()])
    with pytest.raises(TypeError, match="plain"):
        digest_of([np.arange(3)])


def test_unchanged_file_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "video.mp4"
    path.write_bytes(b"1")
    first = file_digest(path)
    path.write_bytes(b"2")  # written at once, so the date may be the same
    assert file_digest(path) != first
    now = time.time_ns()
    monkeypatch.setattr(digests.time, "time_ns", lambda: now + 10_000_000_000)
    second = file_digest(path)
    monkeypatch.setattr(digests, "_read_digest", lambda _: "read again")
    assert file_digest(path) == second
    path.touch()
    assert file_digest(path) == "read again"


def run_with(output: Path, key: int, names: list[str]) -> Kept:
    """Run a stage that writes the key to the given files."""

    def make(folder: Path) -> Found:
        for name in names:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(str(key))
        return Found(key, ())

    products = sorted({name.split("/")[0] for name in names})
    with open_stages(output, "test") as folder:
        return run_stage(folder, "a", [key], Found, into=output, products=products, make=make)


def texts(folder: Path) -> dict[str, str]:
    files = [p for p in folder.rglob("*") if p.is_file() and ".stages" not in p.parts]
    return {p.relative_to(folder).as_posix(): p.read_text() for p in files}


def test_second_run_only_replaces_files_of_the_first(tmp_path: Path) -> None:
    output = tmp_path / "out"
    run_with(output, 1, ["images/0.png", "images/1.png", "sparse/0/points3D.bin"])
    mine = ["images/mine.png", "sparse/0/points3D.ply", "sparse/1/points3D.bin"]
    for name in mine:
        (output / name).parent.mkdir(exist_ok=True)
        (output / name).write_text("mine")
    run_with(output, 2, ["images/0.png", "images/2.png", "sparse/0/points3D.bin"])
    theirs = dict.fromkeys(["images/0.png", "images/2.png", "sparse/0/points3D.bin"], "2")
    assert texts(output) == {**theirs, **dict.fromkeys(mine, "mine")}


def test_run_without_a_product_removes_that_of_the_run_before(tmp_path: Path) -> None:
    output = tmp_path / "out"
    run_with(output, 1, ["images/0.png", "masks/0.png", "other/0.png"])
    (output / "masks" / "mine.png").write_text("mine")
    run_with(output, 2, ["images/0.png"])
    assert texts(output) == {"images/0.png": "2", "masks/mine.png": "mine"}
    assert not (output / "other").exists()


def test_existing_file_of_the_user_is_refused(tmp_path: Path) -> None:
    output = tmp_path / "out"
    run_with(output, 1, ["images/0.png"])
    (output / "images" / "1.png").write_text("mine")
    before = texts(output)
    with pytest.raises(OptionError, match=r"images/1\.png"):
        run_with(output, 2, ["images/0.png", "images/1.png"])
    assert texts(output) == before
    (output / "images" / "1.png").unlink()
    run_with(output, 2, ["images/0.png", "images/1.png"])


@pytest.mark.parametrize("stopped_at", range(1, 5))
def test_run_interrupted_between_files_is_completed(
    stopped_at: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    output = tmp_path / "out"
    run_with(output, 1, ["images/0.png", "images/1.png"])
    (output / "images" / "mine.png").write_text("mine")
    move, moves = Path.replace, itertools.count()

    def stop(self: Path, target: Path) -> Path:
        if next(moves) == stopped_at:
            raise KeyboardInterrupt
        return move(self, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", stop)
        with pytest.raises(KeyboardInterrupt):
            run_with(output, 2, ["images/1.png", "images/2.png", "images/3.png"])
    for key, names in ((3, ["images/2.png"]), (1, ["images/0.png"])):
        run_with(output, key, names)
        wanted = {"images/mine.png": "mine", **dict.fromkeys(names, str(key))}
        assert texts(output) == wanted


def test_forged_record_removes_no_files_elsewhere(tmp_path: Path) -> None:
    output = tmp_path / "out"
    run_with(output, 1, ["images/0.png"])
    (tmp_path / "mine.txt").write_text("mine")
    (output / "images" / "link").symlink_to(tmp_path)
    record = output / ".stages" / "a.json"
    body = json.loads(record.read_text())
    del body["digest"]
    for name in ("images/../../mine.txt", "images/link/mine.txt", str(tmp_path / "mine.txt")):
        body["files"][name] = body["files"]["images/0.png"]
    record.write_text(json.dumps({**body, "digest": stages._json_digest(body)}))
    run_with(output, 2, ["images/0.png"])
    assert (tmp_path / "mine.txt").read_text() == "mine"

"""Batches on this machine: their outputs, second runs and errors."""

from __future__ import annotations

import errno
import json
import os
import shutil
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest
from batch_output import PACKAGES, files_of, rows_of
from conftest import PROJECT

from colmap_av1 import (
    BatchOptions,
    DensifyOptions,
    ImageOptions,
    MaskOptions,
    MatchOptions,
    OptionError,
    ReadOptions,
    ReconstructOptions,
    RunOptions,
    VerifyOptions,
    run_batch,
    write_page,
)
from colmap_av1.batch.output import Output
from colmap_av1.batch.run import Counts
from colmap_av1.cli import main
from colmap_av1.errors import ColmapAv1Error, WriteError

ONCE = BatchOptions(retries=0)
SMALL = MatchOptions(
    images=ImageOptions(image_name="%03d.jpg"), verify=VerifyOptions(verify="pairs")
)
DONE = ["a/clip0", "a/clip2", "a/clip4", "b/clip1", "b/clip3", "b/clip5"]


def test_every_video_is_done_or_reported_as_failed(clips: Path, tmp_path: Path) -> None:
    progress: list[int] = []

    def on_progress(counts: Counts, _: object) -> None:
        progress.append(counts.ended)

    out = tmp_path / "out"
    report = run_batch(clips, out, SMALL, on_progress=on_progress)
    assert (report.num_videos, report.num_done, report.num_kept) == (8, 6, 0)
    assert report.failed == {"damaged": 1, "unreadable": 1}
    assert progress == list(range(9))
    rows = rows_of(out)
    paths = sorted(p.relative_to(clips).as_posix() for p in clips.rglob("*.mp4"))
    assert [f"{row['name']}.mp4" for row in rows] == paths
    assert [row["name"] for row in rows if row["state"] == "done"] == DONE
    for row in rows:
        files = sorted(p.name for p in (out / row["name"]).glob("*"))
        if row["state"] == "failed":
            assert not files
            assert row["error"].startswith(f"{clips / row['name']}.mp4: ")
        else:
            assert files == ["database.db", "images", "report.json", "thumbnail.jpg"]
            with sqlite3.connect(out / row["name"] / "database.db") as database:
                assert database.execute("SELECT COUNT(*) FROM images").fetchone() == (
                    int(row["images"]),
                )
    found = json.loads((out / "a" / "clip0" / "report.json").read_text())
    assert found["report"]["database"] == "a/clip0/database.db"
    assert [p.name for p in (out / ".batch").iterdir()] == ["batch.lock"]


def test_second_run_processes_changed_and_failed_videos(clips: Path, tmp_path: Path) -> None:
    videos = tmp_path / "videos"
    videos.mkdir()
    for name in ("clip0", "clip2", "clip4", "damaged"):
        shutil.copy2(clips / "a" / f"{name}.mp4", videos)
    out = tmp_path / "out"
    assert run_batch(videos, out, ReadOptions(), options=ONCE).num_done == 3
    before, first = files_of(out), (out / "clip0" / "report.json").stat().st_mtime_ns
    threads = ReadOptions(num_threads=2)  # has no effect on the result
    again = run_batch(videos, out, threads, options=ONCE)
    assert (again.num_done, again.num_kept, again.failed) == (3, 3, {"damaged": 1})
    assert files_of(out) == before
    assert (out / "clip0" / "report.json").stat().st_mtime_ns == first

    shutil.copyfile(clips / "a" / "clip4.mp4", videos / "clip2.mp4")
    (out / "clip4" / "report.json").write_text('{"key": ')
    (out / "clip4" / "thumbnail.jpg").unlink()
    changed = run_batch(videos, out, ReadOptions(), options=ONCE)
    assert (changed.num_done, changed.num_kept) == (2, 1)
    assert rows_of(out)[1]["frames"] == "7"
    # Without a valid report, the folder of clip4 could contain files of others.
    assert changed.failed == {"damaged": 1, "unfit": 1}


def test_interrupted_run_keeps_the_rows_of_the_others(clips: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    run_batch(clips, out, ReadOptions(), options=ONCE)
    before = [row["name"] for row in rows_of(out)]

    def interrupt(counts: Counts, _: object) -> None:
        if counts.ended == 1:
            raise KeyboardInterrupt

    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            run_batch(clips, out, ReadOptions(), options=ONCE, on_progress=interrupt)
        assert [row["name"] for row in rows_of(out)] == before
    write_page(out)
    text = " ".join((out / "report.html").read_text().split())
    assert f"{len(before)} videos" in text


def test_shards_write_to_one_output(clips: Path, tmp_path: Path) -> None:
    """Two shards run at the same time, as in a job array."""
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    run_batch(clips / "a", whole, ReadOptions(), options=ONCE)
    command = [sys.executable, "-m", "colmap_av1", "batch", "--task", "info", "--quiet"]
    command += ["--inputs", str(clips / "a"), "--output", str(parts)]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(PACKAGES), *sys.path])}
    shards = [
        subprocess.Popen(
            [*command, "--shard", f"{i}/2"],
            stderr=subprocess.DEVNULL,
            env=env,
            cwd=tmp_path,
        )
        for i in (1, 2)
    ]
    # One shard has the damaged video.
    assert sorted(shard.wait() for shard in shards) == [0, 1]
    assert files_of(parts) == files_of(whole)
    rows = [rows_of(parts, f"batch-{i}-of-2.csv") for i in (1, 2)]
    assert [rows[i % 2][i // 2] for i in range(4)] == rows_of(whole)


def test_files_of_users_are_kept(clips: Path, tmp_path: Path) -> None:
    out, video = tmp_path / "out", clips / "a" / "clip0.mp4"
    (out / "clip2").mkdir(parents=True)
    users = [out / "clip2" / "mine.txt", out / "clip4"]
    for file in users:
        file.write_text("mine")
    videos = [clips / "a" / f"clip{i}.mp4" for i in (0, 2, 4)]
    assert run_batch(videos, out, ReadOptions(), options=ONCE).failed == {"unfit": 2}
    users += [out / "clip0" / name for name in ("my_training.ply", "splats/a.ply")]
    for file in users[2:]:
        file.parent.mkdir(exist_ok=True)
        file.write_text("mine")
    strict = ReadOptions(strict=True)
    assert run_batch(video, out, strict, options=ONCE).num_kept == 0
    assert [file.read_text() for file in users] == ["mine"] * 4
    assert run_batch(video, out, strict, options=ONCE).num_kept == 1


def test_output_with_another_task_is_an_error(clips: Path, tmp_path: Path) -> None:
    out, video = tmp_path / "out", clips / "a" / "clip0.mp4"
    run_batch(video, out, ReadOptions(), options=ONCE)
    before = files_of(out)
    with pytest.raises(OptionError, match="task"):
        run_batch(video, out, MatchOptions(), options=ONCE)
    (out / "batch.json").unlink()
    assert run_batch(video, out, MatchOptions(), options=ONCE).failed == {"unfit": 1}
    assert files_of(out) == before


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("batch.csv", "my,table"),
        ("batch.json", '{"my": "notes"}'),
        ("batch.json", "my notes"),
        ("batch-1-of-1.csv", "my,table"),
    ],
)
def test_files_of_others_with_the_name_of_a_table_are_kept(
    name: str, content: str, clips: Path, tmp_path: Path
) -> None:
    video, options = clips / "a" / "clip0.mp4", ONCE
    if "-of-" in name:
        options = BatchOptions(retries=0, shard="1/1")
    (tmp_path / name).write_text(content)
    with pytest.raises(OptionError, match="not created by a batch"):
        run_batch(video, tmp_path, ReadOptions(), options=options)
    assert (tmp_path / name).read_text() == content
    assert not (tmp_path / "clip0").exists()


def test_damaged_tables_are_replaced(clips: Path, tmp_path: Path) -> None:
    video = clips / "a" / "clip0.mp4"
    run_batch(video, tmp_path, ReadOptions(), options=ONCE)
    rows = rows_of(tmp_path)
    (tmp_path / "batch.json").write_text('{"task": "in')
    assert run_batch(video, tmp_path, ReadOptions(), options=ONCE).num_kept == 1
    (tmp_path / "batch.csv").write_text("")
    assert run_batch(video, tmp_path, ReadOptions(), options=ONCE).num_kept == 1
    assert rows_of(tmp_path) == rows
    write_page(tmp_path)


def test_unfinished_folder_of_a_video_is_completed(clips: Path, tmp_path: Path) -> None:
    """Files that an interrupted run wrote are replaced or removed, and files of users are kept."""
    out, video = tmp_path / "out", clips / "a" / "clip0.mp4"
    run_batch(video, out, SMALL, options=ONCE)
    whole = files_of(out)
    mine = out / "clip0" / "images" / "mine.jpg"
    mine.write_text("mine")
    (out / "clip0" / ".unfinished").write_text(json.dumps(["stale", *(n[6:] for n in whole)]))
    (out / "clip0" / "report.json").unlink()
    (out / "clip0" / "stale").write_text("written by the interrupted run")
    assert run_batch(video, out, SMALL, options=ONCE).num_done == 1
    assert mine.read_text() == "mine"
    mine.unlink()
    assert files_of(out) == whole


def test_list_of_unfinished_files_is_removed_from_finished_videos(
    clips: Path, tmp_path: Path
) -> None:
    """A process that is killed after writing the report leaves the list."""
    out, video = tmp_path / "out", clips / "a" / "clip0.mp4"
    run_batch(video, out, ReadOptions(), options=ONCE)
    whole = files_of(out)
    (out / "clip0" / ".unfinished").write_text(json.dumps(["report.json"]))
    assert run_batch(video, out, ReadOptions(), options=ONCE).num_kept == 1
    assert files_of(out) == whole


def test_folder_that_cannot_be_created_fails_only_its_video(clips: Path, tmp_path: Path) -> None:
    """An output that cannot be created is an error of the batch."""
    videos, out = tmp_path / "videos", tmp_path / "out"
    for folder in ("a", "b"):
        (videos / folder).mkdir(parents=True)
        shutil.copyfile(clips / "a" / "clip0.mp4", videos / folder / "clip.mp4")
    out.mkdir()
    (out / "a").write_text("a file")
    report = run_batch(videos, out, ReadOptions(), options=ONCE)
    assert (report.num_done, report.failed) == (1, {"reading or writing": 1})
    with pytest.raises(WriteError, match="cannot be written"):
        run_batch(videos, out / "a", ReadOptions())


def test_rows_that_cannot_be_written_during_a_run_are_written_at_its_end(
    clips: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write, refused = Output.write, list[str]()

    def write_later(self: Output, path: str, content: bytes) -> None:
        if path.endswith(".csv") and not refused:
            refused.append(path)
            raise OSError(errno.ENOSPC, "No space left on device", path)
        write(self, path, content)

    monkeypatch.setattr(Output, "write", write_later)
    report = run_batch(clips / "a", tmp_path / "out", ReadOptions(), options=ONCE)
    assert refused
    assert len(rows_of(tmp_path / "out")) == report.num_videos


@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not allow such names")
def test_names_of_videos_need_not_be_utf_8(clips: Path, tmp_path: Path) -> None:
    videos = tmp_path / "videos"
    videos.mkdir()
    name = os.fsdecode(b"caf\xe9, \xc3\xa9.mp4")
    shutil.copyfile(clips / "a" / "clip0.mp4", videos / name)
    out = tmp_path / "out"
    assert run_batch(videos, out, ReadOptions(), options=ONCE).num_done == 1
    assert rows_of(out)[0]["name"] == name.removesuffix(".mp4")
    assert run_batch(videos, out, ReadOptions(), options=ONCE).num_kept == 1
    assert main(["batch", "report", "--output", str(out), "--quiet"]) == 0


def test_inputs_without_videos_leave_no_output(tmp_path: Path) -> None:
    with pytest.raises(ColmapAv1Error):
        run_batch(tmp_path / "nothing", tmp_path / "out", ReadOptions())
    assert not list(tmp_path.iterdir())


def test_invalid_options_are_errors(clips: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(OptionError, match="keep_stream"):
        run_batch(clips, out, MatchOptions(keep_stream="x.mp4"))
    with pytest.raises(OptionError, match="models"):
        run_batch(clips, out, DensifyOptions())
    with pytest.raises(OptionError, match="models"):
        run_batch(clips, out, ReconstructOptions(), models=tmp_path)
    with pytest.raises(OptionError, match="RunOptions"):
        run_batch(clips, out, RunOptions())
    with pytest.raises(OptionError, match="engine"):
        BatchOptions(address="auto")
    assert not out.exists()


def test_command_prints_counts_and_sets_its_exit_status(
    clips: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = str(tmp_path / "out")
    one = ["batch", "--inputs", str(clips / "a" / "clip0.mp4"), "--output", out]
    other = ["batch", "--inputs", str(clips), "--output", str(tmp_path / "other")]
    assert main([*one, "--task", "match", "--image-name", "%03d.jpg", "--write_images", "0"]) == 0
    printed = dict(line.split("\t") for line in capsys.readouterr().out.splitlines())
    assert (printed["videos"], printed["done"], printed["failed"]) == ("1", "1", "0")
    assert not (tmp_path / "out" / "clip0" / "images").exists()
    assert main([*other, "--task", "info"]) == 1
    assert capsys.readouterr().err.count("warning: ") == 2
    assert main([*one, "--task", "info", "--num_images", "5"]) == 2
    assert "num_images" in capsys.readouterr().err
    assert main(one) == 2
    assert main(["batch", "--task", "info", "--output", out]) == 2


@pytest.mark.parametrize(
    ("shard", "refused"), [(None, [None, "1/2"]), ("1/2", [None, "1/2", "1/3", "3/3"])]
)
def test_second_batch_at_the_same_time_is_an_error(
    shard: str | None, refused: list[str | None], clips: Path, tmp_path: Path
) -> None:
    out, video = tmp_path / "out", clips / "a" / "clip0.mp4"
    tried = []

    def try_others(counts: Counts, _: object) -> None:
        if counts.ended == 1:
            for other in refused:
                with pytest.raises(OptionError, match="another batch"):
                    run_batch(video, out, ReadOptions(), options=BatchOptions(shard=other))
                tried.append(other)

    options = BatchOptions(retries=0, shard=shard)
    run_batch(video, out, ReadOptions(), options=options, on_progress=try_others)
    assert tried == refused
    for other in refused:
        run_batch(video, out, ReadOptions(), options=BatchOptions(shard=other))


def test_video_without_a_model_fails(clips: Path, tmp_path: Path) -> None:
    video, out = clips / "a" / "clip0.mp4", tmp_path / "out"
    report = run_batch(video, out, DensifyOptions(), models=tmp_path, options=ONCE)
    assert report.failed == {"no model": 1}


@pytest.mark.slow
def test_batch_densifies_the_models_of_another_batch(tmp_path: Path) -> None:
    video = PROJECT / "examples" / "scene.mp4"
    scenes, dense = tmp_path / "scenes", tmp_path / "dense"
    match = MatchOptions(images=ImageOptions(every=5))
    undistorted = tmp_path / "undistorted"
    assert (
        run_batch(video, undistorted, ReconstructOptions(match=match), options=ONCE).num_done == 1
    )
    refused = run_batch(video, dense, DensifyOptions(), models=undistorted, options=ONCE)
    assert (refused.num_done, sum(refused.failed.values())) == (0, 1)
    options = ReconstructOptions(match=match, undistort=False)
    assert run_batch(video, scenes, options, options=ONCE).num_done == 1
    made = sorted(p.name for p in (scenes / "scene").iterdir())
    assert made == [
        "database.db",
        "images",
        "place.json",
        "report.json",
        "sparse",
        "thumbnail.jpg",
    ]
    report = run_batch(video, dense, DensifyOptions(), models=scenes, options=ONCE)
    assert report.num_done == 1
    (row,) = rows_of(dense)
    assert (row["images"], int(row["points"]) > 10_000) == ("12", True)
    assert run_batch(video, dense, DensifyOptions(), models=scenes, options=ONCE).num_kept == 1
    os.truncate(scenes / "scene" / "sparse" / "0" / "points3D.bin", 100)
    changed = run_batch(video, dense, DensifyOptions(), models=scenes, options=ONCE)
    assert (changed.num_done, changed.num_kept) == (0, 0)


def test_secrets_of_signed_urls_are_neither_printed_nor_written(
    clips: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fsspec = pytest.importorskip("fsspec", reason="needs the extra remote")
    store = fsspec.filesystem("memory")
    store.put_file(str(clips / "a" / "clip0.mp4"), "/signed/v.mp4?sig=SECRET")
    videos = tmp_path / "list"
    videos.write_text("memory://signed/v.mp4?sig=SECRET\nmemory://signed/none.mp4?sig=SECRET\n")
    output = "memory://signed/out?sig=SECRET"
    report = run_batch(videos, output, ReadOptions(), options=ONCE)
    assert (report.num_done, report.failed) == (1, {"unreadable": 1})
    page = write_page(output)
    masked = MatchOptions(masks=MaskOptions(mask_path="https://me:SECRET@host/m?sig=SECRET"))
    out = tmp_path / "out"
    assert run_batch(clips / "a" / "clip0.mp4", out, masked, options=ONCE).num_done == 0
    words = ["batch", "--inputs", str(videos), "--output", output, "--task", "match"]
    # The output has another task, which is an error that names the output.
    assert main(words) == 2
    printed = capsys.readouterr()
    written = [store.cat_file(path) for path in store.find("/signed/out?sig=SECRET")]
    written += [path.read_bytes() for path in out.rglob("*") if path.is_file()]
    everything = f"{report} {page} {printed} {written}"
    assert "memory://signed/v.mp4" in everything
    assert "SECRET" not in everything
    store.rm("/signed", recursive=True)

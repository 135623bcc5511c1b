"""Batches on this machine: what is there afterwards, and what a second run does."""

from __future__ import annotations

import os
import shutil
import sqlite3
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from batch_output import files_of, rows_of
from conftest import PROJECT

from colmap_av1 import (
    BatchOptions,
    DensifyOptions,
    ImageOptions,
    MatchOptions,
    OptionError,
    ReadOptions,
    ReconstructOptions,
    RunOptions,
    VideoError,
    run_batch,
)
from colmap_av1.batch.attempt import attempt
from colmap_av1.batch.files import state_of, without_secrets
from colmap_av1.batch.jobs import Ended, Job, Needs, Source, Work
from colmap_av1.batch.outputs import remove_unused_scratch, scratch_of_process
from colmap_av1.batch.run import Counts
from colmap_av1.batch.tasks import TASKS, Made, Task
from colmap_av1.cli import main

# One process for all videos: it starts slower than it does most of them.
ALONE = BatchOptions(cores=1000, retries=0)
FILES_OF_MODEL = ("cameras", "images", "points3D")
SMALL = MatchOptions(images=ImageOptions(image_name="%03d.jpg"))


def test_every_video_ends_done_or_named(clips: Path, tmp_path: Path) -> None:
    seen: list[Counts] = []
    out = tmp_path / "out"
    report = run_batch(clips, out, SMALL, watch=lambda c, _: seen.append(replace(c)))
    assert (report.num_videos, report.num_done, report.num_kept) == (40, 36, 0)
    assert report.failed == {"damaged": 2, "unreadable": 2}
    assert len(seen) == 41
    assert all(counts.total == 40 for counts in seen)
    rows = rows_of(out)
    paths = sorted(p.relative_to(clips).as_posix() for p in clips.rglob("*.mp4"))
    assert [f"{row['name']}.mp4" for row in rows] == paths
    assert [row["state"] for row in rows if "clip" not in row["name"]] == ["failed"] * 4
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
    report_text = (out / "a" / "clip00" / "report.json").read_text()
    assert '"database": "a/clip00/database.db"' in report_text
    assert sorted(p.name for p in (out / ".batch").iterdir()) == ["batch.lock"]


def test_a_second_run_does_what_has_changed(clips: Path, tmp_path: Path) -> None:
    videos = tmp_path / "videos"
    videos.mkdir()
    for name in ("clip00", "clip02", "clip04", "damaged0"):
        shutil.copy2(clips / "a" / f"{name}.mp4", videos)
    out = tmp_path / "out"
    task = ReadOptions()
    assert run_batch(videos, out, task, options=ALONE).num_done == 3
    before, first = files_of(out), (out / "clip00" / "report.json").stat()
    threads = ReadOptions(num_threads=2)  # has no effect on the result
    again = run_batch(videos, out, threads, options=ALONE)
    assert (again.num_done, again.num_kept, again.failed) == (3, 3, {"damaged": 1})
    assert files_of(out) == before
    assert (out / "clip00" / "report.json").stat() == first

    shutil.copyfile(clips / "a" / "clip04.mp4", videos / "clip02.mp4")
    (out / "clip04" / "report.json").write_text('{"key": ')
    (out / "clip04" / "report.json").unlink()
    (out / "clip04" / "thumbnail.jpg").unlink()
    changed = run_batch(videos, out, task, options=ALONE)
    assert (changed.num_done, changed.num_kept) == (3, 1)
    assert rows_of(out)[1]["frames"] == "7"
    assert run_batch(videos, out, ReadOptions(strict=True), options=ALONE).num_kept == 0


def test_shards_share_an_output(clips: Path, tmp_path: Path) -> None:
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    run_batch(clips / "a", whole, ReadOptions(), options=ALONE)
    for i in (1, 2):
        run_batch(clips / "a", parts, ReadOptions(), options=replace(ALONE, shard=f"{i}/2"))
    assert files_of(parts) == files_of(whole)
    rows = [rows_of(parts, f"batch-{i}-of-2.csv") for i in (1, 2)]
    assert [rows[i % 2][i // 2] for i in range(20)] == rows_of(whole)


def test_folders_of_others_stay(clips: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    mine = out / "clip00" / "mine.txt"
    mine.parent.mkdir(parents=True)
    mine.write_text("kept")
    (out / "clip02").write_text("kept")
    videos = [clips / "a" / f"clip{i:02}.mp4" for i in (0, 2, 4)]
    report = run_batch(videos, out, ReadOptions(), options=ALONE)
    assert report.failed == {"unfit": 2}
    assert "is there and not of a batch" in rows_of(out)[0]["error"]
    assert mine.read_text() == "kept"
    assert (out / "clip02").read_text() == "kept"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_no_permission_in_the_middle(clips: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    (out / "a").mkdir(parents=True, mode=0o555)
    report = run_batch(clips, out, ReadOptions())
    assert report.failed["reading or writing"] == 18
    assert report.num_done == 18


def test_a_place_that_cannot_be_written(clips: Path, tmp_path: Path) -> None:
    """One folder of the output cannot be made: the others are."""
    out = tmp_path / "out"
    out.mkdir()
    (out / "a").write_text("a file")
    report = run_batch(clips, out, ReadOptions(), options=ALONE)
    assert report.failed == {"damaged": 2, "reading or writing": 18, "unreadable": 2}
    assert report.num_done == 18
    with pytest.raises(OptionError, match="cannot be written"):
        run_batch(clips, out / "a", ReadOptions())


@pytest.mark.skipif(sys.platform != "linux", reason="names are text elsewhere")
def test_names_that_are_no_text(clips: Path, tmp_path: Path) -> None:
    videos = tmp_path / "videos"
    videos.mkdir()
    name = os.fsdecode(b"caf\xe9, \xc3\xa9.mp4")
    shutil.copyfile(clips / "a" / "clip00.mp4", videos / name)
    out = tmp_path / "out"
    assert run_batch(videos, out, ReadOptions(), options=ALONE).num_done == 1
    assert rows_of(out)[0]["name"] == name.removesuffix(".mp4")
    assert run_batch(videos, out, ReadOptions(), options=ALONE).num_kept == 1
    assert main(["batch", "report", "--output", str(out), "--quiet"]) == 0


def test_options_that_cannot_work(clips: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(OptionError, match="keep_stream"):
        run_batch(clips, out, MatchOptions(keep_stream="x.mp4"))
    with pytest.raises(OptionError, match="models is missing"):
        run_batch(clips, out, DensifyOptions())
    with pytest.raises(OptionError, match="models is for"):
        run_batch(clips, out, ReconstructOptions(), models=tmp_path)
    with pytest.raises(OptionError, match="no options of a batch"):
        run_batch(clips, out, RunOptions())
    with pytest.raises(OptionError, match="give engine ray"):
        BatchOptions(address="auto")
    assert not out.exists()


def test_the_command(clips: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = str(tmp_path / "out")
    one = ["batch", "--inputs", str(clips / "a" / "clip00.mp4"), "--output", out]
    other = str(tmp_path / "other")  # an output holds one task
    all_of_them = ["batch", "--inputs", str(clips), "--output", other, "--cores", "99"]
    assert main([*one, "--task", "match", "--image-name", "%03d.jpg", "--write_images", "0"]) == 0
    printed = dict(line.split("\t") for line in capsys.readouterr().out.splitlines())
    assert (printed["videos"], printed["done"], printed["failed"]) == ("1", "1", "0")
    assert not (tmp_path / "out" / "clip00" / "images").exists()
    assert main([*all_of_them, "--task", "info"]) == 1
    assert capsys.readouterr().err.count("warning: ") == 4
    assert main([*one, "--task", "info", "--num_images", "5"]) == 2
    assert "num_images is no option of the task info" in capsys.readouterr().err
    assert main(one) == 2
    assert main(["batch", "--task", "info", "--output", out]) == 2


def test_one_batch_at_a_time(clips: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    tried = []

    def try_another(counts: Counts, _: object) -> None:
        if counts.ended == 1:
            with pytest.raises(OptionError, match="another batch is at work"):
                run_batch(clips, out, ReadOptions())
            tried.append(True)

    run_batch(*(clips / "a" / "clip00.mp4", out, ReadOptions()), options=ALONE, watch=try_another)
    assert tried == [True]


def test_models_of_one_batch_are_made_dense_by_another(
    clips: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each video is given the model of its name; a changed model counts as a changed video."""
    models = tmp_path / "models"
    files = [models / "clip00" / "sparse" / "0" / f"{n}.bin" for n in FILES_OF_MODEL]
    files[0].parent.mkdir(parents=True)
    for file in files:
        file.write_bytes(b"")
    job = Job(0, "clip00", Source(str(clips / "a" / "clip00.mp4")), Needs(9, 1 << 40))
    work = Work(
        *("densify", DensifyOptions(), str(tmp_path / "out"), str(models), str(tmp_path)),
        *(None, 5.0, True, None, None, "1"),
    )
    given = []

    def run(_: Path, folder: Path, __: Work, model: Path | None, ___: int) -> Made:
        given.append(model)
        return Made(ReadOptions(), {"points": len(given)}, ())

    monkeypatch.setitem(TASKS, "densify", Task(DensifyOptions, run))
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    for change in (False, False, True):
        if change:
            files[0].write_bytes(b"changed")
        ended = attempt(work, job, scratch)
        assert isinstance(ended, Ended)
        assert ended.row.state == "done"
    assert given == [files[0].parent] * 2
    ended = attempt(work, replace(job, name="clip02"), scratch)
    assert isinstance(ended, Ended)
    assert ended.row.error.startswith(f"{models}: has no model of 'clip02'")


@pytest.mark.slow
def test_scenes_and_dense_scenes(tmp_path: Path) -> None:
    """The models that one batch makes are made dense by another."""
    video = PROJECT / "examples" / "scene.mp4"
    scenes, dense = tmp_path / "scenes", tmp_path / "dense"
    options = ReconstructOptions(match=MatchOptions(images=ImageOptions(every=5)))
    assert run_batch(video, scenes, options, options=ALONE).num_done == 1
    made = sorted(p.name for p in (scenes / "scene").iterdir())
    assert made == [
        *("database.db", "images", "place.json", "report.json", "sparse", "thumbnail.jpg")
    ]
    report = run_batch(video, dense, DensifyOptions(), models=scenes, options=ALONE)
    assert report.num_done == 1
    (row,) = rows_of(dense)
    assert (row["images"], int(row["points"]) > 10_000) == ("12", True)


def test_files_of_users_stay_in_the_folder_of_a_video(clips: Path, tmp_path: Path) -> None:
    out, video = tmp_path / "out", clips / "a" / "clip00.mp4"
    run_batch(video, out, ReadOptions(), options=ALONE)
    users = [out / "clip00" / name for name in ("my_training.ply", "splats/a.ply")]
    for file in users:
        file.parent.mkdir(exist_ok=True)
        file.write_text("mine")
    assert run_batch(video, out, ReadOptions(strict=True), options=ALONE).num_done == 1
    assert [file.read_text() for file in users] == ["mine", "mine"]
    assert run_batch(video, out, ReadOptions(strict=True), options=ALONE).num_kept == 1
    before = files_of(out)
    with pytest.raises(OptionError, match="task"):
        run_batch(video, out, MatchOptions(), options=ALONE)
    (out / "batch.json").unlink()
    assert run_batch(video, out, MatchOptions(), options=ALONE).failed == {"unfit": 1}
    assert files_of(out) == before


def test_a_folder_in_use_is_nobody_elses_scratch(tmp_path: Path) -> None:
    """Containers may share host name and process numbers."""
    with scratch_of_process(tmp_path) as one, scratch_of_process(tmp_path) as other:
        (one / "a").touch()
        assert one != other
        remove_unused_scratch(tmp_path)
        assert (one / "a").exists()
    assert not list(tmp_path.iterdir())


def test_secrets_of_signed_urls_are_not_shown() -> None:
    text = "[5] https://me:PASS@host/v.mp4?X-Amz-Signature=SECRET&b=2: nothing comes"
    assert without_secrets(text) == "[5] https://host/v.mp4 nothing comes"
    assert without_secrets("/a/b?c.mp4") == "/a/b?c.mp4"
    with pytest.raises(VideoError) as raised:
        state_of(Source("memory://none.mp4?sig=SECRET"), 5.0)
    assert "SECRET" not in str(raised.value)

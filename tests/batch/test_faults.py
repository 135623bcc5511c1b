"""Processes that are killed, hang or take too much, and what is left of a batch then."""

from __future__ import annotations

import errno
import os
import random
import signal
import sqlite3
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from batch_output import files_of, rows_of, workers_of

import colmap_av1
from colmap_av1 import (
    BatchOptions,
    BitstreamError,
    MatchOptions,
    ModelError,
    NotAv1Error,
    ReadOptions,
    run_batch,
)
from colmap_av1.batch import attempt as attempts
from colmap_av1.batch.jobs import Ended, Job, Needs, Source, TooSmall, Work
from colmap_av1.batch.needs import estimated_needs
from colmap_av1.batch.worker import Worker
from colmap_av1.util.cpus import threads_or_cpus
from colmap_av1.video.container import read_file

# The folder that the package under test is installed in.
PACKAGES = Path(colmap_av1.__file__).parents[1]

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")


def drive(clips: Path, out: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "colmap_av1", "batch", "--inputs", clips, "--output", out]
    words = [*command, "--task", "match", "--retries", "99", "--quiet"]
    path = os.pathsep.join([str(PACKAGES), *filter(None, sys.path)])
    return subprocess.Popen(
        list(map(str, words)),
        stderr=subprocess.DEVNULL,
        env={**os.environ, "PYTHONPATH": path},
        cwd=clips.parent,
    )


def kill_now_and_then(driver: subprocess.Popen[bytes], out: Path, until: float) -> None:
    """Kill workers, six times, and the driver when a number of videos is finished."""
    rng = random.Random(0)
    left = 6
    while driver.poll() is None:
        time.sleep(rng.uniform(0.1, 0.4))
        workers = workers_of(driver.pid)
        if left and workers:
            left -= 1
            os.kill(rng.choice(workers), signal.SIGKILL)
        if len(list(out.glob("*/*/report.json"))) >= until:
            driver.kill()
            driver.wait()


def test_workers_and_drivers_are_killed(clips: Path, tmp_path: Path) -> None:
    """Every video ends done or named, none half-written, and a run goes on where one ended."""
    calm, out = tmp_path / "calm", tmp_path / "out"
    run_batch(clips, calm, MatchOptions())
    for until, status in ((6, -signal.SIGKILL), (18, -signal.SIGKILL), (float("inf"), 1)):
        with drive(clips, out) as driver:
            workers = workers_of(driver.pid)
            kill_now_and_then(driver, out, until)
        assert driver.returncode == status
        while set(workers) & set(workers_of(1, os.getpid())):
            time.sleep(0.05)
    assert rows_of(out) == rows_of(calm)
    assert files_of(out) == files_of(calm)
    assert sorted(p.name for p in (out / ".batch").iterdir()) == ["batch.lock"]


def test_a_video_that_takes_too_long(clips: Path, tmp_path: Path) -> None:
    options = BatchOptions(timeout=0.05, retries=1, cores=99)
    report = run_batch(clips / "a" / "clip00.mp4", tmp_path, ReadOptions(), options=options)
    assert (report.failed, report.num_retried) == ({"timeout": 1}, 1)
    assert "stopped after 0.05 seconds" in rows_of(tmp_path)[0]["error"]


def test_a_video_that_takes_too_much_memory(clips: Path, tmp_path: Path) -> None:
    options = BatchOptions(memory=0.02, retries=1)
    report = run_batch(clips / "a" / "clip00.mp4", tmp_path, ReadOptions(), options=options)
    assert (report.failed, report.num_retried) == ({"memory": 1}, 0)


def work(out: Path, **changes: object) -> Work:
    given = {"timeout": None, "stall": 5.0, "write_images": True, "cores": None, "memory": None}
    given |= {"task": "info", "options": ReadOptions(), "models": None, "version": "1", **changes}
    return Work(output=str(out), scratch=str(out), **given)  # type: ignore[arg-type]


def test_needs_are_found_in_the_video(clips: Path, tmp_path: Path) -> None:
    job = Job(0, "x", Source(str(clips / "a" / "clip00.mp4")), Needs(1, 1))
    first = attempts.attempt(work(tmp_path), job, tmp_path)
    assert isinstance(first, TooSmall)
    enough = Job(0, "x", job.source, first.needs)
    second = attempts.attempt(work(tmp_path), enough, tmp_path)
    assert isinstance(second, Ended)
    assert second.row.state == "done"
    size = replace(read_file(clips / "a" / "clip00.mp4"), stored_size=(3840, 2160))
    long = replace(size, num_packets=3000)
    needs = estimated_needs(work(tmp_path, task="reconstruct"), long)
    assert needs.memory > 30 * first.needs.memory
    assert needs.cores == threads_or_cpus(None)


@pytest.mark.parametrize(
    ("error", "reason", "passing"),
    [
        (OSError(errno.ENOSPC, "no space left", "/disk/x"), "reading or writing", True),
        (OSError(errno.EACCES, "no permission", "/disk/x"), "reading or writing", False),
        (sqlite3.OperationalError("database or disk is full"), "reading or writing", True),
        (MemoryError(), "memory", True),
        (NotAv1Error("x"), "not AV1", False),
        (BitstreamError("x"), "damaged", False),
        (KeyError("x"), "defect", False),
    ],
)
def test_what_another_attempt_may_help(
    error: Exception, reason: str, passing: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise error

    def fail_in_turn(*_: object) -> None:
        try:
            fail()
        except Exception as cause:
            raise ModelError("cannot be written") from cause

    job = Job(0, "x", Source("/x.mp4"), Needs(1, 1))
    monkeypatch.setattr(attempts, "state_of", fail)
    ended = attempts.attempt(work(tmp_path), job, tmp_path)
    assert isinstance(ended, Ended)
    assert (ended.row.reason, ended.passing) == (reason, passing)
    monkeypatch.setattr(attempts, "state_of", fail_in_turn)
    ended = attempts.attempt(work(tmp_path), job, tmp_path)
    assert isinstance(ended, Ended)
    assert ended.passing == passing
    assert list(tmp_path.iterdir()) == []


def test_a_process_is_started_again(clips: Path, tmp_path: Path) -> None:
    """One that was killed between two videos is no failure of the next one."""
    worker = Worker(str(tmp_path / "scratch"))
    job = Job(0, "x", Source(str(clips / "a" / "clip00.mp4")), Needs(9, 1 << 40))
    try:
        first = worker.run(work(tmp_path / "out"), job)
        for process in workers_of(os.getpid()):
            os.kill(process, signal.SIGKILL)
            while process in workers_of(os.getpid()):
                time.sleep(0.01)
        second = worker.run(work(tmp_path / "out"), job)
    finally:
        worker.close()
    assert isinstance(first, Ended)
    assert isinstance(second, Ended)
    assert (first.row, first.kept, second.row, second.kept) == (second.row, False, first.row, True)
    assert list((tmp_path / "scratch").iterdir()) == []

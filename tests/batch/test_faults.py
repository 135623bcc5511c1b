"""Batches whose processes are killed, crash or hang."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import pytest
from batch_output import PACKAGES, files_of, rows_of, workers_of
from conftest import HANDLE_INTERRUPTS

from colmap_av1 import BatchOptions, MatchOptions, ReadOptions, VerifyOptions, run_batch
from colmap_av1.batch.run import Counts
from colmap_av1.cli import main

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")


def start_batch(clips: Path, out: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-c", HANDLE_INTERRUPTS, "batch", "--inputs", clips, "--output", out]
    words = [*command, "--task", "match", "--verify", "pairs", "--retries", "99", "--quiet"]
    path = os.pathsep.join([str(PACKAGES), *filter(None, sys.path)])
    return subprocess.Popen(
        list(map(str, words)),
        stderr=subprocess.DEVNULL,
        env={**os.environ, "PYTHONPATH": path},
        cwd=clips.parent,
    )


def wait_for_workers(driver: subprocess.Popen[bytes]) -> list[int]:
    """Process ids of a batch's workers once there are any; empty if the batch has ended."""
    while driver.poll() is None:
        workers = workers_of(driver.pid)
        if workers:
            return workers
        time.sleep(0.05)
    return []


def test_killed_batches_are_completed_by_a_later_run(clips: Path, tmp_path: Path) -> None:
    """The rows and files are those of an undisturbed batch, even if workers are killed, too."""
    undisturbed, out = tmp_path / "undisturbed", tmp_path / "out"
    run_batch(clips, undisturbed, MatchOptions(verify=VerifyOptions(verify="pairs")))
    rng = random.Random(0)
    for how in (signal.SIGKILL, signal.SIGINT):
        with start_batch(clips, out) as driver:
            for _ in range(2):
                for worker in wait_for_workers(driver)[:1]:
                    time.sleep(rng.uniform(0.0, 0.5))
                    with suppress(ProcessLookupError):  # It may have ended.
                        os.kill(worker, signal.SIGKILL)
            workers = wait_for_workers(driver)
            time.sleep(rng.uniform(0.5, 2.0))
            driver.send_signal(how)
        assert driver.returncode == (130 if how == signal.SIGINT else -how)
        # Workers of a killed batch get another parent. They must end before the next batch.
        while set(workers) & set(workers_of(1, os.getpid())):
            time.sleep(0.05)
    with start_batch(clips, out) as driver:
        pass
    # Two of the files cannot be decoded.
    assert driver.returncode == 1
    assert rows_of(out) == rows_of(undisturbed)
    assert files_of(out) == files_of(undisturbed)
    assert [p.name for p in (out / ".batch").iterdir()] == ["batch.lock"]


def test_video_that_takes_too_long_is_retried_and_fails(clips: Path, tmp_path: Path) -> None:
    options = BatchOptions(timeout=0.05, retries=1)
    report = run_batch(clips / "a" / "clip0.mp4", tmp_path, ReadOptions(), options=options)
    assert (report.failed, report.num_retried) == ({"timeout": 1}, 1)


@pytest.mark.parametrize(
    ("number", "retries", "failed"),
    [("SIGKILL", 0, {"killed": 1}), ("SIGKILL", 1, {}), ("SIGSEGV", 1, {"crashed": 1})],
)
def test_killed_workers_are_retried_but_crashed_ones_are_not(
    number: str, retries: int, failed: dict[str, int], clips: Path, tmp_path: Path
) -> None:
    """The worker of one video gets the signal. The other video is done in any case."""
    sent: list[int] = []

    def harm(counts: Counts, _: object) -> None:
        def kill() -> None:
            while not sent:
                for process in workers_of(os.getpid())[:1]:
                    with suppress(ProcessLookupError):  # It may have ended.
                        os.kill(process, signal.Signals[number])
                        sent.append(process)
                time.sleep(0.01)

        if counts.ended == 0:
            threading.Thread(target=kill, daemon=True).start()

    videos = [clips / "a" / "clip0.mp4", clips / "a" / "clip2.mp4"]
    # With this many cores for each video, one video runs at a time.
    options = BatchOptions(retries=retries, cores=99)
    report = run_batch(videos, tmp_path, ReadOptions(), options=options, on_progress=harm)
    assert (report.num_done, report.failed) == (2 - len(failed), failed)
    assert report.num_retried == (0 if failed else 1)


def test_json_report_has_the_reason_of_a_failure(clips: Path, tmp_path: Path) -> None:
    found = {}
    for name in ("clip0", "damaged"):
        path = tmp_path / f"{name}.json"
        words = ["info", "--quiet", "--video", str(clips / "a" / f"{name}.mp4")]
        main([*words, "--report_json", str(path)])
        found[name] = json.loads(path.read_text())
    assert found["clip0"]["report"]["num_shown"] == 6
    assert found["damaged"]["failure"]["reason"] == "damaged"

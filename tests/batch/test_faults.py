"""Processes that are killed or hang, and what is left of a batch then."""

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
from batch_output import files_of, rows_of, workers_of
from conftest import HANDLE_INTERRUPTS

import colmap_av1
from colmap_av1 import BatchOptions, MatchOptions, ReadOptions, VerifyOptions, run_batch
from colmap_av1.batch.run import Counts
from colmap_av1.cli import main

# The folder that the package under test is installed in.
PACKAGES = Path(colmap_av1.__file__).parents[1]

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")


def drive(clips: Path, out: Path) -> subprocess.Popen[bytes]:
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
    while driver.poll() is None:
        workers = workers_of(driver.pid)
        if workers:
            return workers
        time.sleep(0.05)
    return []


def test_workers_and_drivers_are_killed(clips: Path, tmp_path: Path) -> None:
    """Every video ends done or named, none half-written, and a run goes on where one ended."""
    calm, out = tmp_path / "calm", tmp_path / "out"
    run_batch(clips, calm, MatchOptions(verify=VerifyOptions(verify="pairs")))
    rng = random.Random(0)
    for how in (signal.SIGKILL, signal.SIGINT):
        with drive(clips, out) as driver:
            for _ in range(2):
                for worker in wait_for_workers(driver)[:1]:
                    time.sleep(rng.uniform(0.0, 0.5))
                    with suppress(ProcessLookupError):  # it was faster
                        os.kill(worker, signal.SIGKILL)
            workers = wait_for_workers(driver)
            time.sleep(rng.uniform(0.5, 2.0))
            driver.send_signal(how)
        assert driver.returncode == (130 if how == signal.SIGINT else -how)
        while set(workers) & set(workers_of(1, os.getpid())):
            time.sleep(0.05)
    with drive(clips, out) as driver:
        pass
    assert driver.returncode == 1  # two videos are damaged
    assert rows_of(out) == rows_of(calm)
    assert files_of(out) == files_of(calm)
    assert [p.name for p in (out / ".batch").iterdir()] == ["batch.lock"]


def test_a_video_that_takes_too_long(clips: Path, tmp_path: Path) -> None:
    options = BatchOptions(timeout=0.05, retries=1)
    report = run_batch(clips / "a" / "clip0.mp4", tmp_path, ReadOptions(), options=options)
    assert (report.failed, report.num_retried) == ({"timeout": 1}, 1)


@pytest.mark.parametrize(("number", "reason"), [("SIGKILL", "killed"), ("SIGSEGV", "crashed")])
def test_a_process_that_ends(number: str, reason: str, clips: Path, tmp_path: Path) -> None:
    """A process that is killed is tried again, one that crashes is not; other videos go on."""
    sent: list[int] = []

    def harm(counts: Counts, _: object) -> None:
        def kill() -> None:
            while not sent:
                for process in workers_of(os.getpid())[:1]:
                    with suppress(ProcessLookupError):  # it was faster
                        os.kill(process, signal.Signals[number])
                        sent.append(process)
                time.sleep(0.01)

        if counts.ended == 0:
            threading.Thread(target=kill, daemon=True).start()

    videos = [clips / "a" / "clip0.mp4", clips / "a" / "clip2.mp4"]
    options = BatchOptions(retries=0, cores=99)  # one at a time
    report = run_batch(videos, tmp_path, ReadOptions(), options=options, on_progress=harm)
    assert (report.num_done, report.failed) == (1, {reason: 1})


def test_the_reason_of_a_command_as_json(clips: Path, tmp_path: Path) -> None:
    found = {}
    for name in ("clip0", "damaged"):
        path = tmp_path / f"{name}.json"
        words = ["info", "--quiet", "--video", str(clips / "a" / f"{name}.mp4")]
        main([*words, "--report_json", str(path)])
        found[name] = json.loads(path.read_text())
    assert found["clip0"]["report"]["num_shown"] == 6
    assert found["damaged"]["failure"]["reason"] == "damaged"

"""Batches on a Ray cluster."""

from __future__ import annotations

import os
import random
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from batch_output import PACKAGES, files_of, rows_of, workers_of

from colmap_av1 import BatchOptions, OptionError, ReadOptions, run_batch
from colmap_av1.batch.run import Counts
from colmap_av1.util.signals import handlers_kept

ray: Any = pytest.importorskip("ray", reason="needs ray: pip install '.[cluster]'")


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A Ray cluster of two nodes on this machine, with one core each."""
    from ray.cluster_utils import Cluster  # noqa: PLC0415 - only if Ray is installed

    with pytest.MonkeyPatch.context() as patch, handlers_kept():
        # In the checkout, its package without the compiled part would hide the installed one.
        patch.chdir(tmp_path_factory.mktemp("cluster"))
        patch.setenv("PYTHONPATH", str(PACKAGES), prepend=os.pathsep)
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        store = {"object_store_memory": 80 << 20, "include_dashboard": False}
        started = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, **store})
        started.add_node(num_cpus=1, **store)
        yield started
        started.shutdown()


def ray_workers() -> list[int]:
    """Ids of the processes in which Ray processes videos."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if (folder / "cmdline").read_bytes().startswith(b"ray::video"):
                found.append(int(folder.name))
        except OSError:
            continue
    return found


def test_batch_survives_the_loss_of_processes_and_a_node(
    cluster: Any, clips: Path, tmp_path: Path
) -> None:
    """The rows and files have the same bytes as those of a batch on this machine."""
    local, out = tmp_path / "local", tmp_path / "out"
    run_batch(clips, local, ReadOptions())
    options = BatchOptions(engine="ray", address=cluster.address, retries=99)
    rng = random.Random(0)

    def harm(counts: Counts, _: object) -> None:
        if counts.ended in {1, 3}:
            for process in ray_workers()[:1]:
                os.kill(process, signal.SIGKILL)
        if counts.ended in {2, 5}:
            processes = workers_of(*ray_workers())
            if processes:
                os.kill(rng.choice(processes), signal.SIGKILL)
        if counts.ended == 4 and len(cluster.worker_nodes) == 1:
            cluster.remove_node(next(iter(cluster.worker_nodes)), allow_graceful=False)

    report = run_batch(clips, out, ReadOptions(), options=options, on_progress=harm)
    assert (report.num_done, report.failed) == (6, {"damaged": 1, "unreadable": 1})
    assert rows_of(out) == rows_of(local)
    assert files_of(out) == files_of(local)
    assert len(cluster.worker_nodes) == 0


def test_missing_cluster_is_an_error(clips: Path, tmp_path: Path) -> None:
    options = BatchOptions(engine="ray", address="127.0.0.1:1")
    with pytest.raises(OptionError, match="127"):
        run_batch(clips, tmp_path / "out", ReadOptions(), options=options)

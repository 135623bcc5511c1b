"""Batches with inputs and outputs in an object store: S3 by moto on this machine."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from batch_output import files_of, rows_of

from colmap_av1 import BatchOptions, ReadOptions, run_batch, write_page
from colmap_av1.cli import main

moto: Any = pytest.importorskip("moto.server", reason="needs moto: pip install '.[dev]'")
s3fs: Any = pytest.importorskip("s3fs", reason="needs s3fs: pip install '.[remote]'")

ONCE = BatchOptions(retries=0)


@pytest.fixture
def store(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The file system of an object store with the bucket 'bucket'."""
    server = moto.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    for name, value in (
        ("AWS_ENDPOINT_URL", f"http://{host}:{port}"),
        ("AWS_ACCESS_KEY_ID", "any"),
        ("AWS_SECRET_ACCESS_KEY", "any"),
        ("AWS_DEFAULT_REGION", "us-east-1"),
    ):
        monkeypatch.setenv(name, value)
    system = s3fs.S3FileSystem(use_listings_cache=False, skip_instance_cache=True)
    system.mkdir("bucket")
    yield system
    system.rm("bucket", recursive=True)
    s3fs.S3FileSystem.clear_instance_cache()
    server.stop()


def test_batch_reads_from_and_writes_to_a_store(store: Any, clips: Path, tmp_path: Path) -> None:
    videos = ["a/clip0", "a/clip2", "b/clip1", "b/text"]
    for name in videos:
        store.put_file(str(clips / f"{name}.mp4"), f"bucket/in/{name}.mp4")
    inputs, output = "s3://bucket/in", "s3://bucket/out"
    report = run_batch(inputs, output, ReadOptions(), options=ONCE)
    assert (report.num_done, report.failed) == (3, {"unreadable": 1})
    assert run_batch(inputs, output, ReadOptions(), options=ONCE).num_kept == 3
    copy = tmp_path / "copy"
    store.get("bucket/out/", str(copy), recursive=True)
    rows = rows_of(copy)
    assert [r["name"] for r in rows] == videos
    assert rows[0]["input"] == "s3://bucket/in/a/clip0.mp4"
    assert rows[3]["error"].startswith("s3://bucket/in/b/text.mp4: ")
    assert json.loads((copy / "a/clip0/report.json").read_text())["input"]["ETag"]
    assert sorted(files_of(copy)) == [
        f"{name}/{file}"
        for name in sorted({*videos} - {"b/text"})
        for file in ("report.json", "thumbnail.jpg")
    ]
    assert write_page(output) == f"{output}/report.html"
    assert store.exists("bucket/out/report.html")


def test_unfinished_upload_is_completed(store: Any, clips: Path, tmp_path: Path) -> None:
    """Stale files are removed, and files of others are kept."""
    videos = tmp_path / "list"
    videos.write_text("s3://bucket/in/x.mp4\ns3://bucket/in/y.mp4\n")
    for name in ("x", "y"):
        store.put_file(str(clips / "a" / "clip0.mp4"), f"bucket/in/{name}.mp4")
    store.pipe_file("bucket/out/y/mine", b"mine")
    words = ["batch", "--inputs", str(videos), "--output", "s3://bucket/out", "--task", "info"]
    assert main([*words, "--quiet"]) == 1
    assert store.find("bucket/out/y") == ["bucket/out/y/mine"]
    first = store.cat_file("bucket/out/x/report.json")

    # An interrupted upload leaves the folder in this state.
    store.rm_file("bucket/out/x/report.json")
    store.pipe_file("bucket/out/x/.unfinished", b'["images/stale.png", "thumbnail.jpg"]')
    store.pipe_file("bucket/out/x/images/mine.png", b"mine")
    store.pipe_file("bucket/out/x/images/stale.png", b"")
    store.put_file(str(clips / "a" / "clip2.mp4"), "bucket/in/x.mp4")
    run_batch("s3://bucket/in/x.mp4", "s3://bucket/out", ReadOptions(), options=ONCE)
    assert [p.rpartition("/")[2] for p in store.find("bucket/out/x")] == [
        "mine.png",
        "report.json",
        "thumbnail.jpg",
    ]
    assert store.cat_file("bucket/out/x/report.json") != first

"""Inputs of batches: lists, patterns, folders and URLs of videos, and their names."""

from __future__ import annotations

import http.server
import os
import tarfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from colmap_av1 import BatchOptions, OptionError, ReadOptions, run_batch
from colmap_av1.batch.inputs import Video, list_videos

OUT = "/nowhere/out"


def names(*inputs: str | Path) -> list[str]:
    return [video.name for video in list_videos([str(word) for word in inputs], OUT, 5)[0]]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder of files, some of which have the names of videos."""
    for name in ("b.mp4", "a.webm", "sub/c.v1.MP4", "sub/notes.txt", ".hidden.mp4", ".h/d.mp4"):
        (tmp_path / "videos" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "videos" / name).write_bytes(name.encode())
    return tmp_path / "videos"


def test_folders_and_patterns_are_expanded(folder: Path) -> None:
    assert names(folder) == ["a", "b", "sub/c.v1"]
    assert names(f"{folder}/*.mp4") == ["b"]
    assert names(f"{folder}/**/*.[mM][pP]4") == ["b", "sub/c.v1"]
    assert names(folder / "b.mp4", folder / "sub" / "c.v1.MP4") == ["b", "c.v1"]


def test_lists_have_paths_urls_and_names(folder: Path) -> None:
    videos = folder.parent / "videos.txt"
    lines = ["# mine", "videos/sub/c.v1.MP4", f"{folder}/b.mp4\tscene/first", "", "../x/e.mp4\r"]
    videos.write_text("\n".join([*lines, "https://host/f.mp4?key=1", "s3://bucket/dir/g.mkv"]))
    assert names(videos) == ["videos/sub/c.v1", "scene/first", "e", "f", "g"]
    found, num_repeated = list_videos([str(videos), str(videos)], OUT, 5)
    assert (len(found), num_repeated) == (5, 5)
    assert os.path.samefile(found[0].address, folder / "sub" / "c.v1.MP4")
    assert found[4] == Video("g", "s3://bucket/dir/g.mkv")


def test_byte_order_mark_of_a_list_is_ignored(folder: Path) -> None:
    videos = folder.parent / "videos.txt"
    videos.write_text("videos/b.mp4\nvideos/a.webm\n", encoding="utf-8-sig")
    assert names(videos) == ["videos/b", "videos/a"]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("empty.txt", "no video"),
        ("nothing*", "no video"),
        ("empty", "no video"),
        ("none.mp4", "no such file"),
        ("binary", "line 1"),
        ("videos.tar", "line 1"),
        ("gopher9://x/y.mp4", "gopher9"),
    ],
)
def test_inputs_without_videos_are_errors(given: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "empty.txt").write_text("\n\n")
    (tmp_path / "empty").mkdir()
    (tmp_path / "binary").write_bytes(bytes(100))
    with tarfile.open(tmp_path / "videos.tar", "w") as archive:
        archive.add(tmp_path / "empty.txt", "a.mp4")
    with pytest.raises(OptionError, match=message):
        names(given if "://" in given else tmp_path / given)


def test_output_inside_the_inputs_is_an_error(folder: Path) -> None:
    with pytest.raises(OptionError, match="searched"):
        run_batch(folder, folder / "out", ReadOptions())


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ("a/x.mp4\tone\nb/x.mp4\tone", "'one'"),
        ("/a/x.mp4\n/b/x.mp4", "'x'"),
        ("x.mp4\nx/y.mp4", "folder"),
        ("x.mp4\t../x", "name"),
        ("x.mp4\t/x", "name"),
        ("x.mp4\t.batch/x", "name"),
        ("batch.json.mp4", "name"),
        ("x.mp4\tbatch-1-of-2.csv", "name"),
    ],
)
def test_names_that_conflict_are_errors(lines: str, message: str, tmp_path: Path) -> None:
    videos = tmp_path / "list"
    videos.write_text(lines)
    with pytest.raises(OptionError, match=message):
        run_batch(videos, tmp_path / "out", ReadOptions())


@pytest.mark.parametrize("shard", ["0/2", "3/2", "1", "1/0", "a/b", "-1/2"])
def test_invalid_shards_are_errors(shard: str) -> None:
    with pytest.raises(OptionError, match="I/N"):
        BatchOptions(shard=shard)


class _Failing(http.server.BaseHTTPRequestHandler):
    """Stops in the middle of /hangs.mp4, and answers all other paths with the status in them."""

    def do_HEAD(self) -> None:
        if self.path != "/hangs.mp4":
            self.send_error(int(self.path[1:4]))
            return
        self.send_response(200)
        self.send_header("Content-Length", "1000")
        self.end_headers()

    def do_GET(self) -> None:
        self.do_HEAD()
        if self.path != "/hangs.mp4":
            return
        self.wfile.write(b"first bytes")
        self.wfile.flush()
        time.sleep(60)

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def server() -> Iterator[str]:
    """The URL of a web server whose requests hang or fail."""
    web = http.server.ThreadingHTTPServer(("127.0.0.1", 0), _Failing)
    web.daemon_threads = True
    threading.Thread(target=web.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{web.server_port}"
    web.shutdown()
    web.server_close()


def test_hanging_download_fails_after_the_stall_time(server: str, tmp_path: Path) -> None:
    pytest.importorskip("aiohttp", reason="needs the extra remote")
    videos = tmp_path / "list"
    videos.write_text(f"{server}/hangs.mp4\n{server}/404.mp4\n")
    options = BatchOptions(stall=6, retries=0)
    report = run_batch(videos, tmp_path / "out", ReadOptions(), options=options)
    assert report.failed == {"reading or writing": 1, "unreadable": 1}
    text = (tmp_path / "out" / "batch.csv").read_text()
    assert "6 seconds" in text
    assert "no such file" in text


def test_server_errors_are_not_reported_as_missing_files(server: str, tmp_path: Path) -> None:
    """They may be temporary, so the videos are retried."""
    pytest.importorskip("aiohttp", reason="needs the extra remote")
    videos = tmp_path / "list"
    addresses = [f"{server}/503.mp4", f"{server}/403.mp4?sig=SECRET", "http://127.0.0.1:1/x.mp4"]
    videos.write_text("\n".join(addresses))
    report = run_batch(videos, tmp_path / "out", ReadOptions(), options=BatchOptions(retries=1))
    assert report.failed == {"reading or writing": 3}
    assert report.num_retried == 3
    text = (tmp_path / "out" / "batch.csv").read_text()
    for word in ("503", "403", "connect"):
        assert word in text
    assert "SECRET" not in text
    assert "no such file" not in text

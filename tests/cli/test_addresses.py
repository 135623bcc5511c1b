"""Videos may be given by a URL."""

from __future__ import annotations

import functools
import http.server
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from dense_scene import SCENE

from colmap_av1.cli import main
from colmap_av1.database.reading import read_images
from colmap_av1.errors import VideoError
from colmap_av1.video.container import open_container


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def server(clip: Path, tmp_path: Path) -> Iterator[str]:
    """A web server with the clip, under a name that contains a space."""
    folder = tmp_path / "served"
    folder.mkdir()
    (folder / "a clip.mp4").write_bytes(clip.read_bytes())
    handler = functools.partial(_Quiet, directory=str(folder))
    web = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    web.daemon_threads = True
    threading.Thread(target=web.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{web.server_port}"
    web.shutdown()
    web.server_close()


@pytest.fixture
def scratch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder for temporary files, which tests expect to be empty at the end."""
    folder = tmp_path / "scratch"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


def test_url_gives_the_same_result_as_the_file(
    server: str, clip: Path, tmp_path: Path, scratch: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("aiohttp", reason="needs the extra remote")
    url = f"{server}/a%20clip.mp4"
    for video, name in ((url, "a.db"), (str(clip), "b.db"), (clip.as_uri(), "c.db")):
        assert main(["match", "--database", str(tmp_path / name), "--video", video]) == 0
    assert url in capsys.readouterr().err
    fetched = (tmp_path / "a.db").read_bytes()
    assert fetched == (tmp_path / "b.db").read_bytes() == (tmp_path / "c.db").read_bytes()

    other = tmp_path / "other.mp4"
    other.write_bytes(clip.read_bytes() + b"\0\0\0\x08free")
    several = ["--quiet", "--links", "none", "--video", url, "--video", str(other)]
    main(["match", "--database", str(tmp_path / "d.db"), *several])
    folders = {image.name.partition("/")[0] for image in read_images(tmp_path / "d.db")}
    assert folders == {"a_clip", "other"}
    assert os.listdir(scratch) == []


def test_messages_name_the_url_and_not_the_copy(
    server: str,
    tmp_path: Path,
    scratch: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The temporary copy no longer exists when a user reads them."""
    pytest.importorskip("aiohttp", reason="needs the extra remote")
    monkeypatch.chdir(tmp_path)
    url, report = f"{server}/a%20clip.mp4?sig=SECRET", tmp_path / "r.json"
    words = ["--video", url, "--report_json", str(report)]
    assert main(["match", "--database", "a.db", *words]) == 0
    texts = [*capsys.readouterr(), report.read_text()]
    Path(tmp_path / "served" / "a clip.mp4").write_text("no video")
    assert main(["info", *words]) == 2
    texts += [*capsys.readouterr(), report.read_text()]
    for text in texts:
        assert "SECRET" not in text
        assert str(scratch) not in text
    for place in (0, 2, 4, 5):
        assert f"{server}/a%20clip.mp4" in texts[place]


def test_unreadable_urls_are_reported(
    server: str, scratch: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("aiohttp", reason="needs the extra remote")
    for address, message in (
        (f"{server}/none.mp4", "no such file"),
        ("nothing://x/v.mp4", "fsspec"),
    ):
        assert main(["info", "--quiet", "--video", address]) == 2
        error = capsys.readouterr().err
        assert error.startswith(f"colmap-av1: error: {address}: ")
        assert message in error
        assert error.count("\n") == 1
    assert os.listdir(scratch) == []


def test_missing_fsspec_is_reported(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "fsspec", None)
    address = "s3://bucket/v.mp4"
    assert main(["info", "--quiet", "--video", address]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"colmap-av1: error: {address}: ")
    assert "pip install 'colmap-av1[remote]'" in error


def test_python_functions_refuse_urls() -> None:
    for address in ("http://example.org/a b.mp4", "https://x:8/y?z#1"):
        with (
            pytest.raises(VideoError, match="URL"),
            open_container(Path(address)),
        ):
            pass


@pytest.mark.skipif(sys.platform == "win32", reason="signals end processes differently there")
def test_terminated_estimate_of_the_read_out_time_leaves_no_copy(
    server: str, tmp_path: Path, scratch: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("aiohttp", reason="needs the extra remote")
    monkeypatch.setenv("TMPDIR", str(scratch))
    shutil.copyfile(SCENE, tmp_path / "served" / "scene.mp4")
    before = sorted(tmp_path.rglob("*"))
    program = [sys.executable, "-X", "importtime", "-m", "colmap_av1"]
    words = ["info", "--video", f"{server}/scene.mp4", "--rolling_shutter", "estimate"]
    with subprocess.Popen(
        [*program, *words],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stderr is not None
        for line in process.stderr:  # the module of the estimate is imported last
            if line.endswith(" colmap_av1.matching.shutter.of_video\n"):
                break
        assert [path.name for path in scratch.rglob("*.mp4")] == ["scene.mp4"]
        process.terminate()
        printed, rest = process.communicate(timeout=60)
    assert process.returncode == 128 + signal.SIGTERM
    assert printed == ""
    assert [line for line in rest.splitlines() if not line.startswith("import time:")] == []
    assert sorted(tmp_path.rglob("*")) == before

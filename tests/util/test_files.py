from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from colmap_av1.errors import OptionError
from colmap_av1.util.files import remove_leftovers, whole_folder
from colmap_av1.util.stages import open_stages


def dead_process() -> int:
    with subprocess.Popen([sys.executable, "-c", ""]) as process:
        process.wait()
    return process.pid


def test_a_folder_appears_when_whole(tmp_path: Path) -> None:
    output = tmp_path / "new" / "model"
    with whole_folder(output) as partial:
        (partial / "points").write_text("1")
        assert not output.exists()
    assert (output / "points").read_text() == "1"
    assert list(output.parent.iterdir()) == [output]
    with pytest.raises(OSError, match="not empty"), whole_folder(output) as partial:
        (partial / "points").write_text("2")
    assert (output / "points").read_text() == "1"
    with pytest.raises(KeyError), whole_folder(tmp_path / "other") as partial:
        {}[(partial / "points").write_text("2")]
    assert [p.name for p in tmp_path.iterdir()] == ["new"]


def test_a_folder_that_is_there_gets_the_content(tmp_path: Path) -> None:
    output = tmp_path / "model"
    output.mkdir()
    (tmp_path / "link").symlink_to("model")
    number = output.stat().st_ino
    for content in ("1", "2"):
        with whole_folder(tmp_path / "link", overwrite=content == "2") as partial:
            (partial / f"points{content}").write_text(content)
            (partial / "0").mkdir()
        assert sorted(p.name for p in output.iterdir()) == ["0", f"points{content}"]
    assert output.stat().st_ino == number
    assert sorted(p.name for p in tmp_path.iterdir()) == ["link", "model"]
    with pytest.raises(KeyError), whole_folder(output, overwrite=True) as partial:
        {}[(partial / "points3").write_text("3")]
    assert (output / "points2").read_text() == "2"


@pytest.mark.skipif(sys.platform == "win32", reason="leftovers stay there")
def test_what_the_killed_left_is_removed(tmp_path: Path) -> None:
    killed = tmp_path / f".model.{dead_process()}.partial"
    other = tmp_path / f".other.{dead_process()}.partial"
    killed.mkdir()
    (killed / "points3D.bin").write_bytes(b"half")
    other.write_bytes(b"half")
    with whole_folder(tmp_path / "model"):
        remove_leftovers(tmp_path, "model")
        assert len(list(tmp_path.glob(".model.*"))) == 1  # the one being written
    assert not killed.exists()
    assert other.exists()


@pytest.mark.skipif(sys.platform == "win32", reason="there are no such locks")
def test_one_run_at_a_time(tmp_path: Path) -> None:
    output = tmp_path / "out"
    with open_stages(output, "a"):
        with (
            pytest.raises(OptionError, match="another run is at work in it"),
            open_stages(output, "a"),
        ):
            pass
        with open_stages(tmp_path / "other", "a"):
            pass
    with pytest.raises(OptionError, match="is the output of a:"), open_stages(output, "b"):
        pass
    left = output / f".report.json.{dead_process()}.partial"
    left.write_text("half")
    with open_stages(output, "a"):
        assert not left.exists()

"""Commands overwrite existing files only with --overwrite, and never an input."""

from __future__ import annotations

import argparse
import hashlib
import os
import shutil
import sqlite3
import sys
from contextlib import closing
from pathlib import Path

import pycolmap
import pytest
from killed_runs import kill_while_replacing

from colmap_av1.cli import main
from colmap_av1.cli.report_file import failure_as_json
from colmap_av1.errors import VideoError


@pytest.fixture(scope="module")
def made(clip: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a video, a database, its images and a model."""
    folder = tmp_path_factory.mktemp("made")
    shutil.copyfile(clip, folder / "v.mp4")
    words = ["match", "--database", f"{folder}/a.db", "--video", f"{folder}/v.mp4"]
    assert main([*words, "--image_path", f"{folder}/frames", "--quiet"]) == 0
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 4, 50
    (folder / "model").mkdir()
    pycolmap.synthesize_dataset(options).write(folder / "model")
    (folder / "notes.png").write_text("mine")
    (folder / "notes.npz").write_text("mine")
    (folder / "notes.log").write_text("mine")
    return folder


@pytest.fixture
def work(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the folder as the working folder."""
    shutil.copytree(made, tmp_path / "work")
    monkeypatch.chdir(tmp_path / "work")
    return tmp_path / "work"


def contents(folder: Path) -> dict[str, str]:
    files = (p for p in sorted(folder.rglob("*")) if p.is_file())
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


VIEW_PAIR = "view --database a.db --image_path frames --output"
INPUTS = [
    "view --video v.mp4 --output v.mp4",
    "view --video v.mp4 --output linked.mp4",
    "view --video ./frames/../v.mp4 --output v.mp4",
    "encode --video v.mp4 --output hard.mp4",
    "motion --video linked.h5 --output linked.h5",
    "export --database pairs.txt --output .",
    "map --database model/a.db --image_path frames --output model",
    "densify --model model --video v.mp4 --output model",
    "reconstruct --video scene/v.mp4 --output scene",
    "compare --video scene/v.mp4 --output scene",
    "compare --video v.mp4 --image_path scene/images --output scene",
]


@pytest.mark.parametrize("words", INPUTS)
def test_inputs_are_kept_even_with_overwrite(
    words: str, work: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (work / "linked.mp4").symlink_to("v.mp4")
    (work / "linked.h5").symlink_to("v.mp4")
    (work / "hard.mp4").hardlink_to("v.mp4")
    shutil.copyfile("a.db", "pairs.txt")
    shutil.copyfile("a.db", "model/a.db")
    (work / "scene" / ".stages").mkdir(parents=True)
    shutil.copyfile("v.mp4", "scene/v.mp4")
    before = contents(work)
    can_overwrite = words.split(maxsplit=1)[0] not in ("reconstruct", "compare")
    for more in (["--overwrite"] * can_overwrite, []):
        assert main([*words.split(), *more]) == 2
        assert len(capsys.readouterr().err.splitlines()) == 1
        assert contents(work) == before


OTHERS = [
    "view --model model --output notes.png",
    f"{VIEW_PAIR} notes.png",
    "view --video v.mp4 --output frames",
    "motion --video v.mp4 --output notes.npz",
    "export --database a.db --output .",
    f"{VIEW_PAIR} frames/frame_000003.png",
]


@pytest.mark.parametrize("words", OTHERS)
def test_existing_files_are_kept_without_overwrite(
    words: str, work: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (work / "pairs.txt").write_text("frame_000000.png frame_000001.png\n")
    before = contents(work)
    assert main(words.split()) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "--overwrite" in line
    assert contents(work) == before


@pytest.mark.parametrize(
    ("video", "report"), [("v.mp4", "v.mp4"), ("none.mp4", "notes.log"), ("v.mp4", "frames")]
)
def test_reports_only_replace_reports(
    video: str, report: str, work: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = contents(work)
    assert main(["info", "--video", video, "--report_json", report]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert report in line
    assert contents(work) == before
    for status, again in ((2, "none.mp4"), (0, "v.mp4"), (0, "v.mp4")):
        assert main(["info", "--video", again, "--report_json", "r.json", "--quiet"]) == status
    assert main(["info", "--video", "v.mp4", "--report_json", "new/r.json", "--quiet"]) == 0
    assert (work / "new/r.json").exists()


@pytest.mark.parametrize(
    "words",
    [
        "match --database new.db --video v.mp4 --report_json new.db",
        "match --database new.db --video v.mp4 --keep_stream s.mp4 --report_json s.mp4",
        "reconstruct --video v.mp4 --output new --report_json new/report.json",
    ],
)
def test_reports_do_not_replace_other_outputs(
    words: str, work: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = contents(work)
    assert main(words.split()) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "output" in line
    assert contents(work) == before


@pytest.mark.parametrize("report", ["notes.log/r.json", "closed/new/r.json"])
def test_reports_that_cannot_be_created_are_refused_before_the_work(
    report: str, work: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (work / "closed").mkdir(mode=0o500)
    if report.startswith("closed") and os.access(work / "closed", os.W_OK):
        pytest.skip("root may write to all folders")
    assert main(["info", "--video", "none.mp4", "--report_json", report]) == 2
    assert f"{report}: cannot be created" in capsys.readouterr().err


AGAIN = [
    ("view --model model --output view.png", "view.png"),
    ("view --model model --output view.jpg", "view.jpg"),
    (f"{VIEW_PAIR} pair.png", "pair.png"),
    ("view --video v.mp4 --output view.mp4", "view.mp4"),
    ("view --video v.mp4 --output drawn", "drawn/frame_000000.png"),
    ("motion --video v.mp4 --output motion.npz", "motion.npz"),
    ("motion --video v.mp4 --output motion.h5", "motion.h5"),
    ("export --database a.db --output hloc", "hloc/pairs.txt"),
]


@pytest.mark.parametrize(("words", "output"), AGAIN)
def test_output_is_only_replaced_with_overwrite(
    words: str, output: str, work: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*words.split(), "--quiet"]) == 0
    first = contents(work)
    Path(output).write_text("mine")
    before = contents(work)
    assert main(words.split()) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "--overwrite" in line
    assert contents(work) == before
    assert main([*words.split(), "--quiet", "--overwrite"]) == 0
    assert contents(work) == first


def test_models_are_only_replaced_with_overwrite(
    work: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["map", "--database", "a.db", "--image_path", "frames", "--output", "model"]
    before = contents(work)
    assert main(words) == 2
    assert "--overwrite" in capsys.readouterr().err
    (work / "model" / "notes.txt").write_text("mine")
    assert main([*words, "--overwrite"]) == 2
    assert "notes.txt" in capsys.readouterr().err
    (work / "model" / "notes.txt").unlink()
    assert contents(work) == before
    # If the mapper fails, here because no pair has enough inliers, the old model is kept.
    with closing(sqlite3.connect("a.db")) as database, database:
        database.execute(
            "UPDATE two_view_geometries SET rows = 20, data = substr(data, 1, 20 * cols * 4)"
            " WHERE rows > 20"
        )
    before = contents(work)
    assert main([*words, "--overwrite"]) == 2
    assert "no model" in capsys.readouterr().err
    assert contents(work) == before


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such file locks")
@pytest.mark.parametrize("steps", range(0, 9, 2))
def test_half_replaced_model_is_restored_by_a_failing_run(steps: int, work: Path) -> None:
    before = contents(work / "model")
    kill_while_replacing(work / "model", steps)
    words = "densify --model frames --video none.mp4 --output model --overwrite --quiet"
    assert main(words.split()) == 2
    left = contents(work)
    hidden = [name for name in left if name.startswith(".")]
    assert hidden == []
    assert contents(work / "model") == before or set(os.listdir(work / "model")) == {"a", "c"}


def test_an_error_is_reported_even_if_its_report_cannot_be_written(tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    namespace = argparse.Namespace(report_json=str(folder / "report.json"))

    def fail() -> None:
        with failure_as_json(namespace):
            folder.rmdir()
            folder.touch()
            raise VideoError("the reason")

    with pytest.raises(VideoError, match="reason"):
        fail()

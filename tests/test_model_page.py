"""The page of a model: browsers show it without a network, and it describes the model."""

from __future__ import annotations

import json
import re
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from chromium import show

from colmap_av1.cli import main
from colmap_av1.errors import ModelError, OptionError
from colmap_av1.geometry.observable import framed_box, has_observable_depth
from colmap_av1.matching.gaps import Gap
from colmap_av1.reconstruct import ReconstructReport, read_report
from colmap_av1.view.page import check_page, write_model_page

pytest.importorskip("plotly")

NUM_POINTS = 2000


@pytest.fixture(scope="module")
def stock_model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model as a mapper writes it, without image files and without a report."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 8, NUM_POINTS
    reconstruction = pycolmap.synthesize_dataset(options)
    for point in reconstruction.points3D.values():
        point.color = np.array([10, 200, 30], dtype=np.uint8)
    path = tmp_path_factory.mktemp("stock")
    reconstruction.write(path)
    return path


@pytest.fixture(scope="module")
def scene(made: ReconstructReport, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A `reconstruct` folder."""
    folder = tmp_path_factory.mktemp("page") / "my <b>scene"
    shutil.copytree(made.output, folder)
    return folder


def text_of(page: Path) -> str:
    """The HTML of a page without scripts, and with single spaces."""
    text = re.sub(r"<script.*?</script>", "", page.read_text(), flags=re.DOTALL)
    return " ".join(text.split())


def test_browser_shows_the_page_of_a_reconstruction(
    scene: Path, made: ReconstructReport, tmp_path: Path
) -> None:
    page = tmp_path / "page.html"
    assert main(["view", "--model", str(scene / "sparse" / "0"), "--output", str(page)]) == 0
    shown = show(page, tmp_path)
    assert shown.errors == []
    assert page.stat().st_size < 15e6
    # The 3D view is below the heading and has many colours. The page around it has few.
    view = shown.picture[200:700, 200:1200].reshape(-1, 3)
    assert len(np.unique(view // 16, axis=0)) > 100
    text = text_of(page)
    assert "<b>scene" not in text
    assert f"{made.num_points:,} points" in text
    assert text.count('<line class="key-image"') == made.num_key_images
    assert text.count('<line class="registered"') == made.num_registered - made.num_key_images
    assert text.count("data:image/jpeg;base64") == made.num_key_images
    assert f"{made.coverage:.1%} of the images" in text
    assert "ns-train" in text


def test_browser_shows_the_page_of_a_model_of_another_mapper(
    stock_model: Path, tmp_path: Path
) -> None:
    page = tmp_path / "page.html"
    assert main(["view", "--model", str(stock_model), "--output", str(page)]) == 0
    shown = show(page, tmp_path)
    assert shown.errors == []
    green = shown.picture[200:700, 200:1200].astype(np.int64)
    assert np.count_nonzero(green[:, :, 1] > 2 * green[:, :, 0] + 40) > 200
    text = text_of(page)
    assert f"8 registered images, {NUM_POINTS:,} points" in text
    assert "<svg" not in text
    assert "colmap-av1 densify" in text


def test_timeline_shows_gaps_and_images_that_are_not_registered(
    scene: Path, made: ReconstructReport, tmp_path: Path
) -> None:
    (own,) = made.timelines
    gap = Gap(own.images[3], own.images[4], ("doubtful motion", "few tracks"))
    images, frames = (*own.images, "lost.png"), (*own.frames, 59)
    own = replace(own, images=images, frames=frames, not_registered=("lost.png",))
    report = replace(made, links=replace(made.links, gaps=(gap,)), timelines=(own,))
    page = tmp_path / "page.html"
    write_model_page(scene / "sparse" / "0", page, report=report)
    text = text_of(page)
    assert text.count('<line class="not-registered"') == 1
    assert text.count("<rect") == 1
    assert "doubtful motion, few tracks" in text


def test_page_shows_a_part_of_a_large_cloud(
    stock_model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("colmap_av1.view.page._MOST_POINTS", 500)
    write_model_page(stock_model, tmp_path / "page.html")
    assert f"{NUM_POINTS:,} points, 500 of them shown" in text_of(tmp_path / "page.html")


def test_report_is_read_as_written(made: ReconstructReport) -> None:
    report = read_report(made.output)
    # Another test may have resumed this folder since, with the video at another path.
    changed = ("videos", "resumed", "seconds", "cpu_seconds")
    assert report == replace(made, **{name: getattr(report, name) for name in changed})
    (own,) = report.timelines
    assert len(own.images) == len(own.frames) == made.num_images
    assert len(own.key_images) == made.num_key_images
    assert own.num_frames == made.num_frames


def test_model_with_a_report_of_another_version_is_shown_without_it(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "older"
    shutil.copytree(scene, folder)
    report = json.loads((folder / "report.json").read_text())
    del report["timelines"]
    (folder / "report.json").write_text(json.dumps(report))
    with pytest.raises(ModelError, match="version"):
        read_report(folder)
    page = tmp_path / "page.html"
    assert main(["view", "--model", str(folder / "sparse" / "0"), "--output", str(page)]) == 0
    assert "version" in capsys.readouterr().err
    assert "<svg" not in text_of(page)


def test_page_that_cannot_be_written_is_refused(
    stock_model: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    existing = tmp_path / "page.html"
    existing.write_text("existing page")
    words = ["view", "--model", str(stock_model), "--output"]
    assert main([*words, str(existing)]) == 2
    assert existing.read_text() == "existing page"
    monkeypatch.setitem(sys.modules, "plotly", None)
    with pytest.raises(OptionError, match=r"\[viewer\]"):
        check_page(tmp_path / "new.html")
    # `reconstruct` fails before it does any work.
    output = tmp_path / "scene"
    words = ["reconstruct", "--video", "none.mp4", "--output", str(output), "--report"]
    assert main(words) == 2
    assert "[viewer]" in capsys.readouterr().err
    assert not output.exists()


@pytest.mark.parametrize("output", [".", "images/..", "../scene"])
def test_page_of_a_reconstruction_is_next_to_its_folder(
    output: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "scene" / "images").mkdir(parents=True)
    (tmp_path / "scene.html").write_text("existing page")
    monkeypatch.chdir(tmp_path / "scene")
    words = ["reconstruct", "--video", "none.mp4", "--output", output, "--report"]
    assert main(words) == 2
    assert f"{tmp_path / 'scene.html'}: exists" in capsys.readouterr().err


def test_points_with_little_parallax_or_without_an_error_have_no_observable_depth() -> None:
    model = pycolmap.synthesize_dataset(pycolmap.SyntheticDatasetOptions(num_points3D=50))
    for point in model.points3D.values():
        point.error = 0.5
    assert has_observable_depth(model).all()
    first, second = sorted(model.points3D)[:2]
    model.points3D[first].error = -1.0
    model.points3D[second].xyz = 1e5 * model.points3D[second].xyz
    np.testing.assert_array_equal(np.flatnonzero(~has_observable_depth(model)), [0, 1])
    for point in model.points3D.values():
        point.error = -1.0
    assert has_observable_depth(model).sum() == 49


def test_view_does_not_frame_points_without_observable_depth() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (1000, 3))
    points[:200] *= 100
    observable = np.arange(1000) >= 200
    low, high = framed_box(points, observable, np.array([[0.0, 0.0, -3.0]]))
    assert (high < 1).all()
    assert (low[:2] > -1).all()
    assert low[2] == -3

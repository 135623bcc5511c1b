"""Mapping a database with COLMAP's mappers, by the function and by the command."""

from __future__ import annotations

import json
import os
import re
import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from conftest import STREET, Street
from dense_scene import EVERY, NUM_IMAGES, SCENE, Truth
from sequences import model_poses

from colmap_av1 import (
    DatabaseError,
    DensityOptions,
    ImageError,
    ImageOptions,
    MapOptions,
    MapReport,
    MatchOptions,
    ModelError,
    OptionError,
    PlaceOptions,
    VerifyOptions,
    WriteError,
    map_database,
    match,
)
from colmap_av1.cli import main
from colmap_av1.evaluate.metrics.poses import pose_errors
from colmap_av1.geometry.colmap_model import read_model
from colmap_av1.options import Mapper
from colmap_av1.reconstruct import ReconstructReport

# Few tracks, so that mapping is fast.
MATCHING = MatchOptions(
    images=ImageOptions(every=EVERY),
    density=DensityOptions(preset="sparse", max_tracks_per_image=300),
    verify=VerifyOptions(verify="pairs"),
)


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("mapped_images")


@pytest.fixture(scope="module")
def database(images: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("mapped") / "a.db"
    match(path, SCENE, image_path=images, options=MATCHING)
    return path


@pytest.mark.parametrize("mapper", ["incremental", "global"])
def test_model_has_all_images_and_correct_poses(
    database: Path, images: Path, truth: Truth, mapper: Mapper, tmp_path: Path
) -> None:
    before = database.read_bytes()
    steps: list[tuple[str, int, int | None]] = []
    report = map_database(
        database,
        images,
        tmp_path / "model",
        options=MapOptions(mapper=mapper),
        progress=lambda *step: steps.append(step),
    )
    assert database.read_bytes() == before
    assert sorted(p.name for p in database.parent.iterdir()) == ["a.db"]
    assert sorted(p.name for p in (tmp_path / "model").iterdir()) == [
        "0",
        "mapper.log",
        "place.json",
    ]
    assert (report.num_images, report.num_registered) == (NUM_IMAGES, (NUM_IMAGES,))
    assert [step for step in steps if step[0] == "poses"][-1] == ("poses", NUM_IMAGES, NUM_IMAGES)
    model = read_model(report.model)
    assert report.figures.num_points == model.num_points3D() > 300
    assert report.figures.mean_error == pytest.approx(model.compute_mean_reprojection_error())
    assert report.expected_error < 0.001
    assert pose_errors(model_poses(model, 60), truth.cam_from_world).rotation < 1
    colours = np.array([point.color for point in model.points3D.values()])
    assert 50 < colours.mean() < 200
    assert colours.std() > 10


def test_largest_model_comes_first(database: Path, images: Path, tmp_path: Path) -> None:
    """No matches join the first images with the others, so there are two models."""
    split = tmp_path / "split.db"
    shutil.copyfile(database, split)
    num_first = 7
    with sqlite3.connect(split) as connection:
        ids = [row[0] for row in connection.execute("SELECT image_id FROM images ORDER BY name")]
        for table in ("matches", "two_view_geometries"):
            connection.executemany(
                f"DELETE FROM {table} WHERE pair_id = ?",
                [(2147483647 * i + j,) for i in ids[:num_first] for j in ids[num_first:]],
            )
    connection.close()
    options = MapOptions(mapper="global")
    report = map_database(split, images, tmp_path / "model", options=options)
    sizes = [read_model(tmp_path / "model" / str(i)).num_reg_images() for i in range(2)]
    assert report.num_registered == tuple(sizes) == (NUM_IMAGES - num_first, num_first)
    assert any("coordinates" in warning for warning in report.warnings)


def copying(model: Path, *sizes: int) -> Callable[..., tuple[int, ...]]:
    """A mapper that writes a model once for each of the sizes that it reports."""

    def mapped(_: Path, output: Path, *__: object, log: Path, **___: object) -> tuple[int, ...]:
        for number in range(len(sizes)):
            images = shutil.copytree(model, output / str(number)) / "images.bin"
            # The images of the database are PNG files. The first image keeps a name that it lacks.
            first, others = images.read_bytes().split(b".jpg\0", 1)
            images.write_bytes(first + b".jpg\0" + others.replace(b".jpg\0", b".png\0"))
        log.touch()
        return sizes

    return mapped


def test_second_model_of_the_same_images_is_reported(
    database: Path,
    images: Path,
    made: ReconstructReport,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A mapper can start a second model with images that are already registered."""
    mapped = copying(made.output / "sparse" / "0", NUM_IMAGES, 2)
    monkeypatch.setattr("colmap_av1.map.map_poses", mapped)
    report = map_database(database, images, tmp_path / "model")
    assert any("again" in warning for warning in report.warnings)


def test_one_of_two_attempts_may_fail(
    database: Path,
    images: Path,
    made: ReconstructReport,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A small model leads to a second attempt with other initial pairs."""
    mapped = copying(made.output / "sparse" / "0", 2)
    for failing in (0, 1):
        attempts = count()

        def mapped_or_not(*args: Any, **kwargs: Any) -> tuple[int, ...]:
            if next(attempts) == failing:  # noqa: B023 - called in the same iteration
                raise ModelError("the mapper stopped with status -11")
            return mapped(*args, **kwargs)

        monkeypatch.setattr("colmap_av1.map.map_poses", mapped_or_not)
        report = map_database(database, images, tmp_path / f"model_{failing}")
        assert next(attempts) == 2
        assert report.num_registered == (2,)


def test_model_that_cannot_be_placed_keeps_the_coordinates_of_the_mapper(
    database: Path,
    images: Path,
    made: ReconstructReport,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """An image of the distance is not registered, and one of the model is not readable."""
    mapped_model = made.output / "sparse" / "0"
    monkeypatch.setattr("colmap_av1.map.map_poses", copying(mapped_model, NUM_IMAGES))
    distance = PlaceOptions(scale="2=frame_000000.png,frame_000003.png")
    for place in (distance, PlaceOptions(upright=True)):
        output = tmp_path / "model"
        report = map_database(database, images, output, place=place, overwrite=True)
        assert any("coordinates" in warning for warning in report.warnings)
        assert json.loads((output / "place.json").read_text())["scale"] == 1
        points = [(folder / "points3D.bin").read_bytes() for folder in (mapped_model, report.model)]
        assert points[0] == points[1]


def test_intrinsics_are_kept_or_refined(database: Path, images: Path, tmp_path: Path) -> None:
    def focal_lengths(report: MapReport) -> tuple[float, float]:
        """The focal length of the database, and that of the model."""
        given = pycolmap.Database.open(copy)
        (camera,) = given.read_all_cameras()
        given.close()
        return camera.mean_focal_length(), report.figures.focal_lengths[0]

    copy = tmp_path / "copy.db"
    shutil.copyfile(database, copy)
    fixed = MapOptions(refine_intrinsics=False)
    given, kept = focal_lengths(map_database(database, images, tmp_path / "a", options=fixed))
    assert kept == given
    given, refined = focal_lengths(map_database(database, images, tmp_path / "b"))
    assert refined != given


@pytest.mark.shared
def test_options_for_forward_motion_are_chosen(street: Street, tmp_path: Path) -> None:
    """With default limits, the mapper has no initial pair of a drive."""
    options = MatchOptions(camera=STREET)
    match(tmp_path / "a.db", street(12), image_path=tmp_path / "images", options=options)

    def mapped(
        name: str, forward_motion: bool | None = None, mapper: Mapper = "incremental"
    ) -> MapReport:
        options = MapOptions(mapper=mapper, forward_motion=forward_motion)
        return map_database(
            tmp_path / name,
            tmp_path / "images",
            tmp_path / "model",
            options=options,
            overwrite=True,
        )

    known = mapped("a.db")
    assert (known.forward_motion, known.num_registered) == (True, (12,))
    assert mapped("a.db", mapper="global").num_registered == (12,)
    with pytest.raises(ModelError):
        mapped("a.db", forward_motion=False)
    # Without a known focal length, the default limits are tried first.
    shutil.copyfile(tmp_path / "a.db", tmp_path / "b.db")
    with sqlite3.connect(tmp_path / "b.db") as connection:
        connection.execute("UPDATE cameras SET prior_focal_length = 0")
    connection.close()
    unknown = mapped("b.db")
    assert (unknown.forward_motion, unknown.num_registered) == (True, (12,))


def test_initial_pair_has_the_given_angle(database: Path, images: Path, tmp_path: Path) -> None:
    def relaxes(angle: float, output: Path) -> bool:
        """Whether the mapper has to lower the limit to begin."""
        map_database(database, images, output, options=MapOptions(init_min_tri_angle=angle))
        return "elaxing" in (output / "mapper.log").read_text()

    assert relaxes(89.0, tmp_path / "a")
    assert not relaxes(1.0, tmp_path / "b")


def test_bad_databases_and_folders_are_reported(
    database: Path, images: Path, tmp_path: Path
) -> None:
    output = tmp_path / "model"
    with pytest.raises(DatabaseError, match="no such file"):
        map_database(tmp_path / "missing.db", images, output)
    (tmp_path / "zero.db").write_bytes(b"")
    with pytest.raises(DatabaseError, match="empty"):
        map_database(tmp_path / "zero.db", images, output)
    unmatched = tmp_path / "unmatched.db"
    shutil.copyfile(database, unmatched)
    with sqlite3.connect(unmatched) as connection:
        connection.execute("DELETE FROM two_view_geometries")
    connection.close()
    with pytest.raises(DatabaseError, match="no pair"):
        map_database(unmatched, images, output)
    with pytest.raises(ImageError, match="no such folder"):
        map_database(database, tmp_path / "missing", output)
    (tmp_path / "some").mkdir()
    with pytest.raises(ImageError, match=r"frame_000000\.png"):
        map_database(database, tmp_path / "some", output)
    for path in images.iterdir():
        cv2.imwrite(str(tmp_path / "some" / path.name), np.zeros((8, 16, 3), np.uint8))
    with pytest.raises(ImageError, match="16x8"):
        map_database(database, tmp_path / "some", output)
    # The last image has a camera of its own, of which only its image has another size.
    several = tmp_path / "several.db"
    shutil.copyfile(database, several)
    with sqlite3.connect(several) as connection:
        connection.execute("INSERT INTO cameras SELECT 9, model, 16, 8, params, 0 FROM cameras")
        connection.execute("UPDATE images SET camera_id = 9 WHERE image_id = ?", (NUM_IMAGES,))
    connection.close()
    with pytest.raises(ImageError, match="16x8"):
        map_database(several, images, output)
    typo = PlaceOptions(scale="2=frame_000000.png,typo.png")
    with pytest.raises(OptionError, match="typo"):
        map_database(database, tmp_path / "some", output, place=typo)
    assert not list(tmp_path.glob("*model*"))
    with pytest.raises(OptionError, match="not empty"):
        map_database(database, images, tmp_path / "some")


def test_failure_to_map_leaves_only_a_log(database: Path, images: Path, tmp_path: Path) -> None:
    """The pairs have too few inliers to start a model."""
    few = tmp_path / "few.db"
    shutil.copyfile(database, few)
    with sqlite3.connect(few) as connection:
        for table in ("two_view_geometries", "matches"):
            connection.execute(
                f"UPDATE {table} SET rows = 20, data = substr(data, 1, 20 * 8) WHERE rows > 20"
            )
        num_inliers = connection.execute("SELECT SUM(rows) FROM two_view_geometries").fetchone()[0]
    connection.close()
    assert num_inliers > 0
    with pytest.raises(ModelError, match="no model") as failed:
        map_database(few, images, tmp_path / "model")
    assert [p.name for p in tmp_path.iterdir()] == ["few.db"]
    log = re.search(r"\S+\.log", str(failed.value))
    assert log is not None
    Path(log[0]).unlink()


def test_second_run_into_one_folder_fails_if_another_ends_first(
    database: Path, images: Path, tmp_path: Path
) -> None:
    output, is_waiting = tmp_path / "model", [True]

    def map_meanwhile(*_: object) -> None:
        if is_waiting:
            is_waiting.clear()
            map_database(database, images, output)

    with pytest.raises(WriteError, match="meanwhile"):
        map_database(database, images, output, progress=map_meanwhile)
    models = [*tmp_path.iterdir()]
    assert [read_model(path / "0").num_reg_images() for path in models] == [NUM_IMAGES] * 2


def test_interrupt_leaves_nothing(database: Path, images: Path, tmp_path: Path) -> None:
    def interrupt(stage: str, done: int, total: int | None) -> None:
        if done >= 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        map_database(database, images, tmp_path / "model", progress=interrupt)
    assert list(tmp_path.iterdir()) == []


def test_command_leaves_no_log_files_of_colmap(
    database: Path, images: Path, tmp_path: Path
) -> None:
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    words = ["map", "--database_path", database, "--image_path", images]
    subprocess.run(
        [sys.executable, "-m", "colmap_av1", *words, "--output_path", tmp_path / "model"],
        env={**os.environ, "TMPDIR": str(temporary)},
        cwd=tmp_path,
        check=True,
        capture_output=True,
    )
    assert list(temporary.iterdir()) == []


def test_command_reports_the_model_and_refuses_an_existing_folder(
    database: Path, images: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["map", "--database_path", str(database), "--image_path", str(images)]
    words += ["--output_path", str(tmp_path / "model")]
    assert main(words) == 0
    rows = dict(line.split("\t") for line in capsys.readouterr().out.splitlines())
    assert rows["images registered"] == f"{NUM_IMAGES} of {NUM_IMAGES}"
    assert int(rows["points"]) > 300
    assert rows["model written to"] == str(tmp_path / "model" / "0")
    assert main(words) == 2
    error = capsys.readouterr().err
    assert error.startswith("colmap-av1: error: ")
    assert error.count("\n") == 1

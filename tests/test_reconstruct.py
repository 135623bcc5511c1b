"""`reconstruct`: its model, report, resumed runs and errors."""

from __future__ import annotations

import errno
import importlib
import json
import os
import re
import shutil
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Literal

import cv2
import imageio_ffmpeg
import numpy as np
import pycolmap
import pytest
from conftest import Encode, Ffmpeg, make_frames
from dense_scene import EVERY, NUM_IMAGES, OPTIONS, SCENE, Truth
from sequences import model_poses
from trainers import TRAINERS, Taken, brush

from colmap_av1.cli import main
from colmap_av1.cli.reports import reconstruct_rows
from colmap_av1.errors import ImageError, ModelError, OptionError, VideoError, WriteError
from colmap_av1.evaluate.metrics.poses import pose_errors
from colmap_av1.geometry.colmap_model import posed_images, read_model
from colmap_av1.geometry.posed_model import read_posed_model
from colmap_av1.options import (
    CameraOptions,
    ImageOptions,
    LinkOptions,
    MatchOptions,
    ReadOptions,
    ReconstructOptions,
    RunOptions,
    TrackOptions,
    TriangulateOptions,
)
from colmap_av1.reconstruct import ReconstructReport, reconstruct
from colmap_av1.util.spread import evenly_spread
from colmap_av1.video.unchanged import file_state

OPTIONS_OF_ALL_FRAMES = replace(OPTIONS, match=MatchOptions())


@pytest.fixture
def copy(made: ReconstructReport, tmp_path: Path) -> Path:
    """A copy of the finished output, for a run that resumes it."""
    return Path(shutil.copytree(made.output, tmp_path / "out"))


def products(output: Path) -> dict[Path, bytes]:
    """Contents of the images and models of an output."""
    return {p: p.read_bytes() for p in output.glob("[is]*/**/*.*")}


def interrupt_at(stage: str) -> Callable[[str, int, int | None], None]:
    """A progress callback that interrupts the run when it reaches a stage."""

    def interrupt(reached: str, done: int, total: int | None) -> None:
        if reached == stage:
            raise KeyboardInterrupt

    return interrupt


def test_images_and_points_of_the_model_agree(made: ReconstructReport) -> None:
    """They have the same observations, and the errors of points follow from the poses."""
    model = pycolmap.Reconstruction(made.output / "sparse" / "0")
    (camera,) = model.cameras.values()
    assert model.num_points3D() == made.num_points
    assert model.compute_num_observations() == made.num_observations
    for point_id in sorted(model.points3D)[::101]:
        point = model.points3D[point_id]
        errors = []
        for element in point.track.elements:
            image = model.images[element.image_id]
            keypoint = image.points2D[element.point2D_idx]
            assert keypoint.point3D_id == point_id
            at = camera.img_from_cam(image.cam_from_world() * point.xyz)
            errors.append(np.linalg.norm(at - keypoint.xy))
        assert len({element.image_id for element in point.track.elements}) >= 3
        assert max(errors) <= 2.0 + 1e-6
        assert np.mean(errors) == pytest.approx(point.error, abs=1e-6)
    assert model.compute_mean_reprojection_error() == pytest.approx(made.mean_error)


def test_model_has_the_form_that_trainers_need(made: ReconstructReport) -> None:
    """It has pinhole cameras, image names with one dot and no folder, and coloured points.

    gaussian-splatting accepts only the two pinhole models, and cuts an image name at its first dot.
    gsplat pairs sorted names with sorted files. OpenSplat finds an image by its file name.
    """
    folder = made.output / "sparse" / "0"
    assert {"cameras.bin", "images.bin", "points3D.bin"} <= {p.name for p in folder.iterdir()}
    model = pycolmap.Reconstruction(folder)
    names = [image.name for image in model.images.values()]
    assert sorted(names) == sorted(p.name for p in (made.output / "images").iterdir())
    assert len(names) == made.num_registered == NUM_IMAGES
    for image in model.images.values():
        assert image.name.split(".")[0] == Path(image.name).stem
        assert image.camera.model_name in ("SIMPLE_PINHOLE", "PINHOLE")
        picture = cv2.imread(str(made.output / "images" / image.name))
        assert picture.shape == (image.camera.height, image.camera.width, 3)
    rgb = np.array([point.color for point in model.points3D.values()])
    assert rgb.max() > 100
    assert rgb.std() > 10


def test_colours_of_points_are_pixels_of_the_images(made: ReconstructReport) -> None:
    """Each point has the colour of a pixel in one of its images. JPEG changes it a little."""
    model = read_model(made.output / "sparse" / "0")
    pictures = {
        i: cv2.imread(str(made.output / "images" / image.name))[..., ::-1].astype(int)
        for i, image in model.images.items()
    }
    smallest = []
    for point in list(model.points3D.values())[::50]:
        differences = []
        for element in point.track.elements:
            x, y = model.images[element.image_id].points2D[element.point2D_idx].xy.astype(int)
            differences.append(np.abs(pictures[element.image_id][y, x] - point.color).max())
        smallest.append(min(differences))
    assert np.median(smallest) <= 3
    assert max(smallest) <= 25


@pytest.mark.parametrize("trainer", TRAINERS)
def test_trainers_read_the_finished_model(
    made: ReconstructReport, trainer: Callable[[Path], Taken]
) -> None:
    check_files_of_trainer(trainer(made.output), made.output)


def check_files_of_trainer(taken: Taken, output: Path) -> None:
    """Check that a trainer reads the model of an output, with its pictures and points."""
    assert taken.model == output / "sparse" / "0"
    assert taken.points == taken.model / "points3D.bin"
    assert all(picture == output / "images" / name for name, picture in taken.pictures.items())
    assert all(picture.is_file() for picture in taken.pictures.values())


def test_no_other_file_looks_like_an_input_of_a_trainer(made: ReconstructReport) -> None:
    """Brush and other trainers search hidden folders, too."""
    kinds = re.compile(
        r"(cameras|images|points3D)\..*|transforms.*\.json|.*\.(ply|png|jpe?g)", re.IGNORECASE
    )
    found = {
        path.relative_to(made.output).parts[0]
        for path in made.output.rglob("*")
        if path.is_file() and kinds.fullmatch(path.name)
    }
    assert found == {"images", "sparse"}


def test_trainer_finds_the_masks_of_the_images(copy: Path) -> None:
    masked = reconstruct(SCENE, copy, options=replace(OPTIONS, moving="mask"))
    for name, masks in brush(masked.output).masks.items():
        assert masks == {masked.output / "masks" / Path(name).with_suffix(".png").name}
    reconstruct(SCENE, copy, options=OPTIONS)
    assert not (copy / "masks").exists()


def test_masks_of_the_user_stay_in_the_output(copy: Path) -> None:
    mine = copy / "masks" / "mine.png"
    mine.parent.mkdir()
    mine.write_bytes(b"mine")
    resumed = reconstruct(SCENE, copy, options=OPTIONS)
    again = reconstruct(SCENE, copy, options=replace(OPTIONS, undistort=False))
    assert ("model" in resumed.resumed, "model" in again.resumed) == (True, False)
    assert mine.read_bytes() == b"mine"


def test_poses_are_accurate(made: ReconstructReport, truth: Truth) -> None:
    model = read_model(made.output / "sparse" / "0")
    errors = pose_errors(model_poses(model, 60), truth.cam_from_world)
    assert errors.num_poses == NUM_IMAGES
    assert errors.ate < 0.01 * errors.extent
    assert errors.rotation < 0.3
    assert made.num_points > 10_000
    assert made.mean_error < 0.5
    assert made.expected_error is not None
    assert 0 < made.expected_error < 0.001


def test_report_describes_the_result(made: ReconstructReport, tmp_path: Path) -> None:
    report = json.loads((made.output / "report.json").read_text())
    assert report["num_points"] == made.num_points
    assert report["mapper"] == "global"
    assert set(report["seconds"]) >= {"motion", "poses", "points", "images"}
    assert report["cpu_seconds"].keys() == report["seconds"].keys()
    # This time is spent in another process.
    assert report["cpu_seconds"]["poses"] > 0.1
    # pycolmap migrates the database that it opens.
    shutil.copyfile(made.database, tmp_path / "copy.db")
    with pycolmap.Database.open(tmp_path / "copy.db") as database:
        assert database.num_images() == made.num_key_images == len(range(0, NUM_IMAGES, 2)) + 1
        assert database.num_verified_image_pairs() > NUM_IMAGES


def test_forward_motion_is_reported(made: ReconstructReport) -> None:
    assert not made.forward_motion
    assert "motion" not in dict(reconstruct_rows(made))
    (motion,) = (
        value
        for name, value in reconstruct_rows(replace(made, forward_motion=True))
        if name == "motion"
    )
    assert "forward" in motion


def test_short_tracks_are_not_in_the_database(tmp_path: Path) -> None:
    """Only the points use them. The database, and thus the poses, do not depend on them."""
    written = []
    for name, tracks in (("all", TrackOptions()), ("longer", TrackOptions(min_length=4))):
        options = replace(OPTIONS, match=MatchOptions(tracks=tracks))
        with pytest.raises(KeyboardInterrupt):
            reconstruct(SCENE, tmp_path / name, options=options, progress=interrupt_at("poses"))
        with np.load(tmp_path / name / ".stages" / "tracks.npz") as file:
            written.append((np.diff(file["offsets"]).min(), tmp_path / name / "database.db"))
    assert [shortest for shortest, _ in written] == [3, 4]
    assert written[0][1].read_bytes() == written[1][1].read_bytes()


def test_max_images_limits_the_images_of_long_videos(tmp_path: Path) -> None:
    """The limit is approximate, and does not apply if `every` is given.

    If a video has many more frames than `max_images`, only twice as many frames are candidates.
    """
    chosen = []
    for name, images, max_images in (
        ("few", ImageOptions(), 25),
        ("all", ImageOptions(every=1), 25),
        ("fewer", ImageOptions(), 10),
    ):
        options = ReconstructOptions(match=MatchOptions(images=images), max_images=max_images)
        with pytest.raises(KeyboardInterrupt):
            reconstruct(SCENE, tmp_path / name, options=options, progress=interrupt_at("pairs"))
        with np.load(tmp_path / name / ".stages" / "tracks.npz") as file:
            chosen.append(file["frames"])
            np.testing.assert_array_equal(np.unique(file["frame"]), chosen[-1])
            assert np.diff(file["offsets"]).min() >= (2 if name != "all" else 3)
            assert file["names"][1] == f"frame_{chosen[-1][1]:06d}.jpg"
    assert 25 <= len(chosen[0]) <= 30
    assert (chosen[0][0], chosen[0][-1], len(chosen[1])) == (0, 59, 60)
    assert 10 <= len(chosen[2]) <= 12
    assert set(chosen[2].tolist()) <= set(evenly_spread(60, 20))


def test_tracks_of_a_long_video_do_not_depend_on_the_limit_of_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With little memory, the motion is read twice: to choose images, and to track points."""
    tracks = []
    for name, max_held in (("once", 1 << 40), ("twice", 0)):
        monkeypatch.setattr("colmap_av1.poses.track_stage._MAX_HELD", max_held)
        monkeypatch.setattr(
            "colmap_av1.poses.track_stage.spread_images",
            lambda *_: np.arange(0, 60, 5, dtype=np.int32),
        )
        monkeypatch.setattr("colmap_av1.poses.track_stage._CANDIDATES", 6)
        options = ReconstructOptions(max_images=10)
        with pytest.raises(KeyboardInterrupt):
            reconstruct(SCENE, tmp_path / name, options=options, progress=interrupt_at("pairs"))
        with np.load(tmp_path / name / ".stages" / "tracks.npz") as file:
            tracks.append({part: file[part] for part in file.files})
    for part, values in tracks[0].items():
        np.testing.assert_array_equal(values, tracks[1][part])


def test_finished_stages_are_resumed(made: ReconstructReport, copy: Path, tmp_path: Path) -> None:
    """They do not depend on the number of threads and the path of the video."""
    files = {p: p.stat().st_mtime_ns for p in copy.glob("[is]*/**/*.*")}
    video = tmp_path / "elsewhere.mp4"
    shutil.copyfile(SCENE, video)
    match = replace(OPTIONS.match, read=ReadOptions(num_threads=1), run=RunOptions(num_threads=1))
    again = reconstruct(video, copy, options=replace(OPTIONS, match=match))
    assert set(again.resumed) >= {"tracks", "matches", "poses", "adjustment", "model"}
    assert {p: p.stat().st_mtime_ns for p in copy.glob("[is]*/**/*.*")} == files
    assert (again.num_points, again.mean_error) == (made.num_points, made.mean_error)
    assert again.warnings == made.warnings


def contents(output: Path) -> dict[str, bytes]:
    """Contents of the files of an output, except for logs, locks and JSON files with times."""
    files = (p for p in output.rglob("*") if p.is_file() and p.name != "report.json")
    kept = [p for p in files if p.suffix not in (".log", ".lock", ".json")]
    return {str(p.relative_to(output)): p.read_bytes() for p in kept}


def test_damaged_files_are_written_again(copy: Path) -> None:
    """The files are deleted, truncated, or overwritten by zeros."""
    before = contents(copy)
    for name in (".stages/tracks.npz", ".stages/dynamic.npz", "images/frame_000006.jpg"):
        (copy / name).unlink()
    for name in ("database.db", ".stages/resected.npz"):
        os.truncate(copy / name, (copy / name).stat().st_size - 1)
    for name in (".stages/poses/0.npz", "sparse/0/points3D.bin"):
        (copy / name).write_bytes(bytes((copy / name).stat().st_size))
    resumed = reconstruct(SCENE, copy, options=OPTIONS).resumed
    assert not {"tracks", "matches", "poses", "resection", "dynamic", "model"} & set(resumed)
    assert contents(copy) == before


def test_tracks_of_another_length_are_matched_again(copy: Path) -> None:
    """Points use tracks of three frames in any case, but poses only if the option says so."""
    tracks = replace(OPTIONS.match.tracks, min_length=3)
    shorter = replace(OPTIONS, match=replace(OPTIONS.match, tracks=tracks))
    assert not {"tracks", "matches"} & set(reconstruct(SCENE, copy, options=shorter).resumed)


def test_gaussians_of_an_earlier_model_are_removed(copy: Path) -> None:
    """Brush would begin with them. Files of other programs are kept."""
    own, other = copy / "init.ply", copy / "other.ply"
    other.write_bytes(b"ply\nformat ascii 1.0\nend_header\n")
    assert reconstruct(SCENE, copy, gaussians=own, options=OPTIONS).gaussians == own
    assert reconstruct(SCENE, copy, options=OPTIONS).warnings == ()
    assert own.exists()  # the model is the same
    strict = replace(OPTIONS, triangulate=TriangulateOptions(min_observations=6))
    reconstruct(SCENE, copy, options=strict)
    assert not own.exists()
    assert other.exists()


def test_changed_option_redoes_the_stages_that_depend_on_it(
    made: ReconstructReport, copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The old output is kept until the new one is complete, and files of others are always kept."""
    before = products(copy)
    mine = [copy / n for n in ("images/mine.png", "sparse/0/points3D.ply", "sparse/1/mine.txt")]
    mine[-1].parent.mkdir()
    for file in mine:
        file.write_text("written by a user or a trainer")
    others = {file: file.read_bytes() for file in mine}
    strict = replace(OPTIONS, triangulate=TriangulateOptions(min_observations=6))

    def interrupt(stage: str, done: int, total: int | None) -> None:
        if stage == "images" and done > 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        reconstruct(SCENE, copy, options=strict, progress=interrupt)
    assert products(copy) == before | others

    def fail_on_full_disk(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        writer = importlib.import_module("colmap_av1.splats.reconstruct_model")
        patch.setattr(writer, "write_model", fail_on_full_disk)
        with pytest.raises(WriteError, match="No space left"):
            reconstruct(SCENE, copy, options=strict)
    assert products(copy) == before | others
    assert not list((copy / ".stages").glob("*.partial"))

    fewer = reconstruct(SCENE, copy, options=strict)
    assert "adjustment" in fewer.resumed
    assert "model" not in fewer.resumed
    assert fewer.num_points < made.num_points
    assert reconstruct(SCENE, copy, options=OPTIONS).num_points == made.num_points
    assert products(copy) == before | others


def test_too_few_frames_are_an_error(encode: Encode, tmp_path: Path) -> None:
    one, two, three = (encode(make_frames(n), tmp_path / f"{n}.mp4") for n in (1, 2, 3))
    with pytest.raises(ImageError, match="longer video"):
        reconstruct(one, tmp_path / "out")
    with pytest.raises(ImageError, match="2 of 2 frames"):
        reconstruct(two, tmp_path / "out")
    with pytest.raises(VideoError, match="has 3"):
        reconstruct(three, tmp_path / "out")


def test_converted_stream_is_kept_in_the_output(encode: Encode, tmp_path: Path) -> None:
    """A later run uses it. Both runs here fail when images are chosen."""
    (tmp_path / "videos").mkdir()
    video = encode(make_frames(2), tmp_path / "videos" / "phone.mp4", "-c:v", "libx264")
    output, states = tmp_path / "out", []
    for _ in range(2):
        with pytest.raises(ImageError, match="2 of 2 frames"):
            reconstruct(video, output)
        states.append(file_state(output / ".stages" / "stream.mp4"))
    assert states[0].found is not None
    assert states[0] == states[1]
    assert list(video.parent.iterdir()) == [video]
    assert [p.name for p in tmp_path.iterdir()] == ["videos", "out"]


def test_model_of_two_images_is_an_error(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def map_two(*_: object, **__: object) -> tuple[int, ...]:
        return (2,)

    stages = importlib.import_module("colmap_av1.poses.mapping_stage")
    monkeypatch.setattr(stages, "map_poses", map_two)
    other = replace(OPTIONS, poses=replace(OPTIONS.poses, mapper="incremental"))
    with pytest.raises(ModelError, match="--mapper"):
        reconstruct(SCENE, copy, options=other)


def test_video_that_changes_during_the_run_is_an_error(copy: Path, tmp_path: Path) -> None:
    """Otherwise, the tracks and images could come from different videos."""
    video = tmp_path / "v.mp4"
    shutil.copyfile(SCENE, video)
    shutil.rmtree(copy / "sparse")

    def change(stage: str, done: int, total: int | None) -> None:
        if stage == "images" and done == 2:
            video.touch()

    with pytest.raises(VideoError, match="changed"):
        reconstruct(video, copy, options=OPTIONS, progress=change)
    assert not (copy / "sparse").exists()
    assert not list((copy / ".stages").glob("*.partial"))


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux can end a child with its parent")
def test_killed_run_ends_its_mapper_and_is_resumed(made: ReconstructReport, tmp_path: Path) -> None:
    """The output of both runs has the same bytes as that of a single run."""
    output = tmp_path / "out"
    words = ["--video", str(SCENE), "--output", str(output), "--every", str(EVERY)]
    words += ["--pose_tracks_per_image", "300", "--pose_spacing", "24"]
    command = [sys.executable, "-m", "colmap_av1", "reconstruct", *words, "--quiet"]
    with subprocess.Popen(command, cwd=tmp_path) as process:
        while not (output / ".stages" / "mapper.log").is_file():
            assert process.poll() is None
            time.sleep(0.01)
        process.kill()
    deadline = time.monotonic() + 10
    while any(str(output).encode() in command_line_of(p) for p in Path("/proc").glob("[0-9]*")):
        assert time.monotonic() < deadline
        time.sleep(0.01)
    again = reconstruct(SCENE, output, options=OPTIONS)
    assert {"tracks", "matches"} <= set(again.resumed)
    assert "poses" not in again.resumed
    for path in made.output.glob("[is]*/**/*.*"):
        assert (output / path.relative_to(made.output)).read_bytes() == path.read_bytes()
    assert not list(output.glob("**/*.partial"))


def command_line_of(process: Path) -> bytes:
    """Command line of a process in /proc; empty if it has ended."""
    try:
        return (process / "cmdline").read_bytes()
    except OSError:
        return b""


@pytest.mark.parametrize("links", ["auto", "none"])
def test_failed_long_range_check_adds_loop_closures(
    copy: Path, monkeypatch: pytest.MonkeyPatch, links: Literal["auto", "none"]
) -> None:
    """Without links, a warning suggests them instead."""
    monkeypatch.setattr("colmap_av1.poses.long_range._MAX_ERROR", 0.0)
    options = replace(OPTIONS, match=replace(OPTIONS.match, links=LinkOptions(links)))
    for name in ("long_range", "first_estimate"):
        (copy / ".stages" / f"{name}.json").unlink()
    found = reconstruct(SCENE, copy, options=options)
    assert found.links.searched_loops == (links == "auto")
    assert (found.links.num_images > 0) == (links == "auto")
    assert found.num_registered == NUM_IMAGES
    assert any("--links sift" in warning for warning in found.warnings) == (links == "none")
    assert "long_range" in reconstruct(SCENE, copy, options=options).resumed


def test_failed_long_range_check_adds_loop_closures_outside_fast_stretches(
    copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At first, loop closures are only searched in the stretch with fast motion."""
    monkeypatch.setattr("colmap_av1.poses.long_range._MAX_ERROR", 0.0)
    monkeypatch.setattr(
        "colmap_av1.images.track_images.fast_frames",
        lambda tracks: np.arange(tracks.num_frames) < 12,
    )
    for record in (copy / ".stages").glob("*.json"):
        record.unlink()
    found = reconstruct(SCENE, copy, options=OPTIONS)
    assert found.links.fast == ((0, 9),)  # every third frame is an image, so this is four images
    assert found.links.num_images > 4
    assert found.links.searched_loops


def test_warning_names_images_that_are_not_registered(
    copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Images with fewer than 95 % of the median number of points are removed from the model.
    monkeypatch.setattr("colmap_av1.poses.adjusting._LEAST_OBSERVED", 10_000)
    monkeypatch.setattr("colmap_av1.poses.adjusting._LEAST_OBSERVED_SHARE", 0.95)
    (copy / ".stages" / "adjustment.json").unlink()
    found = reconstruct(SCENE, copy, options=OPTIONS)
    written = {path.name for path in (copy / "images").iterdir()}
    assert found.num_registered == len(written) < NUM_IMAGES
    every = [f"frame_{EVERY * i:06d}.jpg" for i in range(NUM_IMAGES)]
    not_registered = [name for name in every if name not in written]
    share = f"{len(not_registered)} of {NUM_IMAGES}"
    (warning,) = [warning for warning in found.warnings if share in warning]
    assert not_registered[0] in warning


@pytest.fixture
def may_bend(copy: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The copy, whose model may bend at every seam, although none splits it, for the next run."""
    monkeypatch.setattr("colmap_av1.poses.seams._LOST", 2.0)
    monkeypatch.setattr("colmap_av1.poses.seams._SCALED", 1_000_000)
    monkeypatch.setattr("colmap_av1.poses.seams._DEEP", -1)
    monkeypatch.setattr("colmap_av1.poses.parts._WITHIN_VIDEO", 0)
    monkeypatch.setattr("colmap_av1.geometry.uncertainty.MAX_CERTAIN_ERROR", 0.0)
    (copy / ".stages" / "adjustment.json").unlink()
    return copy


@pytest.mark.parametrize("num_certain", [14, 0])
def test_uncertain_images_of_a_model_that_may_bend_are_removed(
    may_bend: Path, monkeypatch: pytest.MonkeyPatch, num_certain: int
) -> None:
    """If no image is certain, all are kept, with a warning."""
    certain = {f"frame_{EVERY * i:06d}.jpg" for i in range(num_certain)}
    monkeypatch.setattr("colmap_av1.poses.parts.certain_parts", lambda *_: [certain])
    found = reconstruct(SCENE, may_bend, options=OPTIONS)
    assert found.num_registered == (num_certain or NUM_IMAGES)
    assert any("positions" in warning for warning in found.warnings)


def test_long_range_checks_of_a_split_model_are_resumed(
    may_bend: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both the check of the whole model and that of the part that is left."""
    certain = {f"frame_{EVERY * i:06d}.jpg" for i in range(14)}
    monkeypatch.setattr("colmap_av1.poses.parts.certain_parts", lambda *_: [certain])
    checks = []

    def watch(stage: str, done: int, total: int | None) -> None:
        if stage == "long range" and done == total:
            checks.append(total)

    first = reconstruct(SCENE, may_bend, options=OPTIONS, progress=watch)
    assert len(checks) == 2
    again = reconstruct(SCENE, may_bend, options=OPTIONS, progress=watch)
    assert len(checks) == 2
    assert "long_range" in again.resumed
    assert first.long_range is not None
    assert (again.long_range, again.num_registered) == (first.long_range, 14)


def test_adjustment_makes_the_mapped_poses_more_accurate(
    made: ReconstructReport, truth: Truth, copy: Path
) -> None:
    """Without adjustment and key images, all poses are those of the mapper."""
    unadjusted = replace(OPTIONS.poses, adjust=False, key_images=False)
    plain = reconstruct(SCENE, copy, options=replace(OPTIONS, poses=unadjusted))
    assert plain.num_key_images == plain.num_registered == NUM_IMAGES
    # The camera is estimated from all images in both cases.
    assert cameras_of(plain.database) == cameras_of(made.database)
    mapped = read_posed_model(plain.output / ".stages" / "poses" / "0.npz").by_name
    poses = model_poses(read_model(plain.output / "sparse" / "0"), 60)
    for name, image in posed_images(read_model(plain.output / "sparse" / "0")).items():
        np.testing.assert_allclose(image.cam_from_world, mapped[name].cam_from_world, atol=1e-9)
    adjusted = model_poses(read_model(made.output / "sparse" / "0"), 60)
    after, before = (pose_errors(p, truth.cam_from_world) for p in (adjusted, poses))
    # With a loss that hardly reduces errors of half a pixel, the ratios would be 0.40 and 0.75.
    assert after.ate < 0.35 * before.ate
    assert after.rotation < 0.6 * before.rotation


def cameras_of(database: Path) -> list[tuple[int, bytes]]:
    with closing(sqlite3.connect(database)) as opened:
        return opened.execute("SELECT model, params FROM cameras").fetchall()


def test_output_with_files_of_others_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("chapter 1")
    with pytest.raises(OptionError, match="not empty"):
        reconstruct(SCENE, tmp_path, options=OPTIONS)
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.tex"]


def test_model_of_another_video_is_replaced_only_on_request(copy: Path, tmp_path: Path) -> None:
    """Even if the video has the same name, and the report is of another version."""
    before = products(copy)
    report = copy / "report.json"
    found = json.loads(report.read_text())
    del found["coverage"]
    report.write_text(json.dumps(found))
    other = tmp_path / SCENE.name
    cut = ["-i", str(SCENE), "-c", "copy", "-frames:v", "30", str(other)]
    subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", *cut], check=True)
    for text in (report.read_text(), "[]", "{"):
        report.write_text(text)
        with pytest.raises(OptionError, match="overwrite"):
            reconstruct(other, copy, options=OPTIONS)
    assert products(copy) == before
    assert reconstruct(other, copy, overwrite=True, options=OPTIONS).num_frames == 30


def test_camera_that_only_rotates_is_an_error(encode: Encode, tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    wall = cv2.resize(rng.integers(0, 256, (90, 120, 3), dtype=np.uint8), (960, 720))
    camera = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
    frames = []
    for i in range(16):
        angle = np.radians(1.2 * (i - 8))
        rotation = cv2.Rodrigues(np.array([0.2 * angle, angle, 0]))[0]
        centred = np.array([[1, 0, -320], [0, 1, -240], [0, 0, 1]])
        homography = camera @ rotation @ np.linalg.inv(camera) @ centred
        frames.append(cv2.warpPerspective(wall, homography, (320, 240)))
    video = encode(np.stack(frames), tmp_path / "rotating.mp4")
    # With a wrong focal length, the rotation looks like motion.
    wrong = CameraOptions(camera_model="SIMPLE_RADIAL", camera_params="384,160,120,0")
    for match in (MatchOptions(), MatchOptions(camera=wrong)):
        options = replace(OPTIONS_OF_ALL_FRAMES, match=match)
        with pytest.raises(ModelError, match="not observable"):
            reconstruct(video, tmp_path / "out", options=options)
    assert not (tmp_path / "out" / "sparse").exists()


@pytest.mark.parametrize("walker", [False, True])
def test_static_camera_is_an_error(encode: Encode, tmp_path: Path, walker: bool) -> None:
    """A person who walks past is not taken for camera motion."""
    rng = np.random.default_rng(5)
    wall = cv2.resize(rng.integers(0, 256, (60, 80, 3), dtype=np.uint8), (320, 240))
    frames = np.stack([wall] * 8)
    if walker:
        coat = cv2.resize(rng.integers(0, 256, (40, 20, 3), dtype=np.uint8), (60, 120))
        for i, frame in enumerate(frames):
            frame[60:180, 40 + 9 * i : 100 + 9 * i] = coat
    video = encode(frames, tmp_path / "static.mp4")
    with pytest.raises(ModelError, match="not observable"):
        reconstruct(video, tmp_path / "out", options=OPTIONS_OF_ALL_FRAMES)
    assert (tmp_path / "out" / "database.db").is_file()
    assert not (tmp_path / "out" / "sparse").exists()


def test_commands_print_their_results_and_write_gaussians(
    made: ReconstructReport, copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["reconstruct", "--video", str(SCENE), "--output", str(copy)]
    words += ["--every", str(EVERY), "--pose_tracks_per_image", "300", "--pose-spacing", "24"]
    words += ["--points", "survey", "--gaussians", str(tmp_path / "init.ply")]
    assert main(words) == 0
    assert f"element vertex {made.num_points}\n".encode() in (tmp_path / "init.ply").read_bytes()
    printed = capsys.readouterr()
    assert f"points\t{made.num_points}, " in printed.out
    assert "resumed stages\ttracks, " in printed.out
    model = copy / "sparse" / "0"
    distorted = [*words[:-2], "--undistort", "0", "--quiet"]
    words = ["densify", "--model", str(model), "--video", str(SCENE), "--frame_list"]
    (tmp_path / "list.txt").write_text(
        "".join(f"{f} frame_{f:06d}.jpg\n" for f in range(0, 60, EVERY))
    )
    words += [str(tmp_path / "list.txt"), "--output", str(tmp_path / "dense")]
    assert main(words) == 2
    assert "undistorted" in capsys.readouterr().err
    assert main(distorted) == 0
    assert main([*words, "--gaussians", str(tmp_path / "init")]) == 2
    assert ".ply" in capsys.readouterr().err
    # Brush reads init.ply or the last .ply file of a folder, so there is one only if requested.
    assert main([*words, "--gaussians", str(tmp_path / "dense" / "init.ply")]) == 0
    assert [p.name for p in tmp_path.glob("dense/*.ply")] == ["init.ply"]
    printed = capsys.readouterr()
    assert "agree with" in printed.out
    covered = re.search(r"coverage\t(\S+)% of the images, (\S+)% in", printed.out)
    assert covered is not None
    assert float(covered[1]) > 99 > float(covered[2]) > 80
    assert main([*words, "--max_points", "7"]) == 2
    assert "max_points" in capsys.readouterr().err
    assert main(words) == 2
    assert "error: " in capsys.readouterr().err


@pytest.mark.shared
def test_short_clip_with_little_parallax_has_plausible_intrinsics(
    shared: Path, ffmpeg: Ffmpeg, tmp_path: Path
) -> None:
    """If the mapper refines the focal length here, it diverges to a seventh of the true one."""
    cut = "trim=start_frame=31:end_frame=51,setpts=PTS-STARTPTS"
    clip = shared / "sequences" / "cafe" / "clip.mp4"
    short = ffmpeg("-i", clip, "-vf", cut, "-c:v", "libx264", "-crf", "17", tmp_path / "short.mp4")
    report = reconstruct(short, tmp_path / "out")
    assert report.num_registered == report.num_images == 20
    assert not any("focal length" in warning for warning in report.warnings)

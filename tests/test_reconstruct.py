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
import numpy as np
import pycolmap
import pytest
from conftest import Encode, make_frames
from dense_scene import EVERY, NUM_IMAGES, OPTIONS, SCENE, Truth
from sequences import model_poses
from trainers import TRAINERS, Taken, brush

from colmap_av1.cli import main
from colmap_av1.cli.reports import reconstruct_rows
from colmap_av1.errors import ImageError, ModelError, OptionError, VideoError
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
    """A copy of the finished output, which another run resumes."""
    return Path(shutil.copytree(made.output, tmp_path / "out"))


def products(output: Path) -> dict[Path, bytes]:
    """The images and models of an output."""
    return {p: p.read_bytes() for p in output.glob("[is]*/**/*.*")}


def test_files_agree(made: ReconstructReport) -> None:
    """Images and points have the same observations, and the errors are those of the poses."""
    model = pycolmap.Reconstruction(made.output / "sparse" / "0")
    (camera,) = model.cameras.values()
    assert model.num_points3D() == made.num_points
    assert model.compute_num_observations() == made.num_observations
    for point_id in sorted(model.points3D)[::101]:
        point = model.points3D[point_id]
        errors = []
        for seen in point.track.elements:
            image = model.images[seen.image_id]
            keypoint = image.points2D[seen.point2D_idx]
            assert keypoint.point3D_id == point_id
            at = camera.img_from_cam(image.cam_from_world() * point.xyz)
            errors.append(np.linalg.norm(at - keypoint.xy))
        assert len({seen.image_id for seen in point.track.elements}) >= 3
        assert max(errors) <= 2.0 + 1e-6
        assert np.mean(errors) == pytest.approx(point.error, abs=1e-6)
    assert model.compute_mean_reprojection_error() == pytest.approx(made.mean_error)


def test_trainers_can_read_the_model(made: ReconstructReport) -> None:
    """A pinhole camera, flat names with one dot, images in order of their names, and colours.

    gaussian-splatting takes two pinhole models only, and a name up to its first dot; gsplat pairs
    sorted names with sorted files; OpenSplat finds an image by its file name.
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


def test_colours_are_pixels_of_the_images(made: ReconstructReport) -> None:
    """Those of one image, up to what JPEG changes."""
    model = read_model(made.output / "sparse" / "0")
    pictures = {
        i: cv2.imread(str(made.output / "images" / image.name))[..., ::-1].astype(int)
        for i, image in model.images.items()
    }
    nearest = []
    for point in list(model.points3D.values())[::50]:
        off = []
        for seen in point.track.elements:
            x, y = model.images[seen.image_id].points2D[seen.point2D_idx].xy.astype(int)
            off.append(np.abs(pictures[seen.image_id][y, x] - point.color).max())
        nearest.append(min(off))
    assert np.median(nearest) <= 3
    assert max(nearest) <= 25


@pytest.mark.parametrize("trainer", TRAINERS)
def test_trainers_take_the_finished_model(
    made: ReconstructReport, trainer: Callable[[Path], Taken]
) -> None:
    check_taken(trainer(made.output), made.output)


def check_taken(taken: Taken, output: Path) -> None:
    """A trainer takes the model of a folder, with its own pictures and points."""
    assert taken.model == output / "sparse" / "0"
    assert taken.points == taken.model / "points3D.bin"
    assert all(picture == output / "images" / name for name, picture in taken.pictures.items())
    assert all(picture.is_file() for picture in taken.pictures.values())


def test_nothing_else_in_the_folder_looks_like_input_of_a_trainer(made: ReconstructReport) -> None:
    """Brush and others search hidden folders, too."""
    kinds = re.compile(
        r"(cameras|images|points3D)\..*|transforms.*\.json|.*\.(ply|png|jpe?g)", re.IGNORECASE
    )
    found = {
        path.relative_to(made.output).parts[0]
        for path in made.output.rglob("*")
        if path.is_file() and kinds.fullmatch(path.name)
    }
    assert found == {"images", "sparse"}


def test_models_among_the_stages_of_an_earlier_version_go(copy: Path) -> None:
    """Such folders had a model with as many images as the finished one, and a smaller path."""
    for name in ("poses/0", "placed", "adjusted"):
        shutil.copytree(copy / "sparse" / "0", copy / ".stages" / name)
    assert brush(copy).model == copy / ".stages" / "adjusted"
    reconstruct(SCENE, copy, options=OPTIONS)
    check_taken(brush(copy), copy)


def test_masks_are_those_of_the_model(copy: Path) -> None:
    masked = reconstruct(SCENE, copy, options=replace(OPTIONS, moving="mask"))
    for name, masks in brush(masked.output).masks.items():
        assert masks == {masked.output / "masks" / Path(name).with_suffix(".png").name}


def test_poses_are_true(made: ReconstructReport, truth: Truth) -> None:
    model = read_model(made.output / "sparse" / "0")
    errors = pose_errors(model_poses(model, 60), truth.cam_from_world)
    assert errors.num_poses == NUM_IMAGES
    assert errors.ate < 0.01 * errors.extent
    assert errors.rotation < 0.3
    assert made.num_points > 10_000
    assert made.mean_error < 0.5


def test_report(made: ReconstructReport, tmp_path: Path) -> None:
    report = json.loads((made.output / "report.json").read_text())
    assert report["num_points"] == made.num_points
    assert report["mapper"] == "global"
    assert set(report["seconds"]) >= {"motion", "poses", "points", "images"}
    assert report["cpu_seconds"].keys() == report["seconds"].keys()
    assert report["cpu_seconds"]["poses"] > 0.1  # which another process takes
    # pycolmap brings a database to its own layout.
    shutil.copyfile(made.database, tmp_path / "copy.db")
    with pycolmap.Database.open(tmp_path / "copy.db") as database:
        assert database.num_images() == made.num_key_images == len(range(0, NUM_IMAGES, 2)) + 1
        assert database.num_verified_image_pairs() > NUM_IMAGES


def test_forward_motion_is_reported(made: ReconstructReport) -> None:
    assert not made.forward_motion
    assert "motion" not in dict(reconstruct_rows(made))
    (said,) = (
        value
        for name, value in reconstruct_rows(replace(made, forward_motion=True))
        if name == "motion"
    )
    assert "forward" in said


def test_short_tracks_are_for_points_only(tmp_path: Path) -> None:
    """The database that poses come from is the same with and without them, byte for byte."""

    def stop(stage: str, done: int, total: int | None) -> None:
        if stage == "poses":
            raise KeyboardInterrupt

    written = []
    for name, tracks in (("all", TrackOptions()), ("longer", TrackOptions(min_length=4))):
        options = replace(OPTIONS, match=MatchOptions(tracks=tracks))
        with pytest.raises(KeyboardInterrupt):
            reconstruct(SCENE, tmp_path / name, options=options, progress=stop)
        with np.load(tmp_path / name / ".stages" / "tracks.npz") as file:
            written.append((np.diff(file["offsets"]).min(), tmp_path / name / "database.db"))
    assert [shortest for shortest, _ in written] == [3, 4]
    assert written[0][1].read_bytes() == written[1][1].read_bytes()


def test_long_videos_have_fewer_images_than_frames(tmp_path: Path) -> None:
    """Of 60 frames about as many as asked for become images, unless an option says which.

    Of many more frames twice as many are looked at.
    """

    def stop(stage: str, *_: object) -> None:
        if stage == "pairs":
            raise KeyboardInterrupt

    chosen = []
    for name, images, most in (
        ("few", ImageOptions(), 25),
        ("all", ImageOptions(every=1), 25),
        ("fewer", ImageOptions(), 10),
    ):
        options = ReconstructOptions(match=MatchOptions(images=images), max_images=most)
        with pytest.raises(KeyboardInterrupt):
            reconstruct(SCENE, tmp_path / name, options=options, progress=stop)
        with np.load(tmp_path / name / ".stages" / "tracks.npz") as file:
            chosen.append(file["frames"])
            np.testing.assert_array_equal(np.unique(file["frame"]), chosen[-1])
            assert np.diff(file["offsets"]).min() >= (2 if name != "all" else 3)
            assert file["names"][1] == f"frame_{chosen[-1][1]:06d}.jpg"
    assert 25 <= len(chosen[0]) <= 30
    assert (chosen[0][0], chosen[0][-1], len(chosen[1])) == (0, 59, 60)
    assert 10 <= len(chosen[2]) <= 12
    assert set(chosen[2].tolist()) <= set(evenly_spread(60, 20))


def test_it_is_no_matter_how_often_the_motion_of_a_long_video_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The tracks of the images are the same where all are kept, or those of more frames cut."""

    def stop(stage: str, *_: object) -> None:
        if stage == "pairs":
            raise KeyboardInterrupt

    tracks = []
    for name, held in (("once", 1 << 40), ("twice", 0)):
        monkeypatch.setattr("colmap_av1.poses.track_stage._MAX_HELD", held)
        monkeypatch.setattr(
            "colmap_av1.poses.track_stage.spread_images",
            lambda *_: np.arange(0, 60, 5, dtype=np.int32),
        )
        monkeypatch.setattr("colmap_av1.poses.track_stage._CANDIDATES", 6)
        options = ReconstructOptions(max_images=10)
        with pytest.raises(KeyboardInterrupt):
            reconstruct(SCENE, tmp_path / name, options=options, progress=stop)
        with np.load(tmp_path / name / ".stages" / "tracks.npz") as file:
            tracks.append({part: file[part] for part in file.files})
    for part, values in tracks[0].items():
        np.testing.assert_array_equal(values, tracks[1][part])


def test_goes_on_after_finished_stages(made: ReconstructReport, tmp_path: Path) -> None:
    """Whatever the number of threads and wherever the video lies."""
    files = {p: p.stat().st_mtime_ns for p in made.output.glob("[is]*/**/*.*")}
    video = tmp_path / "elsewhere.mp4"
    shutil.copyfile(SCENE, video)
    match = replace(OPTIONS.match, read=ReadOptions(num_threads=1), run=RunOptions(num_threads=1))
    again = reconstruct(video, made.output, options=replace(OPTIONS, match=match))
    assert set(again.resumed) >= {"tracks", "matches", "poses", "adjustment", "model"}
    assert {p: p.stat().st_mtime_ns for p in made.output.glob("[is]*/**/*.*")} == files
    assert (again.num_points, again.mean_error) == (made.num_points, made.mean_error)
    assert again.warnings == made.warnings


def contents(output: Path) -> dict[str, bytes]:
    """What a run made, but for its report, which tells the times of its own stages."""
    files = (p for p in output.rglob("*") if p.is_file() and p.name != "report.json")
    kept = [p for p in files if p.suffix not in (".log", ".lock", ".json")]
    return {str(p.relative_to(output)): p.read_bytes() for p in kept}


def test_damaged_products_are_made_again(copy: Path) -> None:
    """Deleted, cut short, or overwritten by as many bytes."""
    before = contents(copy)
    for name in (".stages/tracks.npz", ".stages/moving.npz", "images/frame_000006.jpg"):
        (copy / name).unlink()
    for name in ("database.db", ".stages/placed.npz"):
        os.truncate(copy / name, (copy / name).stat().st_size - 1)
    for name in (".stages/poses/0.npz", "sparse/0/points3D.bin"):
        (copy / name).write_bytes(bytes((copy / name).stat().st_size))
    resumed = reconstruct(SCENE, copy, options=OPTIONS).resumed
    assert not {"tracks", "matches", "poses", "resection", "moving", "model"} & set(resumed)
    assert contents(copy) == before


def test_changed_option_redoes_what_depends_on_it(
    made: ReconstructReport, copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Files of others stay, and so does the old output until the new one is whole."""
    before = products(copy)
    mine = [copy / n for n in ("images/mine.png", "sparse/0/points3D.ply", "sparse/1/mine.txt")]
    mine[-1].parent.mkdir()
    for file in mine:
        file.write_text("of a user or a trainer")
    others = {file: file.read_bytes() for file in mine}
    strict = replace(OPTIONS, triangulate=TriangulateOptions(min_observations=6))

    def interrupt(stage: str, done: int, total: int | None) -> None:
        if stage == "images" and done > 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        reconstruct(SCENE, copy, options=strict, progress=interrupt)
    assert products(copy) == before | others

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(
            importlib.import_module("colmap_av1.splats.reconstruct_model"), "write_model", full
        )
        with pytest.raises(ModelError, match="No space left"):
            reconstruct(SCENE, copy, options=strict)
    assert products(copy) == before | others
    assert not list((copy / ".stages").glob("*.partial"))

    fewer = reconstruct(SCENE, copy, options=strict)
    assert "adjustment" in fewer.resumed
    assert "model" not in fewer.resumed
    assert fewer.num_points < made.num_points
    assert reconstruct(SCENE, copy, options=OPTIONS).num_points == made.num_points
    assert products(copy) == before | others


def test_short_videos(encode: Encode, tmp_path: Path) -> None:
    one, two, three = (encode(make_frames(n), tmp_path / f"{n}.mp4") for n in (1, 2, 3))
    with pytest.raises(ImageError, match="longer video"):
        reconstruct(one, tmp_path / "out")
    with pytest.raises(ImageError, match="2 of 2 frames"):
        reconstruct(two, tmp_path / "out")
    with pytest.raises(VideoError, match="has 3"):
        reconstruct(three, tmp_path / "out")


def test_converted_stream_is_kept_in_the_folder(encode: Encode, tmp_path: Path) -> None:
    """For runs that go on; here both end where images are chosen."""
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


def test_model_of_two_images_is_none(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def map_two(*_: object, **__: object) -> tuple[int, ...]:
        return (2,)

    stages = importlib.import_module("colmap_av1.poses.pose_stages")
    monkeypatch.setattr(stages, "map_poses", map_two)
    other = replace(OPTIONS, mapping=replace(OPTIONS.mapping, mapper="incremental"))
    with pytest.raises(ModelError, match="--mapper"):
        reconstruct(SCENE, copy, options=other)


def test_video_that_changes(copy: Path, tmp_path: Path) -> None:
    """Tracks of one video and images of another do not come together."""
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


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux ends the children of the killed")
def test_killed_run(made: ReconstructReport, tmp_path: Path) -> None:
    """The mapper ends with it, and the next run makes of the rest what one run makes."""
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
    while any(str(output).encode() in words_of(p) for p in Path("/proc").glob("[0-9]*")):
        assert time.monotonic() < deadline
        time.sleep(0.01)
    again = reconstruct(SCENE, output, options=OPTIONS)
    assert {"tracks", "matches"} <= set(again.resumed)
    assert "poses" not in again.resumed
    for path in made.output.glob("[is]*/**/*.*"):
        assert (output / path.relative_to(made.output)).read_bytes() == path.read_bytes()
    assert not list(output.glob("**/*.partial"))


def words_of(process: Path) -> bytes:
    try:
        return (process / "cmdline").read_bytes()
    except OSError:
        return b""


@pytest.mark.parametrize("links", ["auto", "none"])
def test_pictures_that_contradict_the_poses(
    copy: Path, monkeypatch: pytest.MonkeyPatch, links: Literal["auto", "none"]
) -> None:
    """Places seen again are linked then, unless there must be no links."""
    monkeypatch.setattr("colmap_av1.poses.long_range._MAX_ERROR", 0.0)
    options = replace(OPTIONS, match=replace(OPTIONS.match, links=LinkOptions(links)))
    for name in ("far_views", "seams"):
        (copy / ".stages" / f"{name}.json").unlink()
    found = reconstruct(SCENE, copy, options=options)
    assert found.links.looked_again == (links == "auto")
    assert (found.links.num_images > 0) == (links == "auto")
    assert found.num_registered == NUM_IMAGES
    assert any("--links sift" in note for note in found.warnings) == (links == "none")
    assert "far_views" in reconstruct(SCENE, copy, options=options).resumed


def test_images_that_are_left_out_are_named(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # As if those with less than the usual number of points were hidden.
    monkeypatch.setattr("colmap_av1.poses.mapper.FEW_SEEN", (10_000, 0.95))
    (copy / ".stages" / "adjustment.json").unlink()
    found = reconstruct(SCENE, copy, options=OPTIONS)
    written = {path.name for path in (copy / "images").iterdir()}
    assert found.num_registered == len(written) < NUM_IMAGES
    every = [f"frame_{EVERY * i:06d}.jpg" for i in range(NUM_IMAGES)]
    missing = [name for name in every if name not in written]
    (warning,) = [note for note in found.warnings if f"{len(missing)} of {NUM_IMAGES}" in note]
    assert missing[0] in warning


def test_without_adjustment(made: ReconstructReport, truth: Truth, copy: Path) -> None:
    """All images are mapped, none is resected."""
    mapping = replace(OPTIONS.mapping, adjust=False, key_images=False)
    plain = reconstruct(SCENE, copy, options=replace(OPTIONS, mapping=mapping))
    assert plain.num_key_images == plain.num_registered == NUM_IMAGES
    # The lens is estimated from all images all the same.
    assert cameras_of(plain.database) == cameras_of(made.database)
    mapped = read_posed_model(plain.output / ".stages" / "poses" / "0.npz").by_name
    poses = model_poses(read_model(plain.output / "sparse" / "0"), 60)
    for name, image in posed_images(read_model(plain.output / "sparse" / "0")).items():
        np.testing.assert_allclose(image.cam_from_world, mapped[name].cam_from_world, atol=1e-9)
    adjusted = model_poses(read_model(made.output / "sparse" / "0"), 60)
    errors, before = (pose_errors(p, truth.cam_from_world) for p in (adjusted, poses))
    # With a loss that counts errors of half a pixel nearly in full it would be 0.40 and 0.75.
    assert errors.ate < 0.35 * before.ate
    assert errors.rotation < 0.6 * before.rotation


def cameras_of(database: Path) -> list[tuple[int, bytes]]:
    with closing(sqlite3.connect(database)) as opened:
        return opened.execute("SELECT model, params FROM cameras").fetchall()


def test_folder_of_others(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("chapter 1")
    with pytest.raises(OptionError, match="not empty"):
        reconstruct(SCENE, tmp_path, options=OPTIONS)
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.tex"]


def test_camera_that_only_turns(encode: Encode, tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    wall = cv2.resize(rng.integers(0, 256, (90, 120, 3), dtype=np.uint8), (960, 720))
    camera = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
    frames = []
    for i in range(16):
        angle = np.radians(1.2 * (i - 8))
        turn = cv2.Rodrigues(np.array([0.2 * angle, angle, 0]))[0]
        shown = (
            camera
            @ turn
            @ np.linalg.inv(camera)
            @ np.array([[1, 0, -320], [0, 1, -240], [0, 0, 1]])
        )
        frames.append(cv2.warpPerspective(wall, shown, (320, 240)))
    frames = np.stack(frames)
    video = encode(frames, tmp_path / "flat.mp4")
    # Also with a focal length that is far off, by which the turn looks like motion.
    far_off = CameraOptions(camera_model="SIMPLE_RADIAL", camera_params="384,160,120,0")
    for match in (MatchOptions(), MatchOptions(camera=far_off)):
        options = replace(OPTIONS_OF_ALL_FRAMES, match=match)
        with pytest.raises(ModelError, match="depth is not observable"):
            reconstruct(video, tmp_path / "out", options=options)
    assert not (tmp_path / "out" / "sparse").exists()


@pytest.mark.parametrize("walker", [False, True])
def test_camera_that_stands_still(encode: Encode, tmp_path: Path, walker: bool) -> None:
    """Somebody who walks past is no motion of the camera."""
    rng = np.random.default_rng(5)
    wall = cv2.resize(rng.integers(0, 256, (60, 80, 3), dtype=np.uint8), (320, 240))
    frames = np.stack([wall] * 8)
    if walker:
        coat = cv2.resize(rng.integers(0, 256, (40, 20, 3), dtype=np.uint8), (60, 120))
        for i, frame in enumerate(frames):
            frame[60:180, 40 + 9 * i : 100 + 9 * i] = coat
    video = encode(frames, tmp_path / "still.mp4")
    with pytest.raises(ModelError, match="depth is not observable"):
        reconstruct(video, tmp_path / "out", options=OPTIONS_OF_ALL_FRAMES)
    assert (tmp_path / "out" / "database.db").is_file()
    assert not (tmp_path / "out" / "sparse").exists()


def test_command_line(
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
    words = ["densify", "--model", str(model), "--video", str(SCENE), "--frame_list"]
    (tmp_path / "list.txt").write_text(
        "".join(f"{f} frame_{f:06d}.jpg\n" for f in range(0, 60, EVERY))
    )
    words += [str(tmp_path / "list.txt"), "--output", str(tmp_path / "dense")]
    assert main([*words, "--gaussians", str(tmp_path / "init")]) == 2
    assert ".ply" in capsys.readouterr().err
    # Brush takes the last .ply of a folder, or init.ply: there is one only where it is wanted.
    assert main([*words, "--gaussians", str(tmp_path / "dense" / "init.ply")]) == 0
    assert [p.name for p in tmp_path.glob("dense/*.ply")] == ["init.ply"]
    printed = capsys.readouterr()
    assert "agree with the poses" in printed.out
    covered = re.search(r"coverage\t(\S+)% of the images, (\S+)% in", printed.out)
    assert covered is not None
    assert float(covered[1]) > 99 > float(covered[2]) > 80
    assert main([*words, "--max_points", "7"]) == 2
    assert "max_points" in capsys.readouterr().err
    assert main(words) == 2
    assert "error: " in capsys.readouterr().err

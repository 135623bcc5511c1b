"""Matching a video into a database, by the function and by the command."""

from __future__ import annotations

import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pycolmap
import pytest
from conftest import (
    AV1,
    PROJECT,
    STREET,
    Encode,
    Ffmpeg,
    Street,
    encode_two_sizes,
    make_frames,
)
from databases import keypoints_of

from colmap_av1.cli import main
from colmap_av1.database.reading import read_cameras, read_images
from colmap_av1.errors import (
    BitstreamError,
    ColmapAv1Error,
    DatabaseError,
    ImageError,
    ModelError,
    OptionError,
    VideoError,
)
from colmap_av1.images.files import alone_in, write_image, write_images
from colmap_av1.images.names import image_names
from colmap_av1.map import map_database
from colmap_av1.match import match
from colmap_av1.options import (
    CameraOptions,
    DensityOptions,
    ImageOptions,
    LinkOptions,
    MapOptions,
    MaskOptions,
    MatchOptions,
    PairOptions,
    ReadOptions,
    RefineOptions,
    RunOptions,
    TrackOptions,
    VerifyOptions,
)

PAIRS = VerifyOptions(verify="pairs")
ALL = MatchOptions(density=DensityOptions(preset="dense"), verify=PAIRS)
LK = replace(ALL, refine=RefineOptions(refine="lk"))


def tables(database: Path) -> dict[str, list[tuple]]:
    with sqlite3.connect(f"{database.resolve().as_uri()}?mode=ro", uri=True) as connection:
        return {
            table: connection.execute(f"SELECT * FROM {table} ORDER BY 1").fetchall()
            for table in ("cameras", "images", "keypoints", "matches", "two_view_geometries")
        }


def database_of_images(folder: Path, database: Path) -> Path:
    """Create a database of the images of a folder, as COLMAP does."""
    with pycolmap.Database.open(database):  # creates the file
        pass
    pycolmap.import_images(database, folder, pycolmap.CameraMode.SINGLE)
    return database


def test_report_agrees_with_a_new_database(clip: Path, tmp_path: Path) -> None:
    report = match(
        tmp_path / "a.db",
        clip,
        image_path=tmp_path / "frames",
        options=MatchOptions(verify=PAIRS),
    )
    rows = tables(tmp_path / "a.db")
    names = image_names("frame_%06d.png", range(16))
    assert [row[1] for row in rows["images"]] == names
    assert sorted(p.name for p in (tmp_path / "frames").iterdir()) == names
    assert len(rows["cameras"]) == 1
    assert rows["cameras"][0][2:4] == (192, 128)
    assert report.num_frames == report.num_coded_frames == report.num_images == 16
    assert report.num_written_images == 16
    assert report.num_observations == sum(row[1] for row in rows["keypoints"]) > 1000
    assert report.num_pairs == len(rows["matches"]) == sum(report.configs.values())
    assert report.num_matches == sum(row[1] for row in rows["matches"])
    assert report.num_inliers == sum(row[1] for row in rows["two_view_geometries"]) > 1000
    assert report.track_lengths[0.0] >= 3
    assert report.track_lengths[1.0] <= 16
    assert list(report.seconds) == [
        "choice", "motion", "tracks", "pairs", "focal length", "verification", "images", "database"
    ]  # fmt: skip
    assert report.warnings == ()


def test_default_preset_gives_about_3000_observations_per_image(tmp_path: Path) -> None:
    report = match(tmp_path / "a.db", PROJECT / "examples" / "scene.mp4")
    assert 2500 < report.num_observations / report.num_images <= 3500


@pytest.mark.parametrize("refine", ["none", "lk"])
def test_same_input_gives_the_same_bytes(
    clip: Path, tmp_path: Path, refine: Literal["none", "lk"]
) -> None:
    """The number of threads makes no difference."""
    for name, threads in (("a", 1), ("b", 2)):
        options = MatchOptions(
            refine=RefineOptions(refine=refine),
            density=DensityOptions(preset="default"),
            run=RunOptions(num_threads=threads),
        )
        match(tmp_path / f"{name}.db", clip, options=options)
    assert (tmp_path / "a.db").read_bytes() == (tmp_path / "b.db").read_bytes()


def test_existing_images_get_the_rows_of_their_frames(clip: Path, tmp_path: Path) -> None:
    """The images come from another program, and their ids are in reverse order of the names."""
    folder = tmp_path / "images"
    names = [f"{i + 1:04d}.png" for i in range(16)]
    write_images(clip, folder, names, range(16))
    database = database_of_images(folder, tmp_path / "existing.db")
    with sqlite3.connect(database) as connection:
        connection.execute("UPDATE images SET image_id = 100 - image_id")
        for table in ("rig_sensors", "frame_data", "frames", "rigs"):
            connection.execute(f"DELETE FROM {table}")
    cameras = tables(database)["cameras"]
    match(database, clip)
    match(tmp_path / "new.db", clip)

    existing, new = tables(database), tables(tmp_path / "new.db")
    assert existing["cameras"] == cameras
    frame_of_id = {row[0]: int(row[1][:4]) - 1 for row in existing["images"]}
    assert set(frame_of_id) == set(range(84, 100))
    found = {frame_of_id[row[0]]: row[1:] for row in existing["keypoints"]}
    assert found == {row[0] - 1: row[1:] for row in new["keypoints"]}
    assert len(existing["two_view_geometries"]) == len(new["two_view_geometries"])


@pytest.mark.parametrize(
    "camera",
    [
        CameraOptions(camera_model="PINHOLE"),
        CameraOptions(camera_params="200,96,64,0"),
        CameraOptions(single_camera=False),
    ],
)
def test_camera_options_are_refused_for_existing_images(
    clip: Path, tmp_path: Path, camera: CameraOptions
) -> None:
    """The database has their cameras already, so the options would have no effect."""
    database = tmp_path / "a.db"
    folder = tmp_path / "images"
    write_images(clip, folder, [f"{i:04d}.png" for i in range(16)], range(16))
    database_of_images(folder, database)
    before = database.read_bytes()
    with pytest.raises(OptionError, match="cameras"):
        match(database, clip, options=MatchOptions(camera=camera))
    assert database.read_bytes() == before


def test_matches_move_like_the_scene(clip: Path, tmp_path: Path) -> None:
    """The two layers of the scene move 2 and 4 px to the left per frame."""
    match(tmp_path / "a.db", clip)
    with pycolmap.Database.open(tmp_path / "a.db") as database:
        for i in range(1, 16):
            a, b = database.read_two_view_geometry(i, i + 1).inlier_matches.T
            step = database.read_keypoints(i + 1)[b] - database.read_keypoints(i)[a]
            is_correct = (np.abs(step[:, 0] + 2) < 0.5) | (np.abs(step[:, 0] + 4) < 0.5)
            assert len(a) > 100
            assert np.mean(is_correct & (np.abs(step[:, 1]) < 0.5)) > 0.9


@pytest.fixture(scope="module")
def plain(clip: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a database of all tracks of the clip, and its images."""
    folder = tmp_path_factory.mktemp("plain")
    match(folder / "plain.db", clip, image_path=folder / "images", options=ALL)
    return folder


@pytest.mark.parametrize("angle", [90, 180, 270])
def test_images_and_keypoints_of_a_rotated_clip_are_rotated(
    clip: Path, plain: Path, ffmpeg: Ffmpeg, tmp_path: Path, angle: int
) -> None:
    turned = ffmpeg("-display_rotation", str(angle), "-i", clip, "-c", "copy", tmp_path / "t.mp4")
    match(tmp_path / "turned.db", turned, image_path=tmp_path / "turned", options=ALL)
    size = (128, 192) if angle in (90, 270) else (192, 128)
    assert tables(tmp_path / "turned.db")["cameras"][0][2:4] == size
    # Each keypoint is at the position to which its pixel was rotated.
    turned_xy = keypoints_of(tmp_path / "turned.db")
    for name, xy in keypoints_of(plain / "plain.db").items():
        x, y = xy.T
        expected = {90: (y, 192 - x), 180: (192 - x, 128 - y), 270: (128 - y, x)}[angle]
        np.testing.assert_allclose(turned_xy[name], np.stack(expected, axis=1), atol=1e-4)
    for path in (plain / "images").iterdir():
        image = cv2.imread(str(tmp_path / "turned" / path.name))
        np.testing.assert_array_equal(image, np.rot90(cv2.imread(str(path)), angle // 90))


def test_images_of_ffmpeg_of_a_rotated_clip_get_the_same_keypoints(
    clip: Path, ffmpeg: Ffmpeg, tmp_path: Path
) -> None:
    turned = ffmpeg("-display_rotation", "90", "-i", clip, "-c", "copy", tmp_path / "t.mp4")
    (tmp_path / "images").mkdir()
    ffmpeg("-i", turned, tmp_path / "images" / "%04d.png")
    database = database_of_images(tmp_path / "images", tmp_path / "existing.db")
    match(database, turned)
    match(tmp_path / "new.db", turned)
    assert tables(tmp_path / "new.db")["keypoints"] == tables(database)["keypoints"]


def test_existing_image_without_a_camera_is_refused(clip: Path, tmp_path: Path) -> None:
    write_images(clip, tmp_path / "images", [f"{i:04d}.png" for i in range(16)], range(16))
    database = database_of_images(tmp_path / "images", tmp_path / "a.db")
    with sqlite3.connect(database) as connection:
        connection.execute("UPDATE images SET camera_id = 77 WHERE name = '0003.png'")
    before = database.read_bytes()
    with pytest.raises(DatabaseError, match="camera 77"):
        match(database, clip)
    assert database.read_bytes() == before


def test_all_frames_are_used_if_more_images_are_requested(
    clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--database", str(tmp_path / "a.db"), "--video", str(clip), "--num_images", "100"]
    assert main(["match", *words]) == 0
    assert "16 frames" in capsys.readouterr().err
    assert len(read_images(tmp_path / "a.db")) == 16


def test_every_second_frame_becomes_an_image(clip: Path, tmp_path: Path) -> None:
    report = match(tmp_path / "a.db", clip, options=MatchOptions(images=ImageOptions(every=2)))
    assert report.num_images == 8
    names = [image.name for image in read_images(tmp_path / "a.db")]
    assert names == image_names("frame_%06d.png", range(0, 16, 2))


@pytest.mark.parametrize(
    ("options", "error"),
    [
        (MatchOptions(camera=CameraOptions(camera_params="9,9,9,9,0,0,0,0")), OptionError),
        (MatchOptions(camera=CameraOptions(camera_params="900,640,360,0")), OptionError),
        (MatchOptions(images=ImageOptions(frame_list="missing.txt")), ImageError),
        (MatchOptions(pairs=PairOptions(min_matches=10**6)), VideoError),
    ],
)
def test_unsuitable_options_leave_no_files(
    clip: Path, tmp_path: Path, options: MatchOptions, error: type[ColmapAv1Error]
) -> None:
    with pytest.raises(error):
        match(tmp_path / "a.db", clip, image_path=tmp_path / "frames", options=options)
    assert list(tmp_path.iterdir()) == []


def test_links_join_the_images_if_every_frame_is_intra(encode: Encode, tmp_path: Path) -> None:
    intra = encode(make_frames(6), tmp_path / "intra.mp4", *AV1[:-1], "1")
    with pytest.raises(VideoError, match="nothing"):
        match(tmp_path / "a.db", intra, options=MatchOptions(links=LinkOptions(links="none")))
    assert not (tmp_path / "a.db").exists()
    report = match(tmp_path / "a.db", intra)
    assert report.num_tracks == 0
    assert report.track_lengths == {}
    assert report.links.num_links == report.num_pairs > 0
    assert any("intra" in warning for warning in report.warnings)


def test_truncated_stream_is_used_up_to_the_damage(
    clip: Path, ffmpeg: Ffmpeg, tmp_path: Path
) -> None:
    whole = ffmpeg("-i", clip, "-c", "copy", tmp_path / "whole.ivf")
    cut = tmp_path / "cut.ivf"
    cut.write_bytes(whole.read_bytes()[: int(whole.stat().st_size * 0.9)])
    strict = MatchOptions(read=ReadOptions(strict=True))
    with pytest.raises(BitstreamError, match=r"cut\.ivf"):
        match(tmp_path / "a.db", cut, options=strict)
    assert not (tmp_path / "a.db").exists()
    report = match(tmp_path / "a.db", cut, image_path=tmp_path / "frames", options=ALL)
    assert 8 < report.num_frames < 16
    assert report.num_images == len(list((tmp_path / "frames").iterdir())) == report.num_frames
    (warning,) = report.warnings
    assert f"{report.num_frames} frames" in warning
    refined = match(tmp_path / "b.db", cut, options=LK)
    assert refined.num_frames == report.num_frames
    assert refined.num_observations == report.num_observations


def test_images_are_spread_over_the_frames_before_the_damage(
    clip: Path, ffmpeg: Ffmpeg, tmp_path: Path
) -> None:
    """The headers do not show that the data of a frame are damaged."""
    data = bytearray(ffmpeg("-i", clip, "-c", "copy", tmp_path / "whole.ivf").read_bytes())
    hurt = tmp_path / "hurt.ivf"
    damaged = slice(int(0.85 * len(data)), int(0.9 * len(data)))
    data[damaged] = np.random.default_rng(0).bytes(damaged.stop - damaged.start)
    hurt.write_bytes(data)
    few = MatchOptions(images=ImageOptions(num_images=4), verify=PAIRS)
    report = match(tmp_path / "a.db", hurt, image_path=tmp_path / "few", options=few)
    names = [image.name for image in read_images(tmp_path / "a.db")]
    assert 4 < report.num_frames < 16
    assert len(names) == len(list((tmp_path / "few").iterdir())) == 4
    assert names[-1] == f"frame_{report.num_frames - 1:06d}.png"
    assert report.num_inliers > 0
    assert len(report.warnings) == 1
    again = replace(few, on_existing="replace")
    repeated = match(tmp_path / "a.db", hurt, image_path=tmp_path / "few", options=again)
    assert (repeated.num_images, repeated.num_written_images) == (4, 0)


def test_database_is_written_although_the_mapper_crashes(
    clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def crash(*args: object, **options: object) -> None:
        raise ModelError("the mapper stopped")

    monkeypatch.setattr("colmap_av1.poses.mapper_trials.start_mapper", crash)
    report = match(tmp_path / "a.db", clip)
    assert any("trial" in warning for warning in report.warnings)
    assert len(read_images(tmp_path / "a.db")) == report.num_images


def test_mapper_is_not_tried_if_the_camera_only_turns(
    encode: Encode, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*args: object, **options: object) -> None:
        pytest.fail("the mapper was tried")

    monkeypatch.setattr("colmap_av1.poses.mapper_trials.start_mapper", fail)
    wall = np.random.default_rng(5).integers(0, 256, (60, 120, 3), dtype=np.uint8)
    wall = cv2.resize(wall, (480, 240))
    frames = np.stack([wall[:, 5 * i : 5 * i + 320] for i in range(16)])
    report = match(tmp_path / "a.db", encode(frames, tmp_path / "turning.mp4"))
    assert report.num_verified_pairs > 0
    assert any("not observable" in warning for warning in report.warnings)


def test_locked_database_is_reported_and_not_changed(clip: Path, tmp_path: Path) -> None:
    match(tmp_path / "a.db", clip)
    connection = sqlite3.connect(tmp_path / "a.db", isolation_level=None)
    connection.execute("DELETE FROM keypoints")
    connection.execute("DELETE FROM matches")
    connection.execute("DELETE FROM two_view_geometries")
    before = (tmp_path / "a.db").read_bytes()
    connection.execute("BEGIN IMMEDIATE")
    with pytest.raises(DatabaseError, match="in use"):
        match(tmp_path / "a.db", clip, image_path=tmp_path / "frames")
    connection.execute("ROLLBACK")
    connection.close()
    assert not (tmp_path / "frames").exists()
    assert (tmp_path / "a.db").read_bytes() == before
    match(tmp_path / "a.db", clip)
    with pytest.raises(DatabaseError, match="already has"):
        match(tmp_path / "a.db", clip)


def test_existing_matches_are_extended_or_replaced(clip: Path, tmp_path: Path) -> None:
    database = tmp_path / "a.db"
    match(database, clip)
    first = tables(database)
    before = database.read_bytes()
    with pytest.raises(DatabaseError, match="--on_existing"):
        match(database, clip)
    with pytest.raises(DatabaseError, match="already"):
        match(database, clip, options=MatchOptions(on_existing="append"))
    assert database.read_bytes() == before
    longer = TrackOptions(min_length=6)
    match(database, clip, options=MatchOptions(on_existing="append", tracks=longer))
    both = tables(database)
    for old, new in zip(first["keypoints"], both["keypoints"], strict=True):
        assert new[1] > old[1]
        assert new[3].startswith(old[3])
    match(database, clip, options=MatchOptions(on_existing="replace"))
    assert tables(database) == first


def test_image_of_another_size_is_refused(clip: Path, encode: Encode, tmp_path: Path) -> None:
    other = encode(make_frames(2, 96, 64), tmp_path / "other.mp4")
    write_images(other, tmp_path / "frames", ["frame_000000.png"], [0])
    with pytest.raises(ImageError, match="96x64"):
        match(tmp_path / "a.db", clip, image_path=tmp_path / "frames")
    assert not (tmp_path / "a.db").exists()
    assert len(list((tmp_path / "frames").iterdir())) == 1


def test_run_fails_if_other_images_are_written_meanwhile(
    clip: Path, encode: Encode, tmp_path: Path
) -> None:
    pairs = MatchOptions(verify=PAIRS)
    other = encode(make_frames(16)[:, ::-1, ::-1].copy(), tmp_path / "other.mp4")
    images = tmp_path / "images"

    def match_meanwhile(video: Path, stage: str) -> Callable[..., None]:
        """Progress that matches a video into the same folder once, when a stage begins."""
        waiting = [video]

        def progress(now: str, *_: object) -> None:
            if now == stage and waiting:
                match(tmp_path / "other.db", waiting.pop(), image_path=images, options=pairs)

        return progress

    with pytest.raises(ImageError, match="another"):
        match(
            tmp_path / "a.db",
            clip,
            image_path=images,
            options=pairs,
            progress=match_meanwhile(other, "motion"),
        )
    assert not (tmp_path / "a.db").exists()
    shutil.rmtree(images)
    (tmp_path / "other.db").unlink()
    # The images of the same video are the same, so the second run uses those of the first.
    report = match(
        tmp_path / "a.db",
        clip,
        image_path=images,
        options=pairs,
        progress=match_meanwhile(clip, "motion"),
    )
    assert (report.num_images, report.num_written_images) == (16, 0)


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux locks folders")
def test_image_folder_is_locked_while_a_run_writes_to_it(tmp_path: Path) -> None:
    code = """
import fcntl, os, sys
fcntl.flock(os.open(sys.argv[1], os.O_RDONLY), fcntl.LOCK_EX | fcntl.LOCK_NB)
"""
    words = [sys.executable, "-c", code, str(tmp_path / "images")]
    with alone_in(tmp_path / "images"):
        held = subprocess.run(words, capture_output=True, text=True, check=False)
    assert "BlockingIOError" in held.stderr
    subprocess.run(words, check=True)


def test_images_of_a_video_with_two_sizes_are_refused(encode: Encode, tmp_path: Path) -> None:
    """Matching without decoding works."""
    both = encode_two_sizes(encode, tmp_path / "both.obu", 8)
    with pytest.raises(ImageError, match="128x128"):
        match(tmp_path / "a.db", both, image_path=tmp_path / "frames")
    assert not (tmp_path / "frames").exists()
    assert not (tmp_path / "a.db").exists()
    assert match(tmp_path / "a.db", both).num_images == 16
    with pytest.raises(ImageError, match="128x128"):
        match(tmp_path / "b.db", both, options=LK)


def test_refined_tracks_can_be_limited_per_image(clip: Path, tmp_path: Path) -> None:
    plain = match(tmp_path / "a.db", clip)
    options = replace(LK, density=DensityOptions(max_tracks_per_image=100))
    report = match(tmp_path / "b.db", clip, options=options)
    assert {"decoding", "refinement"} < set(report.seconds)
    counts = [row[1] for row in tables(tmp_path / "b.db")["keypoints"]]
    assert max(counts) == 100
    assert report.num_tracks < plain.num_tracks / 2
    assert report.num_inliers / report.num_matches > 0.97


def test_min_images_counts_images_and_not_frames(clip: Path, tmp_path: Path) -> None:
    density = DensityOptions(preset="dense", min_images=3)
    options = replace(ALL, density=density, images=ImageOptions(every=4))
    match(tmp_path / "a.db", clip, options=options)
    keypoints = [row[1] for row in tables(tmp_path / "a.db")["keypoints"]]
    match(tmp_path / "b.db", clip, options=replace(ALL, images=ImageOptions(every=4)))
    all_keypoints = [row[1] for row in tables(tmp_path / "b.db")["keypoints"]]
    assert sum(keypoints) < sum(all_keypoints)


def test_existing_images_that_do_not_fit_the_video_are_refused(clip: Path, tmp_path: Path) -> None:
    write_images(clip, tmp_path / "images", [f"{i:03d}.png" for i in range(10)], range(10))
    database = database_of_images(tmp_path / "images", tmp_path / "a.db")
    before = database.read_bytes()
    with pytest.raises(ImageError, match="10 images"):
        match(database, clip)
    assert database.read_bytes() == before
    options = MatchOptions(images=ImageOptions(first_number=0))
    assert match(database, clip, options=options).num_images == 10


def truncate(video: Path) -> None:
    video.write_bytes(video.read_bytes()[: video.stat().st_size // 2])


@pytest.mark.parametrize(
    ("when", "change"),
    [("motion", truncate), ("verification", Path.unlink), ("images", Path.touch)],
)
def test_video_that_changes_meanwhile_leaves_no_files(
    clip: Path, tmp_path: Path, when: str, change: Callable[[Path], None]
) -> None:
    video = tmp_path / "v.mp4"
    shutil.copyfile(clip, video)

    def progress(stage: str, done: int, total: int | None) -> None:
        if stage == when and done == 3 and video.exists():
            change(video)

    with pytest.raises(VideoError, match="changed"):
        match(tmp_path / "a.db", video, image_path=tmp_path / "frames", progress=progress)
    video.unlink(missing_ok=True)
    assert [path for path in tmp_path.rglob("*") if not path.is_dir()] == []


def test_interrupt_leaves_the_database_unchanged(clip: Path, tmp_path: Path) -> None:
    write_images(clip, tmp_path / "images", [f"{i:03d}.png" for i in range(16)], range(16))
    database = database_of_images(tmp_path / "images", tmp_path / "a.db")
    before = database.read_bytes()
    for stage in ("motion", "verification"):

        def interrupt(now: str, done: int, total: int | None, stage: str = stage) -> None:
            if now == stage and done > 2:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            match(database, clip, progress=interrupt)
        assert database.read_bytes() == before


def test_given_camera_is_written_once_or_per_image(clip: Path, tmp_path: Path) -> None:
    camera = CameraOptions(camera_model="PINHOLE", camera_params="200,200,96,64")
    match(tmp_path / "a.db", clip, options=MatchOptions(camera=camera))
    (row,) = tables(tmp_path / "a.db")["cameras"]
    assert np.frombuffer(row[4]).tolist() == [200, 200, 96, 64]
    assert row[5] == 1
    per_image = replace(camera, single_camera=False)
    match(tmp_path / "b.db", clip, options=MatchOptions(camera=per_image))
    assert len(tables(tmp_path / "b.db")["cameras"]) == 16


def test_hidden_frames_are_matched_in_display_order(encode: Encode, tmp_path: Path) -> None:
    """In a pyramid, some frames are coded early, hidden, and shown later."""
    how = ["-c:v", "libaom-av1", "-cpu-used", "8", "-lag-in-frames", "19", "-crf", "20"]
    pyramid = encode(make_frames(20), tmp_path / "pyramid.mp4", *how)
    report = match(tmp_path / "a.db", pyramid, image_path=tmp_path / "frames")
    assert report.num_frames == report.num_images == 20
    assert report.num_coded_frames >= 20
    assert report.num_inliers > 1000


@pytest.mark.shared
def test_focal_length_that_a_short_clip_does_not_determine_is_kept(
    shared: Path, ffmpeg: Ffmpeg, tmp_path: Path
) -> None:
    """If the mapper refined the focal length, it would diverge after two to five images.

    Unless it counts as known, COLMAP 4.2 replaces it.
    """
    clip = shared / "sequences" / "log_building" / "clip.mp4"
    short = ffmpeg("-i", clip, "-frames:v", "7", "-c:v", "copy", tmp_path / "short.mp4")
    report = match(tmp_path / "a.db", short, image_path=tmp_path / "frames")
    assert report.fixed_intrinsics
    (camera,) = read_cameras(tmp_path / "a.db").values()
    assert report.estimate is not None
    assert report.estimate.focal_lengths == (camera.mean_focal_length(),) * 2
    (row,) = tables(tmp_path / "a.db")["cameras"]
    assert row[5] == 1
    assert "--Mapper.ba_refine_focal_length 0" in report.next_commands[0]
    assert "--refine_intrinsics 0" in report.next_commands[1]
    options = replace(report.map_options, num_threads=1)
    mapped = map_database(
        tmp_path / "a.db", tmp_path / "frames", tmp_path / "models", options=options
    )
    assert mapped.num_registered == (7,)


@pytest.mark.shared
def test_mapper_refines_a_default_focal_length_if_it_begins_well_so(
    street: Street, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("colmap_av1.poses.joint_cameras.FOCAL_LENGTH_ERROR", 0.0)
    report = match(tmp_path / "a.db", street(20), image_path=tmp_path / "frames")
    assert report.focal_length is None
    assert not report.fixed_intrinsics
    (row,) = tables(tmp_path / "a.db")["cameras"]
    assert row[5] == 0
    options = replace(report.map_options, num_threads=1)
    mapped = map_database(
        tmp_path / "a.db", tmp_path / "frames", tmp_path / "models", options=options
    )
    assert mapped.num_registered[0] == 20
    assert mapped.figures.focal_lengths == pytest.approx((707, 707), rel=0.15)


@pytest.mark.shared
def test_mapper_begins_well_where_two_images_hardly_determine_the_intrinsics(
    shared: Path, ffmpeg: Ffmpeg, tmp_path: Path
) -> None:
    """The command keeps the intrinsics. A mapper with default options refines them."""
    clip = shared / "sequences" / "holiday_display" / "clip.mp4"
    small = ffmpeg("-i", clip, "-vf", "scale=224:400", "-crf", "20", tmp_path / "small.mp4")
    report = match(tmp_path / "a.db", small, image_path=tmp_path / "frames")
    assert report.fixed_intrinsics
    assert report.focal_length is not None
    printed = replace(report.map_options, num_threads=1)
    default = MapOptions(forward_motion=False, num_threads=1)
    for name, used in (("printed", printed), ("default", default)):
        mapped = map_database(tmp_path / "a.db", tmp_path / "frames", tmp_path / name, options=used)
        assert mapped.num_registered == (report.num_images,)


@pytest.mark.shared
def test_links_carry_the_scale_across_a_jerk(shared: Path, tmp_path: Path) -> None:
    """Motion tracks cross the jerk, but hardly any of them have depth on both sides."""
    clip = shared / "sequences" / "log_building" / "clip.mp4"
    options = MatchOptions(images=ImageOptions(num_images=50))
    report = match(tmp_path / "a.db", clip, image_path=tmp_path / "frames", options=options)
    assert report.estimate is not None
    assert report.estimate.num_registered == (50,)
    assert report.links.num_links > 0
    assert [gap.reasons for gap in report.links.gaps] == [("doubtful motion",)]


@pytest.mark.shared
def test_drive_with_unknown_intrinsics_is_mapped(street: Street, tmp_path: Path) -> None:
    report = match(tmp_path / "a.db", street(20), image_path=tmp_path / "frames")
    assert report.estimate is not None
    assert report.focal_length == pytest.approx(707, rel=0.15)
    options = replace(report.map_options, num_threads=1)
    mapped = map_database(
        tmp_path / "a.db", tmp_path / "frames", tmp_path / "models", options=options
    )
    assert mapped.num_registered == (20,)


@pytest.mark.shared
def test_forward_motion_is_detected(street: Street, clip: Path, tmp_path: Path) -> None:
    """Commands for a drive have the mapper's options for it, those for sideways motion do not."""
    drive = street(12)
    report = match(tmp_path / "a.db", drive, options=MatchOptions(camera=STREET))
    assert report.forward_motion
    assert "--Mapper.init_max_forward_motion 1" in report.next_commands[0]
    assert "--Mapper.init_min_tri_angle 4" in report.next_commands[0]
    assert "--Mapper.ba_refine_focal_length 0" in report.next_commands[0]
    assert "--forward_motion" in report.next_commands[1]
    report = match(tmp_path / "c.db", drive)
    assert report.forward_motion
    assert "--Mapper.ba_refine_focal_length" not in report.next_commands[0]

    sideways = CameraOptions("PINHOLE", "200,200,96,64")
    report = match(tmp_path / "b.db", clip, options=MatchOptions(camera=sideways))
    assert not report.forward_motion
    assert "--Mapper" not in report.next_commands[0]
    assert "--forward_motion" not in report.next_commands[1]
    report = replace(report, small_angles=True)
    assert report.map_options.init_min_tri_angle == 4.0
    with_colmap, ours, _ = report.next_commands
    assert "--Mapper.init_min_tri_angle 4" in with_colmap
    assert "--init_min_tri_angle 4" in ours


def test_printed_command_densifies_the_same_frames_and_masks(
    clip: Path, encode: Encode, tmp_path: Path
) -> None:
    write_image(tmp_path / "mask.png", np.full((128, 192, 3), 255, np.uint8))
    options = MatchOptions(
        masks=MaskOptions(tmp_path / "mask.png"), keep_stream=tmp_path / "kept.mp4"
    )
    h264 = encode(make_frames(16), tmp_path / "h264.mp4", "-c:v", "libx264")
    of_names = match(tmp_path / "a.db", h264, options=options).next_commands[2]
    of_av1 = match(tmp_path / "c.db", clip, options=options).next_commands[2]
    of_images = match(tmp_path / "b.db", clip, image_path=tmp_path / "images").next_commands[2]
    assert "--first_number 0" in of_names
    assert f"--mask_path {tmp_path / 'mask.png'}" in of_names
    assert f"--keep_stream {tmp_path / 'kept.mp4'}" in of_names
    assert "--keep_stream" not in of_av1  # it is not converted
    assert "--first_number" not in of_images

"""Several videos and photos in one database or one model."""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from conftest import PROJECT, Encode, make_frames
from hypothesis import given
from hypothesis import strategies as st
from image_sets import tracks_from
from numpy.typing import NDArray
from trainers import brush

from colmap_av1.check.database import check_database
from colmap_av1.cli import main
from colmap_av1.database.reading import read_cameras, read_images
from colmap_av1.densify import densify
from colmap_av1.errors import (
    ColmapAv1Error,
    DatabaseError,
    ImageError,
    ModelError,
    OptionError,
    VideoError,
)
from colmap_av1.geometry.colmap_model import write_model
from colmap_av1.geometry.model_points import ModelPoints
from colmap_av1.geometry.posed_model import read_posed_model
from colmap_av1.images.choosing import ChosenImages
from colmap_av1.images.image_set import number_images
from colmap_av1.images.inputs import labels_of, read_inputs
from colmap_av1.map import map_database
from colmap_av1.match import match
from colmap_av1.options import (
    CameraOptions,
    ImageOptions,
    LinkOptions,
    MatchOptions,
    PlaceOptions,
    ReconstructOptions,
)
from colmap_av1.poses.mapper import map_poses
from colmap_av1.reconstruct import reconstruct
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.video.decoding import decode_frames

SCENE = PROJECT / "examples" / "scene.mp4"
SIZE = (384, 216)
X264 = ("-c:v", "libx264", "-crf", "14", "-g", "250")
# Frames of the scene in the first video, in the second one, and in the photos.
FIRST, SECOND, AS_PHOTOS = range(16), range(16, 32), (14, 17, 20)
# Fewer features than by default suffice for these small pictures.
QUICK = MatchOptions(images=ImageOptions(every=2), links=LinkOptions(max_link_features=400))
NUM_IMAGES = 8  # in each half


@pytest.fixture(scope="module")
def pictures() -> NDArray[np.uint8]:
    shown = [image for _, image in decode_frames(SCENE)]
    return np.array([cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA) for image in shown])


@pytest.fixture(scope="module")
def halves(
    pictures: NDArray[np.uint8], encode: Encode, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Path]:
    """A clip in two halves."""
    folder = tmp_path_factory.mktemp("halves")
    first = encode(pictures[FIRST.start : FIRST.stop], folder / "walk in.mp4")
    return first, encode(pictures[SECOND.start : SECOND.stop], folder / "back.mp4")


@pytest.fixture(scope="module")
def photos(pictures: NDArray[np.uint8], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Some frames of the clip as photos of another size."""
    folder = tmp_path_factory.mktemp("album") / "photos"
    (folder / "more").mkdir(parents=True)
    for number, frame in enumerate(AS_PHOTOS):
        name = f"more/IMG.{number}.jpg" if number else "IMG.0.JPG"
        cv2.imwrite(str(folder / name), cv2.resize(pictures[frame], (480, 270)))
    (folder / "notes.txt").write_text("not a picture")
    return folder


def test_match_writes_videos_and_photos_to_one_database(
    halves: tuple[Path, Path],
    photos: Path,
    pictures: NDArray[np.uint8],
    encode: Encode,
    tmp_path: Path,
) -> None:
    """One of the videos is H.264 instead of AV1."""
    images = tmp_path / "images"
    phone = encode(pictures[SECOND.start : SECOND.stop], tmp_path / "back.mp4", *X264)
    videos = (halves[0], phone)
    report = match(tmp_path / "a.db", videos, photos=photos, image_path=images, options=QUICK)
    assert report.videos == videos
    assert report.streams == (halves[0], None)
    assert report.num_images == 2 * NUM_IMAGES + len(AS_PHOTOS)
    assert report.links.num_between > 20
    assert report.links.parts == report.links.unlinked_photos == ()
    assert report.warnings == ()
    listed = read_images(tmp_path / "a.db")
    photo_names = ["IMG.0.JPG", "more/IMG.1.jpg", "more/IMG.2.jpg"]
    assert [image.name for image in listed] == [
        *(f"walk_in/frame_{2 * i:06d}.png" for i in range(NUM_IMAGES)),
        *(f"back/frame_{2 * i:06d}.png" for i in range(NUM_IMAGES)),
        *(f"photos/{name}" for name in photo_names),
    ]
    assert all((images / image.name).is_file() for image in listed)
    for name in photo_names:
        assert (images / "photos" / name).read_bytes() == (photos / name).read_bytes()
    by_camera = {i.camera_id: (i.width, i.height) for i in listed}
    assert list(by_camera.values()) == [SIZE, SIZE, (480, 270)]
    assert [image.camera_id for image in listed[::NUM_IMAGES]] == [1, 2, 3]
    assert check_database(tmp_path / "a.db").num_connected_images == report.num_images


def test_videos_share_a_camera_if_requested(
    halves: tuple[Path, Path], pictures: NDArray[np.uint8], encode: Encode, tmp_path: Path
) -> None:
    one = MatchOptions(camera=CameraOptions(single_camera=True))
    few = replace(one, images=ImageOptions(every=3), links=LinkOptions(links="none"))
    match(tmp_path / "a.db", halves, options=few)
    assert len(read_cameras(tmp_path / "a.db")) == 1
    # A second run replaces the matches, and keeps the images with their camera.
    listed = read_images(tmp_path / "a.db")
    again = replace(few, camera=CameraOptions(), on_existing="replace")
    match(tmp_path / "a.db", halves, options=again)
    assert read_images(tmp_path / "a.db") == listed
    small = encode(pictures[:9, :128], tmp_path / "small.mp4")
    with pytest.raises(OptionError, match="single_camera"):
        match(tmp_path / "b.db", [halves[0], small], options=one)
    given = MatchOptions(camera=CameraOptions("PINHOLE", "300,300,192,108"))
    with pytest.raises(OptionError, match="camera_params"):
        match(tmp_path / "b.db", [halves[0], small], options=given)
    assert not (tmp_path / "b.db").exists()


def test_videos_of_different_scenes_are_reported(
    halves: tuple[Path, Path], clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["match", "--database", str(tmp_path / "a.db"), "--quiet"]
    words += ["--every", "2", "--max_link_features", "400"]
    assert main([*words, "--video", str(halves[0]), "--video", str(clip)]) == 0
    err = capsys.readouterr().err
    assert "'walk_in'" in err
    assert "'clip'" in err
    report = match(
        tmp_path / "b.db",
        [halves[0], clip],
        options=replace(QUICK, links=LinkOptions(links="none")),
    )
    assert report.links.num_images == 0
    assert any("links none" in warning for warning in report.warnings)


def test_photo_of_another_scene_is_reported(
    halves: tuple[Path, Path], photos: Path, tmp_path: Path
) -> None:
    album = tmp_path / "album"
    shutil.copytree(photos, album)
    cv2.imwrite(str(album / "cat.png"), make_frames(1)[0])
    report = match(tmp_path / "a.db", halves[0], photos=album, options=QUICK)
    assert report.links.unlinked_photos == ("album/cat.png",)
    assert any("'album/cat.png'" in warning for warning in report.warnings)
    # The images of a single video have no folder in their names.
    assert read_images(tmp_path / "a.db")[0].name == "frame_000000.png"


def test_photo_of_another_scene_does_not_change_the_options_of_the_mapper(
    halves: tuple[Path, Path], tmp_path: Path
) -> None:
    """They depend on the poses of the other images."""
    options = replace(QUICK, images=ImageOptions(every=1))
    album = tmp_path / "album"
    album.mkdir()
    cv2.imwrite(str(album / "cat.png"), make_frames(1)[0])
    alone, together = (
        match(f"{path}.db", halves[0], photos=photos, image_path=path, options=options)
        for path, photos in ((tmp_path / "alone", None), (tmp_path / "together", album))
    )
    assert together.estimate is not None
    assert together.estimate.num_registered == (16,)
    assert alone.small_angles
    assert together.small_angles


def test_same_video_twice_is_an_error(halves: tuple[Path, Path], tmp_path: Path) -> None:
    copy = tmp_path / "copy.mp4"
    shutil.copyfile(halves[0], copy)
    for other in (halves[0], copy, os.path.relpath(halves[0])):
        with pytest.raises(VideoError, match="same video"):
            match(tmp_path / "a.db", [halves[0], halves[1], other])
    assert not (tmp_path / "a.db").exists()


def test_two_encodings_of_a_video_are_reported(
    halves: tuple[Path, Path], pictures: NDArray[np.uint8], encode: Encode, tmp_path: Path
) -> None:
    """They differ in the picture size and in the number of frames."""
    smaller = [cv2.resize(image, (288, 162)) for image in pictures[2 : FIRST.stop]]
    again = encode(np.array(smaller), tmp_path / "again.mp4")
    report = match(tmp_path / "a.db", [halves[0], again], options=QUICK)
    assert report.links.same_videos == (("walk_in", "again"),)
    assert any("'walk_in' and 'again'" in w for w in report.warnings)


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("missing", "no such folder"),
        ("file", "folder"),
        ("empty", "no photo"),
        ("heic", r"IMG_1\.HEIC"),
        ("damaged", r"bad\.jpg"),
        ("cut short", r"bad\.jpg"),
    ],
)
def test_unusable_photos_are_errors(
    kind: str, message: str, halves: tuple[Path, Path], photos: Path, tmp_path: Path
) -> None:
    album = tmp_path / "album"
    if kind == "file":
        album.write_text("")
    elif kind != "missing":
        album.mkdir()
    if kind == "heic":
        (album / "IMG_1.HEIC").write_bytes(b"whatever")
    if kind in ("damaged", "cut short"):
        data = (photos / "IMG.0.JPG").read_bytes()
        (album / "bad.jpg").write_bytes(data[: len(data) // 2] if kind == "cut short" else b"bad")
    with pytest.raises(ImageError, match=message):
        match(tmp_path / "a.db", halves[0], photos=album)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["album"] * album.exists()


def test_another_file_with_the_name_of_a_photo_is_kept(
    halves: tuple[Path, Path], photos: Path, tmp_path: Path
) -> None:
    mine = tmp_path / "images" / "photos" / "IMG.0.JPG"
    mine.parent.mkdir(parents=True)
    mine.write_bytes(b"mine")
    with pytest.raises(ImageError, match="another file"):
        match(tmp_path / "a.db", halves[0], photos=photos, image_path=tmp_path / "images")
    assert mine.read_bytes() == b"mine"


def test_outputs_among_the_photos_are_refused(
    halves: tuple[Path, Path], photos: Path, tmp_path: Path
) -> None:
    album = Path(shutil.copytree(photos, tmp_path / "album"))
    with pytest.raises(OptionError, match="album"):
        match(tmp_path / "a.db", halves[0], photos=album, image_path=album / "images")
    with pytest.raises(OptionError, match="album"):
        reconstruct(halves[0], album / "out", photos=album)
    assert not (tmp_path / "a.db").exists()
    assert not (album / "out").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (MatchOptions(images=ImageOptions(frame_list="list.txt")), "frame_list"),
        (MatchOptions(keep_stream="kept.mp4"), "keep_stream"),
        (MatchOptions(links=LinkOptions(links="none")), "links"),
    ],
)
def test_options_that_do_not_suit_videos_and_photos_are_errors(
    options: MatchOptions, message: str, halves: tuple[Path, Path], photos: Path, tmp_path: Path
) -> None:
    with pytest.raises(OptionError, match=message):
        match(tmp_path / "a.db", halves, photos=photos, options=options)


def test_database_of_other_images_is_an_error(halves: tuple[Path, Path], tmp_path: Path) -> None:
    match(tmp_path / "a.db", halves[0], options=QUICK)
    again = replace(QUICK, on_existing="append")
    with pytest.raises(DatabaseError, match="walk_in, back"):
        match(tmp_path / "a.db", halves, options=again)


def test_database_of_photos_only_is_an_error(
    halves: tuple[Path, Path], photos: Path, tmp_path: Path
) -> None:
    database = tmp_path / "a.db"
    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=480, height=270, params=[400, 240, 135])
    with pycolmap.Database.open(database) as made:
        camera_id = made.write_camera(camera)
        for photo in read_inputs(halves[0], photos, QUICK).photos:
            made.write_image(pycolmap.Image(name=photo.name, camera_id=camera_id))
    before = database.read_bytes()
    for videos in (halves[0], halves):
        with pytest.raises(DatabaseError, match="none of a video"):
            match(database, videos, photos=photos, options=QUICK)
    assert database.read_bytes() == before


@pytest.mark.parametrize(
    ("places", "labels"),
    [
        (["/x/a", "/x/b"], ["a", "b"]),
        (["/cam 0/video", "/cam 1/video"], ["cam_0_video", "cam_1_video"]),
        (["/x/a.b/c", "/y/a.b/C"], ["x_a_b_c", "y_a_b_C"]),
        (["/x/a", "/x"], ["a", "x"]),
    ],
)
def test_labels_of_videos_differ(places: list[str], labels: list[str]) -> None:
    assert labels_of(places) == labels


def test_names_that_differ_only_in_special_characters_are_an_error() -> None:
    with pytest.raises(OptionError, match="rename"):
        labels_of(["/x/a b", "/x/a-b", "/x/a+b"])


def test_names_that_are_too_long_for_outputs_are_an_error(clip: Path, tmp_path: Path) -> None:
    videos = [shutil.copyfile(clip, tmp_path / f"{'x' * 212}{i}.mp4") for i in range(2)]
    with videos[1].open("ab") as file:
        file.write(b"\0\0\0\x08free")
    assert read_inputs(videos[0], None, MatchOptions()).labels == ("",)
    with pytest.raises(OptionError, match="too long"):
        read_inputs(videos, None, MatchOptions())


@given(st.lists(st.text(min_size=1, max_size=4), min_size=1, max_size=4))
def test_labels_differ_and_have_no_dots_slashes_or_spaces(names: list[str]) -> None:
    try:
        labels = labels_of([f"/x/{name.replace('/', '_')}" for name in names])
    except ColmapAv1Error:
        return
    assert len({label.lower() for label in labels}) == len(names)
    assert not any(set(label) & set("./ ") for label in labels)


def test_frames_of_several_videos_are_numbered_consecutively() -> None:
    one = replace(tracks_from([[0, 1, 2, 3, 4], [3, 4]], 5), width=64, height=48)
    two = replace(tracks_from([[0, 1, 2], [1, 2]], 3), width=32, height=80)
    both = Tracks.in_sequence([one, two], 9)
    assert (both.num_frames, both.width, both.height) == (9, 64, 80)
    assert both.offsets.tolist() == [0, 5, 7, 10, 12]
    assert both.frame.tolist() == [0, 1, 2, 3, 4, 3, 4, 5, 6, 7, 6, 7]
    assert Tracks.in_sequence([one], 5) is one
    chosen = [ChosenImages(["0.png", "4.png"], np.array([0, 4], np.int32))]
    chosen.append(ChosenImages(["2.png"], np.array([2], np.int32)))
    image_set = number_images(["a", "b"], chosen, [5, 3], ["photos/x.jpg"])
    assert image_set.images.names == ["a/0.png", "a/4.png", "b/2.png", "photos/x.jpg"]
    assert image_set.images.frames.tolist() == [0, 4, 7, 8]
    assert image_set.sequence.tolist() == [0, 0, 1, 2]
    assert image_set.of_video(1).names == ["b/2.png"]
    assert image_set.of_video(1).frames.tolist() == [2]
    assert (image_set.num_sequences, image_set.num_frames) == (3, 9)


def test_reconstruct_joins_videos_and_photos_in_one_model(
    halves: tuple[Path, Path], photos: Path, tmp_path: Path
) -> None:
    options = ReconstructOptions(match=QUICK)
    made = reconstruct(halves, tmp_path / "out", photos=photos, options=options)
    assert made.num_registered == made.num_images == 2 * NUM_IMAGES + len(AS_PHOTOS)
    assert made.registered == {"walk_in": NUM_IMAGES, "back": NUM_IMAGES}
    model = pycolmap.Reconstruction(str(made.output / "sparse" / "0"))
    sizes = {(int(c.width), int(c.height)) for c in model.cameras.values()}
    assert (len(model.cameras), sizes) == (3, {SIZE, (480, 270)})
    for image in model.images.values():
        picture = cv2.imread(str(made.output / "images" / image.name))
        camera = model.cameras[image.camera_id]
        assert picture.shape[1::-1] == (camera.width, camera.height)
        assert image.name.count(".") == 1
    observed_by = {
        frozenset(model.images[e.image_id].name.split("/")[0] for e in point.track.elements)
        for point in model.points3D.values()
    }
    assert {
        frozenset({"walk_in"}),
        frozenset({"back"}),
        frozenset({"walk_in", "back"}),
    } <= observed_by

    adjusted = read_posed_model(made.output / ".stages" / "adjusted.npz")
    posed = tmp_path / "posed"
    posed.mkdir()
    write_model(posed, adjusted.cameras, adjusted.images, ModelPoints.empty())
    dense = densify(posed, halves, tmp_path / "dense", photos=photos)
    assert dense.num_images == made.num_images
    assert dense.agreement > 0.9
    with pytest.raises(ModelError, match="photos/"):
        densify(posed, halves, tmp_path / "none")

    resumed = reconstruct(halves, tmp_path / "out", photos=photos, options=options)
    assert {"tracks_walk_in", "tracks_back", "matches", "poses", "model"} <= set(resumed.resumed)


def test_densify_leaves_out_videos_that_a_model_lacks(
    halves: tuple[Path, Path], tmp_path: Path
) -> None:
    images = tmp_path / "images"
    apart = MatchOptions(links=LinkOptions(links="none"))
    match(tmp_path / "a.db", halves, image_path=images, options=apart)
    mapped = map_database(tmp_path / "a.db", images, tmp_path / "models")
    assert sorted(mapped.num_registered) == sorted([len(FIRST), len(SECOND)])
    for number, size in enumerate(mapped.num_registered):
        model, output = mapped.output / str(number), tmp_path / f"dense_{number}"
        report = densify(model, halves, output, image_path=images)
        assert report.num_images == size
        assert any("no image" in warning for warning in report.warnings)


def test_unconnected_videos_become_models_in_separate_folders(
    halves: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The distance is known in the first model only.
    distance = PlaceOptions(scale="2=back/frame_000000.jpg,back/frame_000010.jpg")
    match_options = MatchOptions(links=LinkOptions(links="none"))
    apart = ReconstructOptions(match=match_options, place=distance)
    made = reconstruct(halves, tmp_path / "out", options=apart)
    assert made.place.units == "metres"
    (further,) = made.other_models
    assert (made.num_registered, further.num_registered) == (len(FIRST), len(SECOND))
    assert sorted(made.registered.values()) == [0, len(FIRST)]
    assert further.output == tmp_path / "out" / "model_1"
    assert any("'model_1'" in warning for warning in made.warnings)
    registered = set()
    for folder in (made.output, further.output):
        model = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
        names = {image.name for image in model.images.values()}
        assert all((folder / "images" / name).is_file() for name in names)
        registered |= names
    assert len(registered) == made.num_images
    assert model.num_points3D() == further.num_points > 500
    # The models have the same number of images, so a trainer may read either of them. It must find
    # the pictures of the model that it reads.
    taken = brush(made.output)
    folder = taken.model.parents[1]
    assert set(taken.pictures.values()) == {*(folder / "images").rglob("*.jpg")}
    assert brush(further.output).model == further.output / "sparse" / "0"

    again = reconstruct(halves, tmp_path / "out", options=apart)
    assert "model" in again.resumed
    assert again.other_models == made.other_models

    # If the mapper makes another model of images that are already registered, it is discarded.
    def map_twice(database: Path, output: Path, *rest: Any, **how: Any) -> tuple[int, ...]:
        (size,) = map_poses(database, output, *rest, **how)
        shutil.copytree(output / "0", output / "1")
        return size, size

    monkeypatch.setattr("colmap_av1.poses.mapping_stage.map_poses", map_twice)
    alone = reconstruct(halves[0], tmp_path / "out", options=ReconstructOptions(match=QUICK))
    assert alone.other_models == ()
    assert alone.warnings == ()
    assert not further.output.exists()

"""Seams: how many points join neighbouring images of a model."""

from __future__ import annotations

import re
import shutil
import sqlite3
from collections.abc import Collection, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap
import pytest

from colmap_av1.check.crossings import model_crossings
from colmap_av1.cli import main
from colmap_av1.errors import DatabaseError
from colmap_av1.geometry.cameras import make_camera
from colmap_av1.geometry.colmap_model import ModelImage, read_model, write_model
from colmap_av1.geometry.model_points import ModelPoints
from colmap_av1.geometry.posed_model import posed_model
from colmap_av1.options import CameraOptions
from colmap_av1.poses.seams import Seams, model_seams
from colmap_av1.reconstruct import ReconstructReport

_FAILED_CHECK = 1
_LEFT = 5
_SOUND = 0.95


def seams_of(
    model: pycolmap.Reconstruction, photos: Collection[str] = (), all_images: Sequence[str] = ()
) -> Seams:
    own = posed_model(model, with_points=True)
    return model_seams(own, all_images or sorted(image.name for image in own.images), photos)


def test_consistent_model_has_no_weak_seam(made: ReconstructReport) -> None:
    seams = seams_of(read_model(made.output / "sparse" / "0"))
    assert len(seams.pairs) == made.num_registered - 1
    assert seams.disconnected == []
    assert seams.warning is None


def test_seam_with_few_points_is_reported(
    made: ReconstructReport, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = read_model(made.output / "sparse" / "0")
    by_name = sorted(model.images.values(), key=lambda image: image.name)
    middle = len(by_name) // 2
    before = {image.image_id for image in by_name[:middle]}
    joining = []
    for point_id, point in sorted(model.points3D.items()):
        own = [element.image_id in before for element in point.track.elements]
        if any(own) and not all(own):
            joining.append((len({e.image_id for e in point.track.elements}) > 2, point_id))
    for _, point_id in sorted(joining)[:-_LEFT]:
        model.delete_point3D(point_id)

    seams = seams_of(model)
    first, second = by_name[middle - 1].name, by_name[middle].name
    assert [seams.pairs[i] for i in seams.disconnected] == [(first, second)]
    assert seams.num_points[seams.disconnected].tolist() == [_LEFT]

    model.write(tmp_path)
    words = ["--model", str(tmp_path), "--image_path", str(made.output / "images")]
    assert main(["check", "--strict", *words]) == _FAILED_CHECK
    error = capsys.readouterr().err
    assert f"{_LEFT} points" in error
    assert first in error


def test_loop_closures_do_not_count_at_seams_inside_the_loop(tmp_path: Path) -> None:
    """Thirty images in a row: 100 points join neighbours, 500 join the first and last images."""
    write_row(tmp_path, [[k, k + 1, k + 2] for k in range(28) for _ in range(100)], 500)
    found = seams_of(read_model(tmp_path)).num_points
    assert found.tolist() == [600, *[200] * 27, 600]


def test_stretch_without_points_of_the_parts_around_it_is_not_connected(tmp_path: Path) -> None:
    """Two parts see the same points; the images between them, beside lost ones, hardly any."""
    views = [[k, k + 1, k + 2] for k in range(28) for _ in range(100)]
    write_row(tmp_path, [*views, *[[3, 4, 20, 21]] * 500, *[[4, 10, 20]] * 3], 0)
    model = read_model(tmp_path)
    names = sorted(image.name for image in model.images.values())
    for image in list(model.images.values()):
        if names.index(image.name) in {*range(5, 10), *range(15, 20)}:
            model.deregister_frame(image.frame_id)
    assert seams_of(model).num_points[[4, 9]].tolist() == [503, 503]
    found = seams_of(model, all_images=names)
    assert found.num_points[[4, 9]].tolist() == [3, 3]
    assert found.few_points == [4, 9]


def test_cut_is_no_weak_seam_if_a_loop_closure_joins_its_sides(tmp_path: Path) -> None:
    views = [[k, k + 1, k + 2] for k in range(28) if k not in (13, 14) for _ in range(100)]
    write_row(tmp_path, views, 20)
    assert seams_of(read_model(tmp_path)).disconnected == [14]
    write_row(tmp_path, views, 150)
    assert seams_of(read_model(tmp_path)).disconnected == []


def test_names_need_not_be_in_the_order_of_time(tmp_path: Path) -> None:
    """A list of frames may give images any names."""
    views = [[k, k + 1, k + 2] for k in range(28) if k not in (13, 14) for _ in range(100)]
    write_row(tmp_path, views, 0)
    model = read_model(tmp_path)
    in_time = [f"{(7 * k) % 30}.png" for k in range(30)]
    for image in model.images.values():
        image.name = in_time[int(Path(image.name).stem)]
    seams = seams_of(model, all_images=in_time)
    assert [seams.pairs[i] for i in seams.disconnected] == [(in_time[14], in_time[15])]


def test_seams_are_found_with_a_camera_per_image(tmp_path: Path) -> None:
    views = [[k, k + 1, k + 2] for k in range(28) if k not in (13, 14) for _ in range(100)]
    write_row(tmp_path, views, 0, num_cameras=30)
    assert seams_of(read_model(tmp_path)).disconnected == [14]


def test_photos_are_no_neighbours_in_time(tmp_path: Path) -> None:
    views = [[k, k + 1, k + 2] for k in range(28) if k not in (13, 14) for _ in range(100)]
    write_row(tmp_path, views, 0)
    model = read_model(tmp_path)
    names = sorted(image.name for image in model.images.values())
    assert seams_of(model, names[15:]).disconnected == []
    assert len(seams_of(model, names[15:]).num_points) == 14


def test_images_held_together_by_those_of_another_folder_have_no_seams(tmp_path: Path) -> None:
    def seams_with(views: list[list[int]]) -> Seams:
        """Seams of a video of 20 images and of 10 photos."""
        write_row(tmp_path, views, 0)
        model = read_model(tmp_path)
        for image in model.images.values():
            folder = "film" if int(Path(image.name).stem) < 20 else "photos"
            image.name = f"{folder}/{image.name}"
        return seams_of(model)

    video = [[k, k + 1, k + 2] for k in range(18) for _ in range(100)]
    photos = [[k, k - 10, k - 9] for k in range(20, 30) for _ in range(30)]
    assert len(seams_with(video + photos).num_points) == 19
    assert seams_with(video + photos).disconnected == []
    # With points of their own, these images are a second video.
    second = [[k, k + 1, k + 2] for k in (20, 26)] * 500
    assert len(seams_with(video + photos + second).num_points) == 28
    # A break in the video is found although photos show another part of it.
    broken = [views for views in video if not views[0] <= 4 < views[2]]
    many = [[k, k - 1, k - 10] for k in range(25, 30) for _ in range(300)]
    assert 4 in seams_with(broken + many).disconnected


def test_models_without_points_have_empty_seams(tmp_path: Path) -> None:
    write_row(tmp_path, [[0, 1]], 0)  # points with two views do not count
    assert seams_of(read_model(tmp_path)).num_points.tolist() == [0] * 29
    # The points of the last folder have too few views.
    write_row(tmp_path, [[k, k + 1, k + 2] for k in range(20)] + [[28, 29]], 0)
    model = read_model(tmp_path)
    for image in model.images.values():
        folder = "a" if int(Path(image.name).stem) < 25 else "b"
        image.name = f"{folder}/{image.name}"
    assert len(seams_of(model).num_points) == 28


def write_row(folder: Path, views: list[list[int]], again: int, *, num_cameras: int = 1) -> None:
    """Write a model of thirty images in a row.

    Args:
        folder: gets the model.
        views: for each point, the images that see it.
        again: number of further points, seen by the first two and the last two images.
        num_cameras: 1 or 30.
    """
    cameras = {}
    for camera_id in range(1, num_cameras + 1):
        cameras[camera_id] = make_camera(CameraOptions(), 640, 480)
        cameras[camera_id].camera_id = camera_id
    poses = [np.column_stack([np.eye(3), [-0.1 * k, 0.0, 0.0]]) for k in range(30)]
    images = [
        ModelImage(k + 1, f"{k:03}.png", k % num_cameras + 1, pose) for k, pose in enumerate(poses)
    ]
    views = [*views, *[[0, 1, 28, 29]] * again]
    count = len(views)
    points = ModelPoints(
        xyz=np.tile([1.5, 0.0, 5.0], (count, 1)),
        rgb=np.zeros((count, 3), np.uint8),
        error=np.zeros(count),
        offsets=np.concatenate([[0], np.cumsum([len(own) for own in views])]),
        image=np.concatenate(views),
        xy=np.zeros((sum(map(len, views)), 2)),
    )
    write_model(folder, cameras, images, points)


def test_wrongly_joined_parts_are_reported(
    made: ReconstructReport, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """All images after the middle are rotated, as if a mapper chose the wrong of two poses."""
    model = read_model(made.output / "sparse" / "0")
    database = made.output / "database.db"
    sound = model_crossings(model, database)
    assert len(sound.pairs) == made.num_registered - 1
    assert sound.share.min() > _SOUND
    assert sound.warning is None

    by_name = sorted(model.images.values(), key=lambda image: image.name)
    middle = len(by_name) // 2
    turn = pycolmap.Rotation3d(np.array([0, 0, np.sin(0.1), np.cos(0.1)]))
    about = by_name[middle].cam_from_world()
    aside = about.inverse() * pycolmap.Rigid3d(turn, np.zeros(3)) * about
    for image in by_name[middle:]:
        image.frame.set_cam_from_world(image.camera_id, image.cam_from_world() * aside)
    bent = model_crossings(model, database)
    first, second = by_name[middle - 1].name, by_name[middle].name
    assert (first, second) in [bent.pairs[i] for i in bent.wrong]
    assert bent.warning is not None
    named = re.search("'([^']*)' and '([^']*)'", bent.warning)
    assert named is not None
    assert named[1] <= first < second <= named[2]

    model.write(tmp_path)
    words = ["--model", str(tmp_path), "--image_path", str(made.output / "images")]
    assert main(["check", "--strict", "--database", str(database), *words]) == _FAILED_CHECK
    assert "wrongly" in capsys.readouterr().err

    for camera in model.cameras.values():
        camera.focal_length_x = camera.focal_length_y = 3 * camera.focal_length_x
    unfit = model_crossings(model, database).warning
    assert unfit is not None
    assert "undistorted" in unfit


def test_matches_between_folders_cross_no_gap(made: ReconstructReport, tmp_path: Path) -> None:
    """Two videos that are joined wrongly; the seams of each are sound."""
    model = read_model(made.output / "sparse" / "0")
    database = shutil.copyfile(made.output / "database.db", tmp_path / "a.db")
    shift = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([5.0, 0.0, 0.0]))
    by_name = sorted(model.images.values(), key=lambda image: image.name)
    middle = len(by_name) // 2
    first_of_second = by_name[middle].name
    for image in by_name[middle:]:
        image.frame.set_cam_from_world(image.camera_id, image.cam_from_world() * shift)
    for image in by_name:
        image.name = f"{'a' if image.name < first_of_second else 'b'}/{image.name}"
    with pytest.raises(DatabaseError, match="no image"):
        model_crossings(model, database)
    with sqlite3.connect(database) as connection:
        folder = "CASE WHEN name < ? THEN 'a/' ELSE 'b/' END"
        connection.execute(f"UPDATE images SET name = {folder} || name", (first_of_second,))
    connection.close()
    found = model_crossings(model, database)
    assert len(found.pairs) == len(by_name) - 2
    assert found.wrong == []


def _walk_with_a_turn(
    folder: Path, degrees: float, aside: float = 0, rest: int = 0, *, back: bool = False
) -> list[str]:
    """Write the model of a camera that walks, turns on the spot and walks on.

    Args:
        folder: gets the model.
        degrees: angle of the turn.
        aside: distance moved during the turn.
        rest: number of images before the camera moves.
        back: whether the camera then turns back and walks on.

    Returns:
        The names of the images from the last before the turn to the first after it.
    """
    before, turning = 12, 20
    share = np.concatenate([np.zeros(rest + before), np.linspace(0, 1, turning), np.ones(before)])
    walked = np.concatenate([np.full(rest, -2), np.linspace(-2, 0, before)])
    turned = aside * np.linspace(0, 1, turning)
    along = np.concatenate([walked, turned, aside + np.linspace(0.2, 2, before)])
    if back:
        share = np.concatenate([share, np.linspace(1, 0, turning), np.zeros(before)])
        along = np.concatenate([along, np.full(turning, 2), np.linspace(2.2, 4, before)])
    rng = np.random.default_rng(0)
    direction = np.radians(rng.uniform(-60, 60 + degrees, 4000))
    far = rng.uniform(5, 12, 4000)
    xyz = np.column_stack(
        [far * np.sin(direction), rng.uniform(-2, 2, 4000), far * np.cos(direction)]
    )
    camera = make_camera(CameraOptions("SIMPLE_PINHOLE", "600,320,240"), 640, 480)
    images, seen, xy = [], [], []
    for k, (turn, x) in enumerate(zip(np.radians(degrees) * share, along, strict=True)):
        rotation = pycolmap.Rotation3d(
            np.array([0, np.sin(-turn / 2), 0, np.cos(turn / 2)])
        ).matrix()
        pose = np.column_stack([rotation, -rotation @ [x, 0, 0]])
        images.append(ModelImage(k + 1, f"frame_{k:06d}.png", 1, pose))
        local = xyz @ rotation.T + pose[:, 3]
        at = 600 * local[:, :2] / local[:, 2:] + [320, 240]
        seen.append((local[:, 2] > 0) & (at > 0).all(axis=1) & (at < [640, 480]).all(axis=1))
        xy.append(at)
    point, image = np.nonzero(np.array(seen).T)
    counts = np.count_nonzero(seen, axis=0)
    points = ModelPoints(
        *(xyz[counts > 0], np.zeros((np.count_nonzero(counts), 3), np.uint8)),
        error=np.zeros(np.count_nonzero(counts)),
        offsets=np.append(0, np.cumsum(counts[counts > 0])),
        image=image,
        xy=np.array(xy)[image, point],
    )
    write_model(folder, {1: camera}, images, points)
    return [image.name for image in images[rest + before - 1 : rest + before + turning + 1]]


@pytest.mark.parametrize(("degrees", "aside", "rest"), [(25, 0.0, 0), (80, 1.0, 0), (25, 0.0, 10)])
def test_turn_keeps_the_scale_if_points_are_seen_across_it(
    tmp_path: Path, degrees: float, aside: float, rest: int
) -> None:
    _walk_with_a_turn(tmp_path, degrees, aside, rest)
    seams = seams_of(read_model(tmp_path))
    assert seams.scale_lost == []
    assert seams.warning is None


def test_turn_wider_than_the_field_of_view_loses_the_scale(tmp_path: Path) -> None:
    turn = _walk_with_a_turn(tmp_path, degrees=80)
    seams = seams_of(read_model(tmp_path))
    assert seams.disconnected == []
    lost = {seams.pairs[i] for i in seams.scale_lost}
    assert len(lost) > len(turn) / 2
    assert lost <= set(pairwise(turn))
    assert seams.warning is not None
    assert "scale" in seams.warning


def test_scale_is_not_lost_where_another_video_begins(tmp_path: Path) -> None:
    """The first image of a video alone gives no point depth."""
    _walk_with_a_turn(tmp_path, degrees=80, aside=1)
    model = read_model(tmp_path)
    images = sorted(model.images.values(), key=lambda image: image.name)
    for k, image in enumerate(images[22:]):
        image.name = f"a/{k:02}.png"
    for k, image in enumerate(images[:22]):
        image.name = f"b/{k:02}.png"
    seams = seams_of(model)
    assert ("b/00.png", "b/01.png") in seams.pairs
    assert seams.scale_lost == []
    assert seams.warning is None


@pytest.mark.parametrize(
    ("usual", "fewest", "is_lost"), [(730, 44, False), (730, 20, True), (468, 26, True)]
)
def test_enough_points_carry_the_scale_even_if_others_have_more(
    usual: int, fewest: int, is_lost: bool
) -> None:
    """44 of 730 occurred in a correct model of a walk, 26 of 468 in a bent one."""
    scaled = np.full(20, usual)
    scaled[10] = fewest
    pairs = tuple((f"{k}.png", f"{k + 1}.png") for k in range(20))
    many = np.full(20, 2000)
    seams = Seams(pairs, num_points=many, num_elsewhere=many, num_scaled=scaled, num_deep=many)
    assert seams.scale_lost == ([10] if is_lost else [])


def test_loop_closure_carries_no_scale_across_a_turn_inside_the_loop(tmp_path: Path) -> None:
    turn = _walk_with_a_turn(tmp_path, degrees=80, back=True)
    seams = seams_of(read_model(tmp_path))
    lost = {seams.pairs[i] for i in seams.scale_lost} & set(pairwise(turn))
    assert len(lost) > len(turn) / 2

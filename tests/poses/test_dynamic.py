"""Detection of dynamic objects, in synthetic tracks and in a clip."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
import render_scene
from conftest import Encode
from dense_scene import SCENE, Truth
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from sequences import model_poses

from colmap_av1.evaluate.metrics.poses import pose_errors
from colmap_av1.geometry.colmap_model import ModelImage
from colmap_av1.geometry.masks import make_mask
from colmap_av1.geometry.model_points import ModelPoints
from colmap_av1.geometry.posed_camera import PosedCamera
from colmap_av1.geometry.posed_model import PosedModel
from colmap_av1.geometry.track_points import TriangulatedTracks
from colmap_av1.geometry.triangulation import Observations, TriangulatedPoints, Views, triangulate
from colmap_av1.images.choosing import ChosenImages
from colmap_av1.images.image_set import ImageSet, ShownVideo, number_images
from colmap_av1.images.masks import mask_tracks
from colmap_av1.options import (
    CameraOptions,
    DensityOptions,
    ImageOptions,
    MatchOptions,
    ReconstructOptions,
    TrackOptions,
    TriangulateOptions,
)
from colmap_av1.poses.dynamic.contradictions import Contradictions, TracksInCells, tracks_in_cells
from colmap_av1.poses.dynamic.following import expect_in_views, follow_occluded
from colmap_av1.poses.dynamic.regions import dynamic_cells, shares_above_usual, strong_patches
from colmap_av1.poses.dynamic.short_tracks import static_points
from colmap_av1.poses.dynamic.stage import without_dynamic_links, without_dynamic_tracks
from colmap_av1.poses.posed_images import PosedImages
from colmap_av1.poses.run import Run
from colmap_av1.reconstruct import reconstruct
from colmap_av1.tracks.selection import select_tracks
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.tracks.video_tracks import VideoSource, track_video
from colmap_av1.util.run_context import RunContext
from colmap_av1.video.decoding import decode_frames
from colmap_av1.video.facts import read_video

WIDTH, HEIGHT, FOCAL, CELL = 320, 240, 300.0, 8
CAMERA = pycolmap.Camera(
    camera_id=1, model="PINHOLE", width=WIDTH, height=HEIGHT, params=[FOCAL, FOCAL, 160, 120]
)
NUM_IMAGES = 24
WALL, BOX = 6.0, 4.0


@dataclass(frozen=True)
class Made:
    tracks: TracksInCells
    views: list[PosedCamera]
    moves: NDArray[np.bool_]


def cameras(rng: np.random.Generator) -> list[PosedCamera]:
    """A hand-held camera that moves to the right."""
    step = np.arange(NUM_IMAGES)
    centres = np.column_stack([0.08 * step, 0.05 * np.sin(step / 2), 0.03 * np.cos(step / 3)])
    poses = []
    for centre in centres:
        rotation = cv2.Rodrigues(0.002 * rng.standard_normal(3))[0]
        poses.append(np.column_stack([rotation, -rotation @ centre]))
    return [PosedCamera(CAMERA, pose) for pose in poses]


def made(velocity: tuple[float, float, float] | None, *, drift: float = 0.0) -> Made:
    """Tracks of a wall, a box in front of it and, with a velocity in metres per image, a walker.

    Points are observed where they are not occluded; a share `drift` of the tracks drifts.
    """
    rng = np.random.default_rng(3)
    views = cameras(rng)
    start = np.array([0.5, 0.0, 3.0])
    low, high = np.array([-0.25, -0.7]), np.array([0.25, 0.9])

    def grid(x: tuple[float, float], y: tuple[float, float], z: float) -> NDArray[np.float64]:
        across, down = np.meshgrid(np.arange(*x, CELL * z / FOCAL), np.arange(*y, CELL * z / FOCAL))
        return np.column_stack([across.ravel(), down.ravel(), np.full(across.size, z)])

    still = np.concatenate([grid((-4, 6), (-3, 3), WALL), grid((-0.9, -0.3), (0, 0.8), BOX)])
    walker = grid((low[0], high[0]), (low[1], high[1]), 0.0 + start[2]) - [0, 0, start[2]]
    walker = walker if velocity is not None else walker[:0]
    speed = np.array(velocity if velocity is not None else (0, 0, 0))
    found: list[list[tuple[int, float, float]]] = [[] for _ in range(len(still) + len(walker))]
    for number, view in enumerate(views):
        # With a constant velocity the tracks could be those of static points at another depth.
        there = start + speed * (number + 3 * np.sin(number / 2))
        xyz = np.concatenate([still, walker + there])
        index, xy, depth = view.project(xyz)
        ray = xyz[index] - view.centre
        hit = view.centre + ray * ((there[2] - view.centre[2]) / ray[:, 2])[:, None] - there
        behind_walker = (hit[:, :2] > low).all(axis=1) & (hit[:, :2] < high).all(axis=1)
        behind_walker &= (index < len(still)) & (len(walker) > 0)
        at_box = view.centre + ray * ((BOX - view.centre[2]) / ray[:, 2])[:, None]
        behind_box = (at_box[:, 0] > -0.9) & (at_box[:, 0] < -0.3)
        behind_box &= (at_box[:, 1] > 0) & (at_box[:, 1] < 0.8) & (depth > BOX + 0.5)
        for i in np.flatnonzero(~behind_walker & ~behind_box):
            found[index[i]].append((number, *xy[i]))
    pieces, moves = [], []
    for point, seen in enumerate(found):
        # A track ends where its point is hidden.
        breaks = np.diff([s[0] for s in seen]) > 1
        # Tracks of encoders also break at random.
        breaks |= rng.random(len(breaks)) < 0.07
        for piece in np.split(seen, np.flatnonzero(breaks) + 1):
            if len(piece) >= 4:
                pieces.append(np.array(piece))
                moves.append(point >= len(still))
    offsets = np.cumsum([0, *map(len, pieces)])
    rows = np.concatenate(pieces)
    xy = rows[:, 1:] + 0.1 * rng.standard_normal((len(rows), 2))
    drifts = np.repeat(rng.random(len(pieces)) < drift, np.diff(offsets))
    xy[drifts] += np.cumsum(rng.standard_normal((drifts.sum(), 2)), axis=0) % 6
    image = rows[:, 0].astype(np.int64)
    tracks = Tracks(
        *(NUM_IMAGES, WIDTH, HEIGHT, offsets, image.astype(np.int32), xy.astype(np.float32)),
        np.full(len(rows), 0.3, np.float32),
        np.zeros(len(rows), np.bool_),
    )
    points = triangulate(
        Observations(offsets, image, np.asarray(CAMERA.cam_from_img(xy)), tracks.sigma),
        Views(np.array([v.cam_from_world for v in views]), np.full((NUM_IMAGES, 2), FOCAL)),
        TriangulateOptions(
            max_reprojection_error=8.0, min_angle=0.0, max_depth_error=None, points="survey"
        ),
    )
    triangulated = TriangulatedTracks(tracks, image, np.zeros_like(xy), points)
    in_cells = tracks_in_cells(triangulated, views, CELL)
    return Made(in_cells, views, np.array(moves))


def test_points_fall_into_the_right_cells_of_very_wide_images() -> None:
    width, cell, columns = 40_000, 16, [1, 1000, 2047, 2048, 2499]
    camera = pycolmap.Camera(model="PINHOLE", width=width, height=64, params=[100, 100, 0, 32])
    views = [PosedCamera(camera, np.eye(4)[:3]) for _ in range(2)]
    one, first = np.ones(5), np.zeros(5, np.int64)
    x = (np.array(columns) + 0.5) * cell
    xyz = np.column_stack([x / 100, 0 * one, one])
    # The first image observes every point; the second one should observe them and does not.
    length = 6
    track = np.repeat(np.arange(5), length)
    column = (x // cell).astype(np.int64)[track]
    tracks = TracksInCells(
        *((2, 4, width // cell), cell, np.arange(0, 31, length), track, first[track]),
        *(0 * column + 2, column, one[track], 0 * one, xyz),
    )
    unseen = Contradictions(tracks, views).unseen(np.zeros(5, np.bool_))
    assert not unseen[0].any()
    assert np.argwhere(unseen[1]).tolist() == [[2, k] for k in columns]


# Along the epipolar lines (against the camera, and faster than it), towards the camera, upwards.
WALKS = [(-0.05, 0, 0), (0.13, 0, 0), (-0.01, 0, -0.06), (0, -0.03, 0)]


@pytest.mark.parametrize("velocity", WALKS)
def test_walker_is_found_in_any_direction(velocity: tuple[float, float, float]) -> None:
    scene = made(velocity)
    found = Contradictions(scene.tracks, scene.views)
    by_depth = found.by_depth(np.zeros(len(scene.moves), np.bool_))
    assert np.mean(by_depth[scene.moves]) > 0.2
    assert np.mean(by_depth[~scene.moves]) < 0.01
    cells = dynamic_cells(scene.tracks, scene.views)
    tracks = scene.tracks
    within = tracks.mean(cells[tracks.image, tracks.row, tracks.column])
    assert np.mean(within[scene.moves] > 0.5) > 0.9
    # Dynamic regions are dilated by a cell, so some static tracks next to them are included.
    assert np.mean(within[~scene.moves] > 0.5) < 0.12


def test_projections_that_are_not_kept_are_computed_again(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = made(WALKS[0])
    cells = dynamic_cells(scene.tracks, scene.views)
    monkeypatch.setattr("colmap_av1.poses.dynamic.contradictions._MAX_KEPT", 0)
    assert cells.any()
    assert (dynamic_cells(scene.tracks, scene.views) == cells).all()


@pytest.mark.parametrize("drift", [0.0, 0.3])
def test_static_scene_has_no_dynamic_cells(drift: float) -> None:
    """Occlusion by the box and drifting tracks on smooth surfaces do not count as motion."""
    scene = made(None, drift=drift)
    assert not dynamic_cells(scene.tracks, scene.views).any()


def test_usual_share_is_computed_from_static_cells() -> None:
    """Where most of the scene moves, only the static rest gives the baseline."""
    tracks = made(None).tracks
    _, _, columns = tracks.shape
    moving = np.zeros(tracks.shape, np.bool_)
    moving[:, :, : 2 * columns // 3] = True
    within = tracks.mean(moving[tracks.image, tracks.row, tracks.column])
    share_of_track = np.where(within > 0.5, 1.0, 0.3)
    inside = (slice(None), slice(4, -4), slice(2 * columns // 3 + 6, -4))
    for still, expected in ((~moving, 0.0), (np.ones_like(moving), -0.7)):
        share = shares_above_usual(tracks, share_of_track, still)[inside]
        assert np.median(share) == pytest.approx(expected, abs=0.05)


def test_weak_patches_are_dropped_from_the_dynamic_regions() -> None:
    cells, share = np.zeros((2, 20, 30), np.bool_), np.full((2, 20, 30), 0.1)
    cells[:, 2:10, 3:9] = True
    share[:, 4:9, 4:8] = 0.7
    cells[0, 12:16, 20:26] = True  # at the edge of a region that a person passed
    share[0, 12, 20] = 0.7
    found = strong_patches(cells, share)
    assert found[:, 2:10, 3:9].all()
    assert found.sum() == 2 * 8 * 6


def test_objects_that_move_between_two_images_do_not_separate_their_links() -> None:
    """A link says nothing about the frames between its observations, unlike a track of motion."""
    kept = np.ones((HEIGHT, WIDTH), np.bool_)
    kept[:, 100:200] = False
    images = ChosenImages([str(i) for i in range(10)], np.arange(10, dtype=np.int32))
    image_set = number_images([""], [images], [10])
    links = Tracks(
        num_frames=10,
        width=WIDTH,
        height=HEIGHT,
        offsets=np.array([0, 3, 5, 7]),
        frame=np.array([0, 5, 9, 0, 9, 5, 9], np.int32),
        xy=np.array([[x, 50] for x in (50, 150, 250, 50, 250, 150, 250)], np.float32),
        sigma=np.zeros(7, np.float32),
        confirmed=np.ones(7, np.bool_),
    )
    masks = {str(i): make_mask(kept) for i in range(4, 7)}
    left = without_dynamic_links(links, image_set, masks)
    assert left.frame.tolist() == [0, 9, 0, 9]
    assert left.offsets.tolist() == [0, 2, 4]


@pytest.mark.parametrize("observed", [1, 3])
def test_shortest_length_of_tracks_counts_frames_and_not_images(
    tmp_path: Path, observed: int
) -> None:
    """Every third frame is an image, and tracks may have observations in the images only."""
    kept = np.ones((HEIGHT, WIDTH), np.bool_)
    kept[:, 100:200] = False
    frames = np.arange(0, 30, 3, dtype=np.int32)
    images = ChosenImages([str(frame) for frame in frames], frames)
    image_set = number_images([""], [images], [30])
    # The first two are next to a moving object, the others go behind it in frame 15.
    spans = [(0, 9), (0, 6), (3, 27), (9, 21)]
    seen = [np.arange(first, last + 1, observed) for first, last in spans]
    x = np.repeat([50, 50, 150, 150], [len(own) for own in seen])
    tracks = Tracks(
        num_frames=30,
        width=WIDTH,
        height=HEIGHT,
        offsets=np.cumsum([0, *map(len, seen)]),
        frame=np.concatenate(seen).astype(np.int32),
        xy=np.column_stack([x, np.full(len(x), 50)]).astype(np.float32),
        sigma=np.zeros(len(x), np.float32),
        confirmed=np.ones(len(x), np.bool_),
    )
    inputs: Any = None  # only used by earlier stages
    options = ReconstructOptions(match=MatchOptions(tracks=TrackOptions(min_length=10)))
    run = Run(inputs, (), (), tmp_path, tmp_path, options, RunContext())
    left = without_dynamic_tracks(tracks, image_set, {"15": make_mask(kept)}, run)
    first, last = left.frame[left.offsets[:-1]], left.frame[left.offsets[1:] - 1]
    before, after = (12, 18) if observed == 3 else (14, 16)
    assert list(zip(first, last, strict=True)) == [(0, 9), (3, before), (after, 27)]


def test_points_of_few_images_are_static_if_one_image_shows_no_motion() -> None:
    images = [[0, 1, 2], [2, 3, 4, 5], [3, 4, 5, 6, 7], [4, 5, 6, 8], [9, 10, 11]]
    count = len(images)
    points = ModelPoints(
        *(np.zeros((count, 3)), np.zeros((count, 3), np.uint8), np.zeros(count)),
        np.cumsum([0, *map(len, images)]),
        *(np.concatenate(images), np.zeros((sum(map(len, images)), 2))),
    )
    shows_moving = np.isin(np.arange(12), range(2, 8))
    assert static_points(points, shows_moving).tolist() == [0, 2, 3, 4]
    assert static_points(points, np.ones(12, np.bool_)).tolist() == [2]
    assert static_points(points, np.zeros(12, np.bool_)).tolist() == [0, 1, 2, 3, 4]
    assert len(static_points(ModelPoints.empty(), shows_moving)) == 0


# Width and height in pixels of a poster that moves across the frames of the rendered courtyard.
POSTER = (88, 200)
NUM_FRAMES = 30


@pytest.fixture(scope="module")
def walked(
    encode: Encode, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, NDArray[np.bool_]]:
    """A clip with a poster that moves across the scene, and the pixels of the poster."""
    scene = Path(__file__).resolve().parents[2] / "examples" / "scene.mp4"
    shown = (picture for _, picture in decode_frames(scene))
    frames = np.array(list(itertools.islice(shown, NUM_FRAMES)))
    rng = np.random.default_rng(5)
    texture = rng.integers(0, 256, (POSTER[1] // 8, POSTER[0] // 8, 3), dtype=np.uint8)
    texture = cv2.resize(texture, POSTER, interpolation=cv2.INTER_CUBIC)
    there = np.zeros(frames.shape[:3], np.bool_)
    for number, frame in enumerate(frames):
        x, y = 120 + 6 * number + round(4 * np.sin(number)), 100
        frame[y : y + POSTER[1], x : x + POSTER[0]] = texture
        there[number, y : y + POSTER[1], x : x + POSTER[0]] = True
    return encode(frames, tmp_path_factory.mktemp("walked") / "walked.mp4"), there


def test_reconstruct_masks_dynamic_pixels(
    walked: tuple[Path, NDArray[np.bool_]], truth: Truth, tmp_path: Path
) -> None:
    video, there = walked
    options = ReconstructOptions(
        match=MatchOptions(
            images=ImageOptions(every=1),
            camera=CameraOptions(camera_model="PINHOLE", camera_params="520,520,320,180"),
        ),
        moving="mask",
    )
    report = reconstruct(video, tmp_path / "out", options=options)
    model = pycolmap.Reconstruction(report.output / "sparse" / "0")
    assert len(model.images) == NUM_FRAMES
    on_it = total = 0
    for image in model.images.values():
        xy = np.array([p.xy for p in image.points2D if p.has_point3D()]).astype(int)
        on_it += int(there[int(image.name[6:12]), xy[:, 1], xy[:, 0]].sum())
        total += len(xy)
    assert total > 20_000
    masks = sorted((report.output / "masks").iterdir())
    found = np.array([cv2.imread(str(path), cv2.IMREAD_UNCHANGED) == 0 for path in masks])
    assert np.mean(found[there]) > 0.8
    assert on_it < 0.002 * total
    assert np.mean(found[~there]) < 0.08
    assert report.dynamic_share == pytest.approx(found.mean(), rel=0.05)
    errors = pose_errors(model_poses(model, NUM_FRAMES), truth.cam_from_world[:NUM_FRAMES])
    assert errors is not None
    assert errors.ate < 0.0002 * errors.extent


@dataclass(frozen=True)
class Passed:
    """The scene with a broad band that moves across the images and cuts the tracks behind it.

    Attributes:
        run: the run after the preceding stages.
        tracks: tracks of the scene, cut at the band.
        registered: the posed images.
        left: the first column of the band in each image.
    """

    run: Run
    tracks: Tracks
    registered: PosedImages
    left: NDArray[np.int64]


@pytest.fixture(scope="module")
def passed(truth: Truth, tmp_path_factory: pytest.TempPathFactory) -> Passed:
    video = read_video(SCENE)
    source = VideoSource(video, video)
    every = track_video(source, MatchOptions().tracking, one_size=True, context=RunContext()).tracks
    frames = np.arange(NUM_FRAMES, dtype=np.int32)
    left = 60 + 14 * np.arange(NUM_FRAMES)
    column = np.arange(640)
    masks = [
        make_mask(np.tile((column < at) | (column >= at + 100), (360, 1))) for at in left.tolist()
    ]
    names = [f"{frame}.png" for frame in frames]
    images = [
        ModelImage(frame + 1, name, 7, truth.cam_from_world[frame])
        for frame, name in enumerate(names)
    ]
    image_set = ImageSet(
        ("",),
        ChosenImages(names, frames),
        np.zeros(NUM_FRAMES, np.int32),
        np.array([0, every.num_frames]),
        tuple(masks),
    )
    registered = PosedImages(PosedModel({7: truth.camera}, images), image_set)
    inputs: Any = None  # only used by earlier stages
    folder = tmp_path_factory.mktemp("passed")
    shown = (ShownVideo.as_played(video),)
    run = Run(
        inputs,
        (source,),
        shown,
        folder,
        folder,
        ReconstructOptions(),
        RunContext(),
    )
    some = DensityOptions(max_tracks_per_image=400, spacing=20.0, min_images=3, max_sigma=0.0)
    cut = mask_tracks(every.keep_frames(frames), dict(enumerate(masks)), 4)
    return Passed(run, select_tracks(cut, some), registered, left)


def with_images(registered: PosedImages, images: list[ModelImage]) -> PosedImages:
    return replace(registered, model=replace(registered.model, images=images))


def off_behind(tracks: Tracks) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """The observations before gaps of five frames or more, and the errors in pixels after every
    third gap."""
    before = np.flatnonzero((np.diff(tracks.frame) > 5) & (np.diff(tracks.track) == 0))
    scene = render_scene.build_scene()
    off = []
    for row in before[::3]:
        xy, _ = render_scene.transfer(
            scene, tracks.xy[[row]].astype(float), *tracks.frame[[row, row + 1]].tolist()
        )
        off.append(np.linalg.norm(xy[0] - tracks.xy[row + 1]))
    return before, np.array(off)


def test_nothing_is_followed_in_a_video_without_registered_images(passed: Passed) -> None:
    image_set = passed.registered.image_set
    of_another = replace(image_set, sequence=np.ones_like(image_set.sequence))
    others = replace(passed.registered, image_set=of_another)
    assert follow_occluded(passed.run, passed.tracks, others).num_tracks == 0


def test_tracks_continue_behind_a_passing_object(passed: Passed) -> None:
    found = follow_occluded(passed.run, passed.tracks, passed.registered)
    assert found.num_observations > 1.1 * passed.tracks.num_observations
    assert len(off_behind(passed.tracks)[0]) < 10
    taken_up, off = off_behind(found)
    assert len(taken_up) > 80
    assert np.median(off) < 0.25
    assert np.quantile(off, 0.9) < 1
    left = passed.left[found.frame]
    on_it = (found.xy[:, 0] >= left + 1) & (found.xy[:, 0] < left + 99)
    assert on_it.mean() < 0.001


def test_camera_that_stands_still_gives_no_tracks(passed: Passed) -> None:
    """The pictures of another video may show parallax."""
    pose = passed.registered.images[0].cam_from_world
    still = [replace(image, cam_from_world=pose) for image in passed.registered.images]
    registered = with_images(passed.registered, still)
    assert follow_occluded(passed.run, passed.tracks, registered).num_tracks == 0


@pytest.mark.parametrize("pixels", [1, 7])
def test_wrong_poses_do_not_continue_tracks_wrongly(passed: Passed, pixels: float) -> None:
    """Where the predicted position is wrong, another feature there is not followed instead."""
    turn = Rotation.from_euler("y", pixels / 520).as_matrix()
    images = [
        replace(image, cam_from_world=turn @ image.cam_from_world) if frame >= 20 else image
        for frame, image in enumerate(passed.registered.images)
    ]
    early = passed.tracks.keep_frames(np.arange(20, dtype=np.int32))
    found = follow_occluded(passed.run, early, with_images(passed.registered, images))
    first = np.repeat(found.offsets[:-1], found.lengths)
    late = np.flatnonzero(found.frame >= 20)
    if pixels > 1:  # outside the search window
        assert len(late) < 10
        return
    assert len(late) > 100
    scene = render_scene.build_scene()
    off = []
    for row in late[::40]:
        frames = found.frame[[first[row], row]].tolist()
        xy, _ = render_scene.transfer(scene, found.xy[[first[row]]].astype(float), *frames)
        off.append(np.linalg.norm(xy[0] - found.xy[row]))
    assert np.median(off) < 0.4


def test_points_are_expected_in_the_images_they_project_to() -> None:
    rng = np.random.default_rng(3)
    views = cameras(rng)
    x, y = np.meshgrid(np.arange(-3.0, 5.0, 0.5), np.arange(-2.0, 2.5, 0.5))
    xyz = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, WALL)])
    # Each point is observed in the first three images that show it and in three after a gap.
    rows = []
    shown = [dict(zip(*view.project(xyz)[:2], strict=True)) for view in views]
    for point in range(len(xyz)):
        images = [i for i, own in enumerate(shown) if point in own]
        rows += [(point, i, *shown[i][point]) for i in [*images[:3], *images[5:8]]]
    table = np.array(rows)
    point, image = table[:, :2].astype(np.int64).T
    kept = np.isin(point, np.flatnonzero(np.bincount(point) == 6))
    number = np.unique(point[kept])
    offsets = 6 * np.arange(len(number) + 1)
    frames = np.arange(0, 2 * NUM_IMAGES, 2, dtype=np.int32)
    tracks = Tracks(
        *(frames[-1] + 1, WIDTH, HEIGHT, offsets, frames[image[kept]]),
        table[kept, 2:].astype(np.float32),
        *(np.full(kept.sum(), 0.3, np.float32), np.zeros(kept.sum(), np.bool_)),
    )
    points = TriangulatedPoints(
        *(xyz[number], np.zeros(len(number)), offsets, np.arange(kept.sum())),
        *(len(number), len(number)),
    )
    left_half = np.ones((HEIGHT, WIDTH), np.bool_)
    left_half[:, : WIDTH // 2] = False
    views = [replace(view, mask=make_mask(left_half)) for view in views]
    triangulated = TriangulatedTracks(tracks, image[kept], np.zeros((kept.sum(), 2)), points)
    found, expected = expect_in_views(triangulated, views, frames)
    # Observations are kept, and each point is expected at its projection in later images, except
    # near the edge and on masks.
    np.testing.assert_array_equal(found.xy[~expected], tracks.xy)
    np.testing.assert_array_equal(found.frame[~expected], tracks.frame)
    assert expected.sum() > 300
    for row in np.flatnonzero(expected):
        own, seen_in = found.track[row], int(found.frame[row]) // 2
        np.testing.assert_allclose(found.xy[row], shown[seen_in][number[own]], atol=1e-3)
        assert found.xy[row, 0] >= WIDTH // 2
        assert found.frame[row] > tracks.frame[offsets[own]]
        assert found.frame[row] not in tracks.frame[offsets[own] : offsets[own + 1]]
    assert (np.diff(found.frame)[np.diff(found.track) == 0] > 0).all()

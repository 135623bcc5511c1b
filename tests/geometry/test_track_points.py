from __future__ import annotations

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from colmap_av1.geometry.model_points import ModelPoints
from colmap_av1.geometry.posed_camera import PosedCamera
from colmap_av1.geometry.track_points import (
    Colours,
    TriangulatedTracks,
    chaining_for_points,
    triangulate_tracks,
)
from colmap_av1.geometry.triangulation import TriangulatedPoints
from colmap_av1.options import TrackOptions, TriangulateOptions
from colmap_av1.tracks.tracks import Tracks

WIDTH, HEIGHT = 640, 480
PLAIN = pycolmap.Camera(
    camera_id=1, model="PINHOLE", width=WIDTH, height=HEIGHT, params=[500, 500, 320, 240]
)
BENT = pycolmap.Camera(
    camera_id=2, model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT, params=[700, 320, 240, -0.2]
)
# A camera that moves to the right.
POSES = [np.column_stack([np.eye(3), [-0.3 * i, 0, 0]]) for i in range(6)]


def make_tracks(xy: np.ndarray) -> Tracks:
    """Tracks [num_tracks, num_frames, 2] that are observed in all frames."""
    count, length = xy.shape[:2]
    return Tracks(
        length,
        WIDTH,
        HEIGHT,
        np.arange(count + 1, dtype=np.int64) * length,
        frame=np.tile(np.arange(length, dtype=np.int32), count),
        xy=xy.reshape(-1, 2).astype(np.float32),
        sigma=np.full(count * length, 0.2, np.float32),
        confirmed=np.zeros(count * length, bool),
    )


def make_points(observation: list[list[int]]) -> TriangulatedPoints:
    offsets = np.cumsum([0, *map(len, observation)])
    num = len(observation)
    flat = np.array([o for each in observation for o in each], dtype=np.int64)
    return TriangulatedPoints(np.zeros((num, 3)), np.zeros(num), offsets, flat, num, num)


@pytest.mark.parametrize(
    ("given", "min_observations", "min_length", "cell"),
    [
        (TrackOptions(), 3, 3, 2),
        (TrackOptions(), 2, 2, 2),
        (TrackOptions(), 5, 3, 2),
        (TrackOptions(seeding=1, cell=None), 3, 3, 1),
        (TrackOptions(min_length=6, cell=4), 2, 6, 4),
    ],
)
def test_chaining_for_points_keeps_short_tracks(
    given: TrackOptions, min_observations: int, min_length: int, cell: int
) -> None:
    triangulate = TriangulateOptions(min_observations=min_observations)
    tracks = chaining_for_points(given, triangulate)
    assert (tracks.min_length, tracks.cell) == (min_length, cell)
    assert replace(tracks, min_length=given.min_length, cell=given.cell) == given
    smaller = chaining_for_points(given, triangulate, is_downscaled=True)
    assert (smaller.min_length, smaller.cell) == (min_length, given.cell)


def test_views_are_indices_of_the_given_frames() -> None:
    tracks = make_tracks(np.arange(2 * 6 * 2.0).reshape(2, 6, 2))
    frames = np.array([1, 4, 5], dtype=np.int32)
    views = [PosedCamera(PLAIN, POSES[frame]) for frame in frames]
    found = triangulate_tracks(tracks, frames, views, options=TriangulateOptions(), num_threads=1)
    assert found.tracks.frame.tolist() == [1, 4, 5, 1, 4, 5]
    assert found.view.tolist() == [0, 1, 2, 0, 1, 2]
    np.testing.assert_array_equal(found.tracks.xy, tracks.xy[[1, 4, 5, 7, 10, 11]])


def test_tracks_outside_the_images_give_no_points() -> None:
    tracks = make_tracks(np.zeros((2, 6, 2))).keep_frames(np.array([0], np.int32))
    views = [PosedCamera(PLAIN, POSES[k]) for k in (1, 2)]
    found = triangulate_tracks(
        tracks, np.array([1, 2], np.int32), views, options=TriangulateOptions(), num_threads=1
    )
    assert len(found.view) == len(found.model_points().xyz) == 0
    assert found.agreement == 0


def test_points_are_triangulated_from_several_cameras() -> None:
    rng = np.random.default_rng(0)
    truth = rng.uniform([-1, -1, 5], [2, 1, 9], (50, 3))
    cameras = [PLAIN, PLAIN, BENT, BENT, PLAIN, BENT]
    xy = np.stack(
        [
            camera.img_from_cam(truth @ pose[:, :3].T + pose[:, 3])
            for camera, pose in zip(cameras, POSES, strict=True)
        ],
        axis=1,
    )
    tracks = make_tracks(xy)

    def found(pinhole: pycolmap.Camera | None, xy: np.ndarray) -> TriangulatedPoints:
        return triangulate_tracks(
            replace(tracks, xy=xy),
            np.arange(6, dtype=np.int32),
            [PosedCamera(camera, pose) for camera, pose in zip(cameras, POSES, strict=True)],
            options=TriangulateOptions(),
            num_threads=1,
            pinholes=pinhole and [pinhole] * len(cameras),
        ).points

    exact = found(None, tracks.xy)
    np.testing.assert_allclose(exact.xyz, truth, rtol=1e-4)
    # Errors are in pixels of the given camera.
    noisy = tracks.xy + rng.normal(0, 0.2, tracks.xy.shape).astype(np.float32)
    wide = pycolmap.Camera(
        camera_id=9, model="PINHOLE", width=WIDTH, height=HEIGHT, params=[50, 50, 320, 240]
    )
    assert 0.1 < np.median(found(None, noisy).error) < 0.5
    assert 0.005 < np.median(found(wide, noisy).error) < 0.05


def test_colours_are_medians_over_the_images() -> None:
    """Points at the centre, in the corner, in a single image, and twice in one image."""
    image = np.array([0, 1, 2, 0, 1, 2, 1, 0, 0, 2])
    xy = np.tile([[320.0, 240.0]], (10, 1))
    xy[3:6] = WIDTH, HEIGHT
    offsets = np.array([0, 3, 6, 7, 10])
    none = np.zeros((4, 3), np.uint8)
    points = ModelPoints(np.zeros((4, 3)), none, np.zeros(4), offsets, image, xy)
    colours = Colours(points, [(WIDTH, HEIGHT)] * 3)
    blue, red, white = np.zeros((3, HEIGHT, WIDTH, 3), dtype=np.uint8)
    blue[..., 0], red[..., 2], white[...] = 200, 100, 255
    half = np.ascontiguousarray(red[::2, ::2])
    half[-1, -1] = [0, 240, 0]
    for i, picture in enumerate((blue, white, half)):
        colours.add(i, picture)
    assert colours.rgb().tolist() == [
        [100, 0, 0],  # the median by brightness of blue, white and red
        [0, 240, 0],  # positions on the border use the last pixel
        [255, 255, 255],
        [0, 0, 200],
    ]


def test_model_points_list_the_images_that_observe_them() -> None:
    points = make_points([[4, 1], [0, 3, 5]])
    view = np.array([0, 1, 2, 0, 1, 2])
    xy = np.arange(10.0).reshape(5, 2)
    tracks = make_tracks(np.zeros((1, 6, 2)))
    made = TriangulatedTracks(tracks, view, np.zeros((6, 2)), points).model_points(xy)
    assert made.image.tolist() == [1, 1, 0, 0, 2]
    assert made.offsets.tolist() == [0, 2, 5]
    assert made.rgb.tolist() == [[0, 0, 0]] * 2
    assert made.xy is xy

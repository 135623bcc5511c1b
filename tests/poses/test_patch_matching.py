"""Corners of a textured plane are matched by patches in images from other viewpoints."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from colmap_av1.geometry.masks import make_mask
from colmap_av1.geometry.posed_camera import PosedCamera
from colmap_av1.geometry.track_points import TriangulatedTracks
from colmap_av1.geometry.triangulation import TriangulatedPoints
from colmap_av1.poses.corners.grey_pictures import GreyPictures
from colmap_av1.poses.corners.patch_matching import match_patches
from colmap_av1.tracks.tracks import Tracks

FOCAL, WIDTH, HEIGHT = 300.0, 320, 240
NUM_FOLLOWED = 3  # the first images, through which corners were tracked
NUM_CORNERS = 120
# Width of a texture pixel; the plane is at distance 3.
TEXEL = 0.01


@dataclass(frozen=True)
class Scene:
    """Images of a textured plane, and corners tracked through the first images."""

    views: list[PosedCamera]
    pictures: list[NDArray[np.uint8]]
    corners: Tracks
    view: NDArray[np.int64]
    points: TriangulatedPoints

    def places(self, image: int) -> NDArray[np.float64]:
        """True pixels of the points in an image."""
        view = self.views[image]
        in_camera = self.points.xyz @ view.cam_from_world[:, :3].T + view.cam_from_world[:, 3]
        return np.asarray(view.camera.img_from_cam(in_camera))


def pose(shift: tuple[float, float, float], turn: tuple[float, float, float]) -> Any:
    """A camera at a position, rotated by angles in degrees about its axes."""
    rotation = Rotation.from_euler("xyz", turn, degrees=True).as_matrix()
    return np.column_stack([rotation, -rotation @ np.array(shift)])


POSES = (
    pose((-0.15, 0, 0), (0, 0, 0)),
    pose((0, 0, 0), (0, 0, 0)),
    pose((0.15, 0, 0), (0, 1, 0)),
    # Other viewpoints: nearer, and rolled.
    pose((0.7, 0.1, 0.3), (0, 12, 20)),
    pose((-0.4, -0.2, -0.5), (-3, -8, -10)),
)


@pytest.fixture(scope="module", name="scene")
def _scene() -> Scene:
    return make_scene(tilt=0.0)


def make_scene(tilt: float) -> Scene:
    """The scene; the depth of the plane grows by `tilt` per unit to the right."""
    rng = np.random.default_rng(4)
    texture = cv2.GaussianBlur(rng.integers(0, 256, (700, 900)).astype(np.float32), (0, 0), 2.0)
    texture = cv2.normalize(texture, texture, 20, 235, cv2.NORM_MINMAX)
    camera = pycolmap.Camera(
        camera_id=1, model="SIMPLE_PINHOLE", width=WIDTH, height=HEIGHT, params=[FOCAL, 160, 120]
    )
    views = [PosedCamera(camera, own) for own in POSES]
    pictures = []
    for own in POSES:
        # From texture pixels, with the centre of the first at (0, 0), to image pixels.
        to_plane = np.array(
            [[TEXEL, 0, -4.5], [0, TEXEL, -3.5], [TEXEL * tilt, 0, 3.0 - 4.5 * tilt]]
        )
        to_camera = own[:, :3] @ to_plane + own[:, 3:] @ [[0, 0, 1.0]]
        to_picture = np.array([[FOCAL, 0, 159.5], [0, FOCAL, 119.5], [0, 0, 1]]) @ to_camera
        shown = cv2.warpPerspective(texture, to_picture, (WIDTH, HEIGHT), flags=cv2.INTER_LINEAR)
        pictures.append(np.clip(np.rint(shown), 0, 255).astype(np.uint8))
    flat = rng.uniform([-1.0, -0.8], [1.0, 0.8], (NUM_CORNERS, 2))
    xyz = np.column_stack([flat, 3.0 + tilt * flat[:, 0]])
    total = NUM_CORNERS * NUM_FOLLOWED
    offsets = np.arange(0, total + 1, NUM_FOLLOWED)
    corners = Tracks(
        num_frames=len(POSES),
        width=WIDTH,
        height=HEIGHT,
        offsets=offsets,
        frame=np.tile(np.arange(NUM_FOLLOWED, dtype=np.int32), NUM_CORNERS),
        xy=np.zeros((total, 2), np.float32),
        sigma=np.full(total, 0.25, np.float32),
        confirmed=np.ones(total, np.bool_),
    )
    points = TriangulatedPoints(
        xyz, np.zeros(NUM_CORNERS), offsets, np.arange(total), NUM_CORNERS, NUM_CORNERS
    )
    made = Scene(views, pictures, corners, corners.frame.astype(np.int64), points)
    followed = np.stack([made.places(image) for image in range(NUM_FOLLOWED)], axis=1)
    # The tracks drift, except in the middle image, which gives the template.
    drift = rng.uniform(-1, 1, followed.shape) * np.array([1, 0, 1])[:, None]
    xy = (followed + drift).reshape(-1, 2).astype(np.float32)
    return replace(made, corners=replace(corners, xy=xy))


@pytest.fixture(name="kept")
def _kept(scene: Scene, tmp_path: Path) -> Iterator[GreyPictures]:
    with GreyPictures(tmp_path) as pictures:
        for image, picture in enumerate(scene.pictures):
            pictures.keep(image, picture)
        yield pictures


def look(scene: Scene, pictures: GreyPictures, views: list[PosedCamera] | None = None) -> Tracks:
    """Match the corners of the scene."""
    seen: list[int] = []
    found = match_patches(
        TriangulatedTracks(
            scene.corners, scene.view, np.zeros(scene.corners.xy.shape), scene.points
        ),
        views=scene.views if views is None else views,
        frames=np.arange(len(POSES), dtype=np.int32),
        pictures=pictures,
        num_threads=2,
        progress=seen.append,
    )
    assert seen == list(range(1, len(POSES) + 1))
    return found


def errors(scene: Scene, found: Tracks, image: int) -> NDArray[np.float64]:
    """Distances in pixels from the observations in an image to the nearest true positions."""
    at = found.xy[found.frame == image].astype(np.float64)
    return np.asarray(np.linalg.norm(at[:, None] - scene.places(image), axis=2).min(axis=1))


def test_matched_corners_do_not_drift(scene: Scene, kept: GreyPictures) -> None:
    found = look(scene, kept)
    for image in range(len(POSES)):
        off = errors(scene, found, image)
        assert len(off) > 50
        assert np.median(off) < 0.05
        assert np.quantile(off, 0.95) < 0.2
    assert found.lengths.max() == len(POSES)
    assert (np.diff(found.frame)[np.diff(found.track) == 0] > 0).all()


def test_slanted_surfaces_are_matched_with_warped_patches(tmp_path: Path) -> None:
    slanted = make_scene(tilt=1.0)
    with GreyPictures(tmp_path) as pictures:
        for image, picture in enumerate(slanted.pictures):
            pictures.keep(image, picture)
        found = look(slanted, pictures)
    for image in (3, 4):
        off = errors(slanted, found, image)
        # Without the slope of the surface the median errors would be 0.30 and 0.16 px.
        assert len(off) > 80
        assert np.median(off) < 0.05
        assert np.quantile(off, 0.9) < 0.1


def test_pose_errors_of_two_pixels_do_not_matter(scene: Scene, kept: GreyPictures) -> None:
    turn = Rotation.from_euler("y", 0.4, degrees=True).as_matrix()  # 2 pixels
    views = [
        *scene.views[:3],
        *(replace(v, cam_from_world=turn @ v.cam_from_world) for v in scene.views[3:]),
    ]
    off = errors(scene, look(scene, kept, views), 3)
    assert len(off) > 50
    assert np.median(off) < 0.05


def test_corners_on_masks_are_not_matched(scene: Scene, kept: GreyPictures) -> None:
    counts = np.ones((HEIGHT, WIDTH), np.bool_)
    counts[:, : WIDTH // 2] = False
    views = [*scene.views[:4], replace(scene.views[4], mask=make_mask(counts))]
    found = look(scene, kept, views)
    assert (found.xy[found.frame == 4][:, 0] >= WIDTH // 2 - 1).all()
    assert (found.frame == 4).any()


def test_unrelated_image_has_no_matches(scene: Scene, tmp_path: Path) -> None:
    other = np.random.default_rng(8).integers(0, 256, (HEIGHT, WIDTH)).astype(np.float32)
    with GreyPictures(tmp_path) as pictures:
        for image, picture in enumerate(scene.pictures[:4]):
            pictures.keep(image, picture)
        pictures.keep(4, cv2.GaussianBlur(other, (0, 0), 2.0).astype(np.uint8))
        found = look(scene, pictures)
    assert np.count_nonzero(found.frame == 4) < 3


def test_tracked_positions_are_kept_where_few_patches_match(scene: Scene, tmp_path: Path) -> None:
    with GreyPictures(tmp_path) as pictures:
        for image, picture in enumerate(scene.pictures):
            blank = np.full_like(picture, 128)
            pictures.keep(image, blank if image == 2 else picture)
        found = look(scene, pictures)
    followed = scene.corners.xy[scene.corners.frame == 2]
    kept = found.xy[found.frame == 2]
    assert len(kept) > 50
    assert {tuple(xy) for xy in kept.tolist()} <= {tuple(xy) for xy in followed.tolist()}


def test_images_without_pictures_have_no_matches(scene: Scene, tmp_path: Path) -> None:
    with GreyPictures(tmp_path) as pictures:
        for image, picture in enumerate(scene.pictures[:4]):
            pictures.keep(image, picture)
        found = look(scene, pictures)
    assert set(found.frame.tolist()) == {0, 1, 2, 3}


def test_smaller_pictures_give_full_size_coordinates(scene: Scene, tmp_path: Path) -> None:
    size = (WIDTH // 2, HEIGHT // 2)
    with GreyPictures(tmp_path) as pictures:
        for image, picture in enumerate(scene.pictures):
            pictures.keep(
                image, np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
            )
        found = look(scene, pictures)
    off = errors(scene, found, 3)
    assert len(off) > 20
    assert np.median(off) < 0.1


def test_no_corners_give_no_tracks(scene: Scene, kept: GreyPictures) -> None:
    none = np.empty(0, np.int64)
    nothing = replace(
        scene,
        corners=scene.corners.keep_observations(np.zeros(scene.corners.num_observations, np.bool_)),
        view=none,
        points=TriangulatedPoints(np.empty((0, 3)), np.empty(0), np.zeros(1, np.int64), none, 0, 0),
    )
    assert look(nothing, kept).num_tracks == 0

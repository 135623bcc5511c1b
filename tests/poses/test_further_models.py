"""Further models, which are not connected to the first."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap
import pytest
from image_sets import images
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from stage_results import MATCHES

from colmap_av1.geometry.colmap_model import ModelImage
from colmap_av1.geometry.posed_model import PosedModel, write_posed_model
from colmap_av1.images.inputs import Inputs
from colmap_av1.options import CameraOptions, MatchOptions, ReconstructOptions
from colmap_av1.poses.adjustment_stage import AdjustedResult
from colmap_av1.poses.estimate_steps import Estimate
from colmap_av1.poses.estimate_tracks import EstimateTracks
from colmap_av1.poses.further_models import further_poses, keeps_intrinsics
from colmap_av1.poses.mapping_stage import MappedResult
from colmap_av1.poses.posed_images import read_poses
from colmap_av1.poses.run import Run
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.run_context import RunContext
from colmap_av1.util.stages import Kept

WIDTH, HEIGHT = 640, 480
NUM_FIRST, NUM_SECOND = 30, 26
# No track crosses from the image before this one of the second video.
SEAM = 14


def model(count: int, camera_id: int = 1) -> PosedModel:
    camera = pycolmap.Camera.create_from_model_name(camera_id, "SIMPLE_RADIAL", 500, 640, 480)
    images = [ModelImage(i + 1, f"{i}.png", camera_id, np.eye(3, 4)) for i in range(count)]
    return PosedModel({camera_id: camera}, images)


def test_a_small_model_keeps_the_intrinsics_of_the_first() -> None:
    first = model(40)
    assert keeps_intrinsics(model(12), first)
    assert not keeps_intrinsics(model(35), first)  # it determines them itself
    assert not keeps_intrinsics(model(12), model(10))
    assert not keeps_intrinsics(model(12, camera_id=2), first)


def walk(focal: NDArray[np.float64]) -> tuple[NDArray[np.float64], Tracks]:
    """The poses and tracks of the second video, whose camera moves sideways.

    Args:
        focal: float64 [NUM_SECOND] focal length of each image.
    """
    rng = np.random.default_rng(0)
    k = np.arange(NUM_SECOND)
    centre = np.column_stack([0.4 * k, 0.5 * np.sin(k), 0.5 * np.cos(0.7 * k)])
    turn = np.column_stack([0.05 * np.sin(0.8 * k), 0.1 * np.cos(0.9 * k), 0.05 * np.sin(k)])
    rotation = Rotation.from_rotvec(turn).as_matrix()
    poses = np.concatenate([rotation, -rotation @ centre[:, :, None]], axis=2)
    xyz = rng.uniform([-4, -4, 4], [14, 4, 12], (2000, 3))
    local = np.einsum("fij,pj->fpi", rotation, xyz) + poses[:, None, :, 3]
    xy = focal[:, None, None] * local[..., :2] / local[..., 2:] + [WIDTH / 2, HEIGHT / 2]
    xy += rng.normal(0, 0.1, xy.shape)
    point, frame = np.nonzero(((xy > 0) & (xy < [WIDTH, HEIGHT])).all(axis=2).T)
    side = 2 * point + (frame >= SEAM)
    length = np.unique(side, return_counts=True)[1]
    return poses, Tracks(
        num_frames=NUM_SECOND,
        width=WIDTH,
        height=HEIGHT,
        offsets=np.concatenate([[0], np.cumsum(length)]),
        frame=frame.astype(np.int32),
        xy=xy[frame, point].astype(np.float32),
        sigma=np.full(len(frame), 0.1, np.float32),
        confirmed=np.zeros(len(frame), np.bool_),
    )


def camera(camera_id: int, focal: float) -> pycolmap.Camera:
    return pycolmap.Camera.create_from_model_name(camera_id, "SIMPLE_PINHOLE", focal, WIDTH, HEIGHT)


def parts_of_second(
    folder: Path,
    first: dict[int, pycolmap.Camera],
    second: pycolmap.Camera,
    focal: NDArray[np.float64],
    *,
    single_camera: bool,
) -> list[PosedModel]:
    """Estimate the poses of the second video, whose model is split at the seam.

    Args:
        folder: folder for the output.
        first: the cameras of the model of the first video, one for all of its images or one each.
        second: the camera that the mapper found for the second video.
        focal: see `walk`.
        single_camera: see `CameraOptions`.
    """
    image_set = images(NUM_FIRST, NUM_SECOND)
    names = image_set.images.names
    poses, tracks = walk(focal)
    of_image = list(first) * (NUM_FIRST // len(first))
    models = {
        "first.npz": PosedModel(
            first,
            [ModelImage(k + 1, names[k], own, np.eye(3, 4)) for k, own in enumerate(of_image)],
        ),
        "second.npz": PosedModel(
            {second.camera_id: second},
            [
                ModelImage(k + 1, name, second.camera_id, pose)
                for k, (name, pose) in enumerate(zip(names[NUM_FIRST:], poses, strict=True))
            ],
        ),
    }
    stages = folder / ".stages"
    stages.mkdir()
    for file, made in models.items():
        write_posed_model(stages / file, made)
    size = (WIDTH, HEIGHT)
    nothing = Tracks.empty(NUM_FIRST + NUM_SECOND, size)
    np.savez(stages / "links.npz", **vars(nothing), contradicted=np.empty(0, np.int32))
    matches = replace(
        MATCHES, key_images=tuple(range(len(names))), num_pose_tracks=tracks.num_tracks
    )
    mapped = MappedResult("first.npz", NUM_FIRST, "incremental", ("second.npz",))
    adjusted = AdjustedResult("first.npz", NUM_FIRST, 0, 0, (), (), (), 0.0, None, False, False)
    estimate = Estimate(
        matches=Kept(matches, "matches", False),
        mapped=Kept(mapped, "mapped", False),
        tracks=EstimateTracks(nothing, nothing, has_picture_positions=False),
        adjustment=Kept(adjusted, "adjusted", False),
    )
    options = ReconstructOptions(
        match=MatchOptions(camera=CameraOptions("SIMPLE_PINHOLE", single_camera=single_camera)),
        moving="keep",
    )
    run = Run(Inputs((), ()), (), (), folder, stages, options, RunContext())
    both = (Tracks.empty(NUM_FIRST, size), tracks)
    tried = further_poses(run, estimate, image_set, lambda: both, map_again=False)
    parts = [own.poses for own in tried if own.poses is not None]
    found = [read_poses(own.run, own.estimate.last) for own in parts]
    assert [own.by_name.keys() for own in found] == [
        {*names[NUM_FIRST:][:SEAM]},
        {*names[NUM_FIRST:][SEAM:]},
    ]
    return found


def test_small_models_get_the_camera_of_the_first(tmp_path: Path) -> None:
    focal = np.full(NUM_SECOND, 700.0)
    first, second = {1: camera(1, 700.0)}, camera(1, 680.0)
    for own in parts_of_second(tmp_path, first, second, focal, single_camera=True):
        assert {i: c.mean_focal_length() for i, c in own.cameras.items()} == {1: 700.0}


def test_parts_of_a_model_keep_their_cameras_if_each_image_has_its_own(tmp_path: Path) -> None:
    """Cameras of different images in different models have the same id."""
    focal = np.linspace(680.0, 720.0, NUM_SECOND)
    first = {k: camera(k, 500.0) for k in range(3, 3 + NUM_FIRST)}
    found = parts_of_second(tmp_path, first, camera(2, 700.0), focal, single_camera=False)
    for own in found:
        assert first.keys() > own.cameras.keys()
        refined = [own.cameras[image.camera_id].mean_focal_length() for image in own.images]
        expected = [focal[int(Path(image.name).stem)] for image in own.images]
        assert refined == pytest.approx(expected, rel=0.002)

"""Images whose corners contradict their pose are resected; the others keep their pose."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from colmap_av1 import ReconstructOptions
from colmap_av1.geometry.colmap_model import ModelImage, camera_centres
from colmap_av1.geometry.posed_model import PosedModel, read_posed_model, write_posed_model
from colmap_av1.images.choosing import ChosenImages
from colmap_av1.images.image_set import ImageSet
from colmap_av1.options import PoseOptions
from colmap_av1.poses.adjustment_stage import adjustment_stage
from colmap_av1.poses.corners.in_images import resect_from_corners
from colmap_av1.poses.estimate_tracks import EstimateTracks
from colmap_av1.poses.posed_images import PosedImages, PosesResult
from colmap_av1.poses.run import Run
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.run_context import RunContext
from colmap_av1.util.stages import Kept

NUM_IMAGES, NUM_POINTS, FOCAL = 9, 200, 500.0
WRONG = 4


def scene() -> tuple[PosedImages, Tracks]:
    """Images along a path with exact poses, and corner tracks with 0.1 px of noise."""
    rng = np.random.default_rng(3)
    camera = pycolmap.Camera(
        camera_id=1, model="SIMPLE_PINHOLE", width=640, height=480, params=[FOCAL, 320, 240]
    )
    xyz = rng.uniform([-2, -1.5, 4], [2, 1.5, 8], (NUM_POINTS, 3))
    images, seen = [], []
    for i in range(NUM_IMAGES):
        turn = Rotation.from_euler("y", 0.5 * i, degrees=True).as_matrix()
        pose = np.column_stack([turn, -turn @ np.array([0.15 * i, 0.02 * i, 0])])
        images.append(ModelImage(i + 1, f"{i}.png", 1, pose))
        in_camera = xyz @ pose[:, :3].T + pose[:, 3]
        seen.append(np.asarray(camera.img_from_cam(in_camera)))
    xy = np.stack(seen, axis=1) + rng.normal(0, 0.1, (NUM_POINTS, NUM_IMAGES, 2))
    frames = np.arange(NUM_IMAGES, dtype=np.int32)
    total = NUM_POINTS * NUM_IMAGES
    tracks = Tracks(
        num_frames=NUM_IMAGES,
        width=640,
        height=480,
        offsets=np.arange(0, total + 1, NUM_IMAGES),
        frame=np.tile(frames, NUM_POINTS),
        xy=xy.reshape(-1, 2).astype(np.float32),
        sigma=np.full(total, 0.25, np.float32),
        confirmed=np.ones(total, np.bool_),
    )
    image_set = ImageSet(
        ("",),
        ChosenImages([image.name for image in images], frames),
        np.zeros(NUM_IMAGES, np.int32),
        np.array([0, NUM_IMAGES]),
        (None,) * NUM_IMAGES,
    )
    return PosedImages(PosedModel({1: camera}, images), image_set), tracks


RUN = cast(Any, SimpleNamespace(options=ReconstructOptions(), context=RunContext()))


def test_wrong_pose_is_corrected_from_corners() -> None:
    registered, corners = scene()
    true = registered.images[WRONG].cam_from_world
    turned = Rotation.from_euler("xyz", [0.4, 0.7, 0.2], degrees=True).as_matrix() @ true
    images = list(registered.images)
    images[WRONG] = replace(images[WRONG], cam_from_world=turned)
    wrong = replace(registered, model=replace(registered.model, images=images))
    found = resect_from_corners(RUN, corners, wrong)
    for image, right in zip(found.images, registered.images, strict=True):
        # Rotation error in pixels.
        off = np.abs(image.cam_from_world[:, :3] - right.cam_from_world[:, :3]).max() * FOCAL
        assert off < 0.3, image.name
    assert np.abs(turned - true).max() * FOCAL > 3


def test_poses_are_unchanged_without_corners() -> None:
    registered, corners = scene()
    none = replace(
        corners,
        offsets=corners.offsets[:1],
        frame=corners.frame[:0],
        xy=corners.xy[:0],
        sigma=corners.sigma[:0],
        confirmed=corners.confirmed[:0],
    )
    assert resect_from_corners(RUN, none, registered) is registered


def test_links_join_images_across_a_gap_in_the_tracks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    registered, seen = scene()
    seam = 4  # the image before it
    after = registered.frames > seam
    # All images after the seam are shifted by about 6 px, more than the error of motion tracks.
    off = np.column_stack([np.eye(3), [0, 0.07, 0]])
    images = [
        replace(i, cam_from_world=np.column_stack([i.cam_from_world[:, :3], moved]))
        if is_after
        else i
        for i, is_after, moved in (
            (i, is_after, i.cam_from_world[:, :3] @ off[:, 3] + i.cam_from_world[:, 3])
            for i, is_after in zip(registered.images, after, strict=True)
        )
    ]
    number = np.repeat(np.arange(NUM_POINTS), NUM_IMAGES)
    later = seen.frame > seam
    tracks = seen.keep_observations(((number % 2 == 0) & ~later) | ((number % 4 == 1) & later))
    links = seen.keep_observations((number % 4 == 3) & (np.abs(seen.frame - seam) <= 3))
    write_posed_model(tmp_path / "registered.npz", PosedModel(registered.cameras, images))
    options = ReconstructOptions(poses=PoseOptions(refine_intrinsics=False))
    inputs: Any = None  # only used by earlier stages
    run = Run(inputs, (), (), tmp_path, tmp_path, options, RunContext())
    monkeypatch.setattr(
        "colmap_av1.poses.adjustment_stage.corners_in_images",
        lambda _run, _guide, known: (tracks, known),
    )
    adjusted = adjustment_stage(
        run,
        EstimateTracks(tracks, links, has_picture_positions=True),
        registered.image_set,
        Kept(PosesResult("registered.npz", NUM_IMAGES), "", resumed=False),
    )
    found = read_posed_model(tmp_path / adjusted.result.poses).by_name
    centres = camera_centres(np.array([found[i.name].cam_from_world for i in registered.images]))
    steps = np.diff(centres, axis=0)
    usual = np.median(steps, axis=0)
    assert np.linalg.norm(steps[seam] - usual) < 0.05 * np.linalg.norm(usual)

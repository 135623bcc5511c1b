"""A bent model is mapped again from its own observations."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from conftest import Ffmpeg

from colmap_av1.geometry.colmap_model import ModelImage
from colmap_av1.geometry.model_points import ModelPoints
from colmap_av1.geometry.posed_model import PosedModel, reprojection_errors
from colmap_av1.geometry.track_points import tracks_of_points
from colmap_av1.matching.pairs import covisible_pairs, image_keypoints
from colmap_av1.poses.remapping import RemappedResult
from colmap_av1.reconstruct import reconstruct

NUM_IMAGES = 30


def model(shift: float = 0.0) -> PosedModel:
    """A camera that moves along x in front of points, whose observations are shifted in x."""
    rng = np.random.default_rng(0)
    xyz = rng.uniform([-2, -1, 4], [5, 1, 6], (400, 3))
    camera = pycolmap.Camera(
        camera_id=1, model="PINHOLE", width=640, height=480, params=[500, 500, 320, 240]
    )
    images, image, point, xy = [], [], [], []
    for i in range(NUM_IMAGES):
        pose = np.hstack([np.eye(3), [[-0.1 * i], [0], [0]]])
        images.append(ModelImage(i + 1, f"{i:03}.png", 1, pose))
        at = np.asarray(camera.img_from_cam(xyz + pose[:, 3]))
        inside = np.flatnonzero((at >= 0).all(1) & (at < [640, 480]).all(1))
        image.append(np.full(len(inside), i))
        point.append(inside)
        xy.append(at[inside] + [shift, 0])
    order = np.lexsort((np.concatenate(image), np.concatenate(point)))
    counts = np.bincount(np.concatenate(point), minlength=len(xyz))
    points = ModelPoints(
        xyz=xyz,
        rgb=np.zeros((len(xyz), 3), np.uint8),
        error=np.zeros(len(xyz)),
        offsets=np.concatenate([[0], np.cumsum(counts)]),
        image=np.concatenate(image)[order],
        xy=np.concatenate(xy)[order],
    )
    return PosedModel({1: camera}, images, points)


def test_reprojection_errors_are_in_pixels() -> None:
    assert np.allclose(reprojection_errors(model()), 0)
    assert np.allclose(reprojection_errors(model(shift=3.0)), 3)


def test_points_behind_a_camera_have_infinite_error() -> None:
    own = model()
    own.points.xyz[:, 2] *= -1
    assert np.isinf(reprojection_errors(own)).all()


def test_covisible_images_are_paired() -> None:
    frames = np.arange(NUM_IMAGES, dtype=np.int32)
    tracks = tracks_of_points(model().points, frames, NUM_IMAGES, (640, 480))
    keypoints = image_keypoints(tracks, frames.tolist())
    seen = [set(own.track.tolist()) for own in keypoints]
    pairs = covisible_pairs(keypoints, 15)
    expected = {
        (i, j)
        for i in range(NUM_IMAGES)
        for j in range(i + 1, NUM_IMAGES)
        if len(seen[i] & seen[j]) >= 15
    }
    assert {tuple(pair) for pair in pairs.tolist()} == expected


def test_second_mapping_is_used_if_it_fits_at_least_as_well() -> None:
    def result(
        kept: float, new_cost: float, *, share: float = 1.0, from_initial: bool = False
    ) -> RemappedResult:
        return RemappedResult(
            "", 3, "global", (), share, kept, 1.0, new_cost, from_initial=from_initial
        )

    assert result(kept=0.97, new_cost=0.8).fits(0.9)
    assert result(kept=0.97, new_cost=1.0).fits(0.9)
    assert not result(kept=0.97, new_cost=1.1).fits(0.9)
    assert not result(kept=0.5, new_cost=0.1).fits(0.9)
    assert result(kept=0.5, new_cost=0.1).fits(0.3)
    assert not result(kept=0.97, new_cost=0.1, share=0.2).fits(0.9)
    assert not result(kept=0.97, new_cost=1.0, from_initial=True).fits(0.9)
    assert result(kept=0.97, new_cost=0.9, from_initial=True).fits(0.9)


@pytest.mark.slow
@pytest.mark.shared
def test_wrong_long_focal_length_is_replaced(shared: Path, ffmpeg: Ffmpeg, tmp_path: Path) -> None:
    """The first mapping of this clip of a narrow field of view gives six times the true one."""
    clip, video = shared / "sequences" / "kitchen_long" / "clip.av1.mp4", tmp_path / "clip.mp4"
    middle = "select=between(n\\,200\\,320),crop=320:240,setpts=N/30/TB"
    ffmpeg("-i", clip, "-vf", middle, "-r", "30", "-c:v", "libx264", "-crf", "18", video)
    report = reconstruct(video, tmp_path / "out")
    assert report.focal_lengths == pytest.approx((517, 517), rel=0.25)

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from synthetic_scene import CAMERA_PARAMS, make_scene
from walking_camera import FOCAL, HEIGHT, NUM_FRAMES, WIDTH, seen_by, walk

from colmap_av1.geometry.cameras import make_camera
from colmap_av1.matching.cameras import shared_focal_length
from colmap_av1.matching.matched_images import PairedImages, pair_by_tracks, verify_images
from colmap_av1.matching.pairs import schedule_pairs
from colmap_av1.options import CameraOptions, PairOptions, VerifyOptions
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.progress import Progress, no_progress
from colmap_av1.util.run_context import RunContext

CONTEXT = RunContext()
KNOWN = CameraOptions("SIMPLE_RADIAL", CAMERA_PARAMS)


def paired(
    tracks: Tracks, options: PairOptions = PairOptions(), progress: Progress = no_progress
) -> PairedImages:
    frames = np.arange(tracks.num_frames, dtype=np.int32)
    return pair_by_tracks(tracks, frames, partial(schedule_pairs, options=options), progress)


def approach() -> Tracks:
    """Tracks of a camera that moves along its optical axis."""
    ahead = np.zeros((NUM_FRAMES, 3))
    ahead[:, 2] = np.linspace(0, 3, NUM_FRAMES)
    return seen_by(ahead, np.zeros((NUM_FRAMES, 3)))


def test_pairs_match_keypoints_of_the_same_track() -> None:
    tracks = make_scene(num_frames=6).tracks
    steps: list[tuple[str, int, int | None]] = []
    found = paired(tracks, PairOptions(offsets=(1,), growth=1.0), lambda *step: steps.append(step))
    assert found.pairs.tolist() == [[i, i + 1] for i in range(5)]
    assert steps[-1] == ("pairs", 5, 5)
    for (i, j), matches in zip(found.pairs, found.matches, strict=True):
        a, b = (found.keypoints[k].track[matches[:, s]] for s, k in enumerate((i, j)))
        np.testing.assert_array_equal(a, b)


def test_focal_length_is_estimated_unless_given() -> None:
    images = paired(walk())

    def found(camera: CameraOptions) -> float | None:
        return shared_focal_length(images, (WIDTH, HEIGHT), 1.0, camera, CONTEXT)

    assert found(CameraOptions()) == pytest.approx(FOCAL, rel=0.1)
    assert found(CameraOptions("PINHOLE")) == found(CameraOptions())
    assert found(KNOWN) is None
    assert found(CameraOptions("OPENCV_FISHEYE")) is None


@pytest.mark.parametrize("intrinsics", [KNOWN, CameraOptions()])
def test_forward_motion_is_detected(intrinsics: CameraOptions) -> None:
    aside, ahead = paired(make_scene(num_frames=8).tracks), paired(approach())

    def is_forward(images: PairedImages) -> bool:
        cameras = [make_camera(intrinsics, WIDTH, HEIGHT)] * len(images.keypoints)
        return verify_images(images, cameras, VerifyOptions(), CONTEXT).forward_motion

    assert is_forward(ahead)
    assert not is_forward(aside)

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from synthetic_scene import CAMERA_PARAMS, make_scene
from walking_camera import FOCAL, HEIGHT, NUM_FRAMES, WIDTH, seen_by, walk

from colmap_av1.errors import VideoError
from colmap_av1.geometry.cameras import make_camera
from colmap_av1.images.choosing import ChosenImages
from colmap_av1.matching.image_matches import (
    PairedImages,
    pair_images,
    shared_focal_length,
    verify_images,
)
from colmap_av1.options import CameraOptions, MatchOptions, PairOptions, TrackOptions
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.progress import Clock, no_progress

OPTIONS = MatchOptions()
KNOWN = CameraOptions("SIMPLE_RADIAL", CAMERA_PARAMS)


def every_frame(tracks: Tracks) -> ChosenImages:
    frames = np.arange(tracks.num_frames, dtype=np.int32)
    return ChosenImages([f"{i}.png" for i in frames], frames)


def paired(tracks: Tracks, options: MatchOptions = OPTIONS) -> PairedImages:
    chosen = every_frame(tracks)
    return pair_images(
        Path("walk.mp4"), tracks, chosen, options, clock=Clock(), progress=no_progress
    )


def approach() -> Tracks:
    """What a camera sees that moves along its axis."""
    ahead = np.zeros((NUM_FRAMES, 3))
    ahead[:, 2] = np.linspace(0, 3, NUM_FRAMES)
    return seen_by(ahead, np.zeros((NUM_FRAMES, 3)))


def test_pairs_are_told_as_they_are_matched() -> None:
    tracks = make_scene(num_frames=6).tracks
    told: list[tuple[str, int, int | None]] = []
    clock = Clock()
    found = pair_images(
        Path("walk.mp4"),
        tracks,
        every_frame(tracks),
        replace(OPTIONS, pairs=PairOptions(offsets=(1,), growth=1.0)),
        clock=clock,
        progress=lambda *words: told.append(words),
    )
    assert found.pairs.tolist() == [[i, i + 1] for i in range(5)]
    assert told == [("pairs", i, 5) for i in range(1, 6)]
    assert list(clock.seconds) == ["pairs"]
    for (i, j), matches in zip(found.pairs, found.matches, strict=True):
        a, b = (found.keypoints[k].track[matches[:, s]] for s, k in enumerate((i, j)))
        np.testing.assert_array_equal(a, b)


def test_too_little_to_match_says_what_to_do() -> None:
    tracks = make_scene(num_frames=5).tracks
    longer = replace(OPTIONS, tracks=TrackOptions(min_length=6))
    with pytest.raises(VideoError, match=r"walk\.mp4: tracks are of 6 frames or more, .* has 5"):
        paired(tracks, longer)
    many = replace(OPTIONS, pairs=PairOptions(min_matches=10**4))
    with pytest.raises(VideoError, match=r"no two images share 10000 tracks, .* --reencode 1"):
        paired(tracks, many)


def test_a_focal_length_is_looked_for_where_none_is_given() -> None:
    images = paired(walk())

    def found(camera: CameraOptions) -> float | None:
        options = replace(OPTIONS, camera=camera)
        return shared_focal_length(images, (WIDTH, HEIGHT), 1.0, options, clock=Clock())

    assert found(CameraOptions()) == pytest.approx(FOCAL, rel=0.1)
    assert found(CameraOptions("PINHOLE")) == found(CameraOptions())
    assert found(KNOWN) is None
    assert found(CameraOptions("OPENCV_FISHEYE")) is None


def test_forward_motion_is_told_by_pairs_with_known_intrinsics() -> None:
    aside, ahead = paired(make_scene(num_frames=8).tracks), paired(approach())

    def is_forward(images: PairedImages, camera: CameraOptions) -> bool:
        return verify_images(
            images,
            make_camera(camera, WIDTH, HEIGHT),
            OPTIONS,
            clock=Clock(),
            progress=no_progress,
        ).forward_motion

    assert is_forward(ahead, KNOWN)
    assert not is_forward(aside, KNOWN)
    assert not is_forward(ahead, CameraOptions())

"""Detection of matches that do not determine depth, and how the commands report it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from synthetic_scene import FOCAL, HEIGHT, WIDTH, Scene, make_scene

from colmap_av1.check.database import check_database
from colmap_av1.cli import main
from colmap_av1.errors import DatabaseError, ModelError
from colmap_av1.map import map_database
from colmap_av1.match import match
from colmap_av1.matching.depth import DepthEvidence, depth_evidence, motion_spread
from colmap_av1.matching.pairs import image_keypoints, pair_matches, schedule_pairs
from colmap_av1.options import ImageOptions, MatchOptions, PairOptions, ReconstructOptions
from colmap_av1.reconstruct import reconstruct

OPTIONS = MatchOptions(images=ImageOptions(every=3))


def zoomed(scene: Scene, most: float) -> Scene:
    """The scene seen by a lens that zooms steadily."""
    tracks = scene.tracks
    centre = np.array([WIDTH / 2, HEIGHT / 2])
    zoom = 1 + (most - 1) * tracks.frame[:, None] / tracks.num_frames
    xy = (centre + zoom * (tracks.xy - centre)).astype(np.float32)
    return replace(scene, tracks=replace(tracks, xy=xy))


def evidence(scene: Scene, focal_length: float = FOCAL) -> DepthEvidence:
    keypoints = image_keypoints(scene.tracks, range(scene.tracks.num_frames))
    pairs = schedule_pairs(keypoints, PairOptions())
    matches = [pair_matches(keypoints[i], keypoints[j]) for i, j in pairs]
    xy = [own.xy for own in keypoints]
    spread = [
        motion_spread(xy[i][rows[:, 0]], xy[j][rows[:, 1]])
        for (i, j), rows in zip(pairs.tolist(), matches, strict=True)
    ]
    camera = pycolmap.Camera(
        model="SIMPLE_PINHOLE",
        width=WIDTH,
        height=HEIGHT,
        params=[focal_length, WIDTH / 2, HEIGHT / 2],
    )
    return depth_evidence(
        xy, pairs, np.array(spread), matches.__getitem__, [camera] * len(keypoints)
    )


@pytest.mark.parametrize("focal_length", [300.0, FOCAL, 2000.0])
def test_depth_is_not_observable_if_the_camera_only_turns_or_zooms(focal_length: float) -> None:
    """The assumed focal length does not matter."""
    turning = make_scene(turning=True, arc_degrees=120)
    for scene in (turning, zoomed(turning, 0.5), zoomed(make_scene(arc_degrees=0.2), 2.0)):
        found = evidence(scene, focal_length)
        assert found.num_pairs > 8
        assert not found.is_observable
        assert found.warning is not None


@pytest.mark.parametrize("flat", [False, True])
@pytest.mark.parametrize("zoom", [1.0, 1.5])
def test_depth_is_observable_if_the_camera_moves(flat: bool, zoom: float) -> None:
    found = evidence(zoomed(make_scene(flat=flat), zoom))
    assert found.num_with_parallax > 8
    assert found.is_observable
    assert found.warning is None


def test_depth_warning_if_the_camera_moves_only_at_the_end() -> None:
    found = DepthEvidence(num_pairs=40, num_with_parallax=14, is_focal_length_known=True)
    assert found.is_observable
    assert found.warning is not None


@pytest.mark.parametrize(
    ("num_pairs", "num_with_parallax", "is_observable", "is_if_known"),
    [
        (36, 8, True, True),
        (39, 5, False, True),
        (17, 4, False, True),
        (35, 3, False, False),
        (0, 0, True, True),
    ],
)
def test_depth_is_observable_if_more_pairs_have_parallax_than_in_a_zoom(
    num_pairs: int, num_with_parallax: int, is_observable: bool, is_if_known: bool
) -> None:
    """Few pairs with parallax are enough, but not if they may be chance.

    Fewer are enough if the focal length is known.
    """
    for is_known, expected in ((False, is_observable), (True, is_if_known)):
        assert DepthEvidence(num_pairs, num_with_parallax, is_known).is_observable == expected


@pytest.mark.shared
def test_every_command_reports_that_depth_is_not_observable(
    shared: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    video, database = shared / "cases" / "zoom.mjpeg", tmp_path / "zoom.db"
    report = match(database, video, image_path=tmp_path / "images", options=OPTIONS)
    (warning,) = [text for text in report.warnings if "depth is not observable" in text]
    assert report.estimate is None
    assert warning in [f.text for f in check_database(database).findings if f.severity == "error"]
    with pytest.raises(DatabaseError, match="depth"):
        map_database(database, tmp_path / "images", tmp_path / "model")
    assert not (tmp_path / "model").exists()
    output = tmp_path / "out"
    words = ["reconstruct", "--video", str(video), "--output", str(output), "--every", "3"]
    assert main(words) == 2
    assert "depth is not observable" in capsys.readouterr().err.splitlines()[-1]
    assert not (output / "sparse").exists()
    with pytest.raises(ModelError, match="depth"):
        reconstruct(video, output, options=ReconstructOptions(match=OPTIONS))

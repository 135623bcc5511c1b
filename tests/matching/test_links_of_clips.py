"""SIFT links in recorded clips: with an overlay, a cut, and a camera too fast for motion."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from conftest import QUICK_AV1, Encode, Ffmpeg
from numpy.typing import NDArray

from colmap_av1.check.database import check_database
from colmap_av1.match import match
from colmap_av1.options import LinkOptions, MatchOptions
from colmap_av1.video.decoding import decode_frames

# Enough for these frames; the time grows with the square of this number.
FEWER_FEATURES = MatchOptions(links=LinkOptions(max_link_features=600))


def pictures(video: Path) -> list[NDArray[np.uint8]]:
    return [image for _, image in decode_frames(video)]


@pytest.mark.slow
@pytest.mark.shared
def test_overlay_text_causes_no_loop_closures(shared: Path, encode: Encode, tmp_path: Path) -> None:
    """A recorded drone display is the same in all frames; it would link 90 pairs."""
    left_out = {*range(29, 39), *range(56, 66)}
    clip = pictures(shared / "sequences" / "log_building" / "clip.mp4")
    frames = np.array([clip[i] for i in range(17, 76) if i not in left_out])
    lines = {28: "DJI MINI 4 PRO  H 34.2m", 56: "D 112m HS 4.1 VS 0.0", 84: "REC 4K30 HDR 1/400"}
    lines |= {742: "(c) Skyview Films GmbH", 770: "2026-05-11 ISO100 EV-0.3"}
    for frame in frames:
        for y, line in lines.items():
            cv2.putText(frame, line, (14, y), cv2.FONT_HERSHEY_SIMPLEX, 0.75, (255, 255, 255), 2)
    display = encode(frames, tmp_path / "display.mp4")
    report = match(tmp_path / "a.db", display, options=FEWER_FEATURES)
    assert report.links.frames_of_gaps() == [(11, 12), (28, 29)]
    assert report.links.num_links > 20
    assert report.links.num_loop_closures < 25


def test_calm_video_needs_no_decoded_pictures(shared: Path, tmp_path: Path) -> None:
    """Gaps are judged by all tracks; the selected tracks include too few long ones."""
    report = match(tmp_path / "a.db", shared / "sequences" / "log_building" / "clip.mp4")
    assert report.links.num_images == 0
    assert report.links.fast == ()


@pytest.mark.slow
@pytest.mark.shared
def test_cut_to_a_known_place_is_linked_with_few_features(
    shared: Path, encode: Encode, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The two images at the cut show nothing in common, but other images do."""
    monkeypatch.delattr("colmap_av1.matching.links.link_images.thorough_plan")
    clip = pictures(shared / "sequences" / "log_building" / "clip.mp4")
    cut = encode(
        np.array([*clip[66:], *clip[6:30], *clip[46:60]]), tmp_path / "cut.mp4", *QUICK_AV1
    )
    report = match(tmp_path / "a.db", cut, options=FEWER_FEATURES)
    assert report.links.frames_of_gaps() == [(18, 19), (42, 43)]
    assert report.links.frames_of_gaps("contradicted") == [(18, 19), (42, 43)]
    assert report.links.frames_of_gaps("no overlap") == []
    assert report.links.num_loop_closures >= 2
    assert check_database(tmp_path / "a.db").num_connected_images == 57


@pytest.mark.slow
@pytest.mark.shared
def test_camera_too_fast_for_motion_is_linked(shared: Path, ffmpeg: Ffmpeg, tmp_path: Path) -> None:
    """Drone frames move by 85 px each, so the encoder finds almost no motion."""
    clip = shared / "sequences" / "drone_park" / "clip.mp4"
    video = ffmpeg("-i", clip, "-frames:v", "16", "-c", "copy", tmp_path / "video.mp4")
    report = match(tmp_path / "a.db", video)
    assert report.links.frames_of_gaps("no overlap") == []
    assert len(report.links.gaps) == 15
    assert len(report.links.frames_of_gaps("contradicted")) > 12
    assert check_database(tmp_path / "a.db").num_connected_images == 16
    # The focal length is unknown and the ground is flat.
    options = pycolmap.IncrementalPipelineOptions(random_seed=0, extract_colors=False)
    models = pycolmap.incremental_mapping(tmp_path / "a.db", tmp_path, tmp_path / "model", options)
    assert models[0].num_reg_images() == 16

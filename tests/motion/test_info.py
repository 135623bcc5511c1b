from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import AV1, Encode, Ffmpeg, make_frames

from colmap_av1.motion.info import read_info


def test_good_stream_is_reported_as_good(clip: Path) -> None:
    report = read_info(clip)
    assert report.good
    assert (report.width, report.height, report.display.rotation) == (192, 128, 0)
    assert (report.num_shown, report.num_coded, report.num_intra_frames) == (16, 16, 1)
    assert report.inter_share > 0.6
    assert report.reference_distances[-1] > 0.5
    assert sum(report.reference_distances.values()) == pytest.approx(1)
    assert 2 <= report.median_motion <= 4
    size = clip.stat().st_size
    assert 0.9 * size < report.bytes_per_frame * 16 < size
    assert report.bits_per_pixel == pytest.approx(report.bytes_per_frame * 8 / (192 * 128))


def test_pyramid_references_the_future(encode: Encode, tmp_path: Path) -> None:
    how = ["-c:v", "libaom-av1", "-cpu-used", "8", "-lag-in-frames", "19", "-crf", "20"]
    report = read_info(encode(make_frames(20), tmp_path / "pyramid.mp4", *how))
    assert report.num_shown == 20
    assert max(report.reference_distances) > 0
    assert sum(report.reference_distances.values()) + report.hidden_reference_share == (
        pytest.approx(1)
    )


def test_rotation_is_reported(clip: Path, ffmpeg: Ffmpeg, tmp_path: Path) -> None:
    turned = ffmpeg("-display_rotation", "90", "-i", clip, "-c", "copy", tmp_path / "turned.mp4")
    assert read_info(turned).display.rotation == 90


@pytest.mark.parametrize(
    ("frames", "how", "reason"),
    [
        (make_frames(6), [*AV1[:-1], "1"], "intra"),
        (make_frames(12), [*AV1[:-1], "3"], "3.0 frames"),
        (make_frames(2), AV1, "2 frames"),
        (np.repeat(make_frames(1), 12, axis=0), AV1, "moves"),
        (np.array([cv2.blur(f, (31, 31)) for f in make_frames(12)]), AV1, "rate"),
    ],
    ids=["intra", "key frames", "short", "still", "low rate"],
)
def test_poor_streams_are_reported_with_a_reason(
    encode: Encode, tmp_path: Path, frames: np.ndarray, how: list[str], reason: str
) -> None:
    if reason == "rate":
        how = ["63" if word == "20" else word for word in how]
    report = read_info(encode(frames, tmp_path / "poor.mp4", *how))
    assert not report.good
    assert any(reason in r for r in report.reasons), report.reasons


def test_repeated_frames_do_not_make_a_stream_poor(encode: Encode, tmp_path: Path) -> None:
    """Frames repeat after a conversion to a higher frame rate, or when a camera pauses."""
    frames = make_frames(16)
    for number, repeats in enumerate(
        (np.repeat(frames, 2, axis=0), frames[[*range(12), *[11] * 14]])
    ):
        report = read_info(encode(repeats, tmp_path / f"{number}.mp4", *AV1))
        assert report.median_motion < 0.1
        assert report.good, report.reasons


def test_fast_turns_are_reported(encode: Encode, tmp_path: Path) -> None:
    """In a fifth of the frames the picture moves by a tenth of its width."""
    steps = np.where(np.arange(40) % 20 < 4, 20, 2)
    rng = np.random.default_rng(0)
    wall = cv2.GaussianBlur(rng.integers(0, 255, (128, 1000), np.uint8), (0, 0), 3)
    wall = cv2.normalize(wall, None, 0, 255, cv2.NORM_MINMAX)
    frames = np.array([wall[:, x : x + 192] for x in np.cumsum(steps)])
    report = read_info(
        encode(np.repeat(frames[..., None], 3, axis=3), tmp_path / "turns.mp4", *AV1)
    )
    assert 0.15 < report.fast_share < 0.25
    assert any("slowly" in reason for reason in report.reasons), report.reasons


def test_change_of_size_is_reported(encode: Encode, tmp_path: Path) -> None:
    frames = make_frames(12)
    one = encode(frames, tmp_path / "one.obu", *AV1)
    other = encode(frames[:, :96, :128].copy(), tmp_path / "other.obu", *AV1)
    both = tmp_path / "both.obu"
    both.write_bytes(one.read_bytes() + other.read_bytes())
    reasons = read_info(both).reasons
    assert any("size" in reason and "12" in reason for reason in reasons), reasons

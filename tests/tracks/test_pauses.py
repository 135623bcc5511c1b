"""Videos whose camera stops for a while, where encoders use their largest blocks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import Ffmpeg

from colmap_av1 import build_tracks, read_motion
from colmap_av1.video.encode import encode

PAUSE = range(12, 42)


@pytest.mark.shared
@pytest.mark.parametrize("noise", [0, 3])
def test_tracks_continue_through_a_pause(
    shared: Path, ffmpeg: Ffmpeg, tmp_path: Path, noise: int
) -> None:
    clip = shared / "sequences" / "ditch" / "clip.mp4"
    filters = f"loop=loop={len(PAUSE) - 1}:size=1:start={PAUSE[0]},noise=alls={noise}:allf=t"
    lossy = ("-frames:v", "54", "-c:v", "libx264", "-preset", "fast", "-crf", "20")
    encode(ffmpeg("-i", clip, "-vf", filters, *lossy, tmp_path / "h.mp4"), tmp_path / "a.mp4")

    tracks = build_tracks(read_motion(tmp_path / "a.mp4"))

    first, last = tracks.frame[tracks.offsets[:-1]], tracks.frame[tracks.offsets[1:] - 1]
    num_seen = np.count_nonzero((first < PAUSE[0]) & (last >= PAUSE[0]))
    num_through = np.count_nonzero((first < PAUSE[0]) & (last > PAUSE[-1]))
    assert num_through > 0.6 * num_seen > 3000

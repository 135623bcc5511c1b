from __future__ import annotations

import os
from pathlib import Path

import pytest
from conftest import Ffmpeg

from colmap_av1.errors import BitstreamError, VideoError
from colmap_av1.motion.info import inspect
from colmap_av1.video.container import packets, read_file
from colmap_av1.video.facts import frame_times, read_video, with_counted_packets
from colmap_av1.video.unchanged import check_unchanged


def test_what_was_read_is_not_read_again(clip: Path, tmp_path: Path) -> None:
    video = tmp_path / "v.mp4"
    video.write_bytes(clip.read_bytes())
    read, file = read_video(video), read_file(video)
    video.unlink()
    assert read_video(read) is read_file(read) is read
    assert read_file(file) is file
    assert vars(file).items() <= vars(read).items()
    with pytest.raises(VideoError, match="no such file"):
        read_video(file)  # which has no picture


def test_a_video_stands_for_its_path(clip: Path) -> None:
    video = read_video(clip)
    assert Path(video) == clip
    assert str(video) == str(clip)
    assert inspect(video) == inspect(str(clip))
    times = frame_times(video)
    assert times is not None
    assert times.tolist() == [p.pts for p in packets(video)]


def test_a_video_is_as_it_was_when_opened(clip: Path, tmp_path: Path) -> None:
    path = tmp_path / "v.mp4"
    path.write_bytes(clip.read_bytes())
    video = read_video(path)
    check_unchanged(video.state)
    os.utime(path, ns=(0, 0))
    with pytest.raises(VideoError, match=r"v\.mp4: changed or disappeared"):
        check_unchanged(video.state, read_video(path).state)


@pytest.mark.parametrize("ending", ["mp4", "mkv", "ivf", "obu"])
def test_packets_are_counted_where_the_container_does_not(
    clip: Path, ffmpeg: Ffmpeg, tmp_path: Path, ending: str
) -> None:
    file = read_file(ffmpeg("-i", clip, "-c", "copy", tmp_path / f"v.{ending}"))
    assert file.num_packets in ((16,) if ending == "mp4" else (16, None))
    counted = with_counted_packets(file)
    assert counted.num_packets == counted.likely_num_packets == 16
    assert file.likely_num_packets == (None if ending == "obu" else 16)
    assert with_counted_packets(counted) is counted


def test_a_container_without_a_picture(clip: Path, ffmpeg: Ffmpeg, tmp_path: Path) -> None:
    whole = ffmpeg("-i", clip, "-c", "copy", "-movflags", "+faststart", tmp_path / "whole.mp4")
    head, mdat, data = whole.read_bytes().partition(b"mdat")
    hurt = tmp_path / "hurt.mp4"
    hurt.write_bytes(head + mdat + bytes(len(data)))
    assert read_file(hurt).stored_size == (192, 128)
    with pytest.raises(BitstreamError, match=r"hurt\.mp4: .* decoded"):
        read_video(hurt)

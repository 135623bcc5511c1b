from __future__ import annotations

import os
from pathlib import Path

import pytest
from conftest import Ffmpeg

from colmap_av1 import match
from colmap_av1.errors import BitstreamError, OptionError, VideoError
from colmap_av1.motion.info import read_info
from colmap_av1.options import CameraOptions, ImageOptions, MatchOptions
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
    assert read_info(video) == read_info(str(clip))
    times = frame_times(video)
    assert times is not None
    assert times.tolist() == [p.pts for p in packets(video)]


@pytest.mark.parametrize("said", [0, 1, 0xFFFFFFF0])
def test_a_container_that_lies_about_its_duration(clip: Path, tmp_path: Path, said: int) -> None:
    data = bytearray(clip.read_bytes())
    for box in (b"mvhd", b"mdhd", b"tkhd"):
        at = data.index(box) + 4 + (20 if box == b"tkhd" else 16)  # ISO/IEC 14496-12, version 0
        data[at : at + 4] = said.to_bytes(4, "big")
    path = tmp_path / "lies.mp4"
    path.write_bytes(data)
    true, lies = (frame_times(read_video(own)) for own in (clip, path))
    assert true is not None
    assert lies is not None
    assert lies.tolist() == true.tolist()
    assert read_info(path).num_shown == read_info(clip).num_shown == 16


def with_long(path: Path, data: bytes, box: bytes, offset: int, value: int) -> Path:
    """Write a file in which the number of 4 bytes at an offset in a box's content is another."""
    at = data.index(box) + 4 + offset
    path.write_bytes(data[:at] + value.to_bytes(4, "big") + data[at + 4 :])
    return path


@pytest.mark.parametrize("scale", [0, 0xFFFFFFFF])
def test_a_container_whose_time_scale_cannot_be(clip: Path, tmp_path: Path, scale: int) -> None:
    path = with_long(tmp_path / "lies.mp4", clip.read_bytes(), b"mdhd", 12, scale)
    with pytest.warns(UserWarning, match="time scale"):
        told = read_info(path)
    assert (told.num_shown, told.num_cut, told.frame_rate) == (16, 0, None)
    assert frame_times(read_video(path)) is None
    true, lies = match(tmp_path / "a.db", clip), match(tmp_path / "b.db", path)
    assert (lies.num_frames, lies.num_matches) == (true.num_frames, true.num_matches)
    assert [w for w in lies.warnings if w not in true.warnings] == [read_video(path).doubtful_times]
    by_fps = MatchOptions(images=ImageOptions(fps=5.0))
    with pytest.raises(OptionError, match="time"):
        match(tmp_path / "c.db", path, options=by_fps)
    by_time = MatchOptions(camera=CameraOptions(rolling_shutter="20"))
    with pytest.raises(OptionError, match=r"lies\.mp4"):
        match(tmp_path / "d.db", path, options=by_time)
    assert not (tmp_path / "c.db").exists()
    assert not (tmp_path / "d.db").exists()


@pytest.mark.parametrize(("offset", "value"), [(8, 0), (12, 0x7FFFFF00)])
def test_an_edit_list_that_shows_nothing(
    clip: Path, tmp_path: Path, offset: int, value: int
) -> None:
    """Of no length, or from a time on at which the video is over."""
    path = with_long(tmp_path / "lies.mp4", clip.read_bytes(), b"elst", offset, value)
    with pytest.warns(UserWarning, match="edit list"):
        told = read_info(path)
    assert (told.num_shown, told.num_cut, told.frame_rate) == (16, 0, 25.0)
    true, lies = match(tmp_path / "a.db", clip), match(tmp_path / "b.db", path)
    assert (lies.num_frames, lies.num_matches) == (true.num_frames, true.num_matches)
    assert read_video(path).doubtful_times in lies.warnings


@pytest.mark.parametrize("box", [b"stco", b"stsz"])
def test_a_sample_table_that_points_elsewhere(clip: Path, tmp_path: Path, box: bytes) -> None:
    path = with_long(tmp_path / "lies.mp4", clip.read_bytes(), box, 8 if box == b"stco" else 12, 0)
    with pytest.raises(BitstreamError, match=r"lies\.mp4"):
        read_info(path)
    with pytest.raises(BitstreamError, match=r"lies\.mp4"):
        match(tmp_path / "a.db", path)
    assert not (tmp_path / "a.db").exists()


@pytest.mark.parametrize("rate", ["0.025", "100000"])
def test_a_container_that_lies_about_its_rate(
    clip: Path, ffmpeg: Ffmpeg, tmp_path: Path, rate: str
) -> None:
    scale = str(25 / float(rate))
    path = ffmpeg("-itsscale", scale, "-i", clip, "-c", "copy", tmp_path / "lies.mp4")
    assert read_info(path).num_shown == 16
    true, lies = match(tmp_path / "a.db", clip), match(tmp_path / "b.db", path)
    assert (lies.num_frames, lies.num_matches) == (true.num_frames, true.num_matches)


def test_a_video_is_as_it_was_when_opened(clip: Path, tmp_path: Path) -> None:
    path = tmp_path / "v.mp4"
    path.write_bytes(clip.read_bytes())
    video = read_video(path)
    check_unchanged(video.state)
    os.utime(path, ns=(0, 0))
    with pytest.raises(VideoError, match="changed"):
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
    with pytest.raises(BitstreamError, match=r"hurt\.mp4"):
        read_video(hurt)

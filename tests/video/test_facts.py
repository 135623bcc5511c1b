from __future__ import annotations

import os
import struct
from pathlib import Path

import numpy as np
import pytest
from conftest import Ffmpeg
from ivf_files import frame_headers, ivf_of, packets

from colmap_av1 import _core, match
from colmap_av1.errors import BitstreamError, OptionError, VideoError
from colmap_av1.motion.info import read_info
from colmap_av1.motion.reading import frame_times
from colmap_av1.options import CameraOptions, ImageOptions, MatchOptions
from colmap_av1.video.container import read_file
from colmap_av1.video.facts import counted, picture_times, read_video
from colmap_av1.video.unchanged import check_unchanged


def test_facts_are_read_once(clip: Path, tmp_path: Path) -> None:
    video = tmp_path / "v.mp4"
    video.write_bytes(clip.read_bytes())
    read, file = read_video(video), read_file(video)
    video.unlink()
    assert read_video(read) is read_file(read) is read
    assert read_file(file) is file
    assert vars(file).items() <= vars(read).items()
    with pytest.raises(VideoError, match="no such file"):
        read_video(file)  # which has no picture


def test_video_can_be_used_as_a_path(clip: Path) -> None:
    video = read_video(clip)
    assert Path(video) == clip
    assert str(video) == str(clip)
    assert read_info(video) == read_info(str(clip))
    times = frame_times(video)
    assert times is not None
    assert times.tolist() == [p.pts for p in packets(video)]


@pytest.mark.parametrize("duration", [0, 1, 0xFFFFFFF0])
def test_wrong_duration_in_the_container_does_not_matter(
    clip: Path, tmp_path: Path, duration: int
) -> None:
    data = bytearray(clip.read_bytes())
    for box in (b"mvhd", b"mdhd", b"tkhd"):
        at = data.index(box) + 4 + (20 if box == b"tkhd" else 16)  # ISO/IEC 14496-12, version 0
        data[at : at + 4] = duration.to_bytes(4, "big")
    path = tmp_path / "lies.mp4"
    path.write_bytes(data)
    true, lies = (frame_times(read_video(own)) for own in (clip, path))
    assert true is not None
    assert lies is not None
    assert lies.tolist() == true.tolist()
    assert read_info(path).num_shown == read_info(clip).num_shown == 16


def with_long(path: Path, data: bytes, box: bytes, offset: int, value: int) -> Path:
    """Write a file with another 4-byte number at an offset in the content of a box."""
    at = data.index(box) + 4 + offset
    path.write_bytes(data[:at] + value.to_bytes(4, "big") + data[at + 4 :])
    return path


@pytest.mark.parametrize("scale", [0, 0xFFFFFFFF])
def test_invalid_time_scale_is_reported(clip: Path, tmp_path: Path, scale: int) -> None:
    path = with_long(tmp_path / "lies.mp4", clip.read_bytes(), b"mdhd", 12, scale)
    with pytest.warns(UserWarning, match="time scale"):
        info = read_info(path)
    assert (info.num_shown, info.num_cut, info.frame_rate) == (16, 0, None)
    assert frame_times(path) is picture_times(read_video(path)) is None
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
def test_edit_list_that_shows_no_frame_is_ignored(
    clip: Path, tmp_path: Path, offset: int, value: int
) -> None:
    """The edit has no duration, or starts after the end of the video."""
    path = with_long(tmp_path / "lies.mp4", clip.read_bytes(), b"elst", offset, value)
    with pytest.warns(UserWarning, match="edit list"):
        info = read_info(path)
    assert (info.num_shown, info.num_cut, info.frame_rate) == (16, 0, 25.0)
    true, lies = match(tmp_path / "a.db", clip), match(tmp_path / "b.db", path)
    assert (lies.num_frames, lies.num_matches) == (true.num_frames, true.num_matches)
    assert read_video(path).doubtful_times in lies.warnings


@pytest.mark.parametrize("box", [b"stco", b"stsz"])
def test_invalid_sample_table_is_an_error(clip: Path, tmp_path: Path, box: bytes) -> None:
    path = with_long(tmp_path / "lies.mp4", clip.read_bytes(), box, 8 if box == b"stco" else 12, 0)
    with pytest.raises(BitstreamError, match=r"lies\.mp4"):
        read_info(path)
    with pytest.raises(BitstreamError, match=r"lies\.mp4"):
        match(tmp_path / "a.db", path)
    assert not (tmp_path / "a.db").exists()


@pytest.mark.parametrize("rate", ["0.025", "100000"])
def test_implausible_frame_rate_does_not_matter(
    clip: Path, ffmpeg: Ffmpeg, tmp_path: Path, rate: str
) -> None:
    scale = str(25 / float(rate))
    path = ffmpeg("-itsscale", scale, "-i", clip, "-c", "copy", tmp_path / "lies.mp4")
    assert read_info(path).num_shown == 16
    true, lies = match(tmp_path / "a.db", clip), match(tmp_path / "b.db", path)
    assert (lies.num_frames, lies.num_matches) == (true.num_frames, true.num_matches)


def test_change_after_opening_is_detected(clip: Path, tmp_path: Path) -> None:
    path = tmp_path / "v.mp4"
    path.write_bytes(clip.read_bytes())
    video = read_video(path)
    check_unchanged(video.state)
    os.utime(path, ns=(0, 0))
    with pytest.raises(VideoError, match="changed"):
        check_unchanged(video.state, read_video(path).state)


def test_frames_have_the_times_of_the_packets_that_show_them(
    clip: Path, ffmpeg: Ffmpeg, tmp_path: Path
) -> None:
    """Hidden frames may be packets of their own."""
    words = ("-c:v", "libaom-av1", "-cpu-used", "8", "-lag-in-frames", "19", "-g", "99")
    data = ivf_of(ffmpeg("-i", clip, *words, tmp_path / "hidden.mp4"))
    units, shown = list[bytes](), list[int]()
    parser = _core.Parser(headers_only=True)
    for at, _ in frame_headers(data):
        unit = data[at + 12 : at + 12 + int.from_bytes(data[at : at + 4], "little")]
        start = end = 0
        while end < len(unit):
            event, end = parser.parse(unit, end)
            if event is not None:
                shown += [len(units)] if event.is_shown else []
                units.append(unit[start:end])
                start = end
        assert start == end
    assert len(units) > len(shown) == 16
    body = b"".join(struct.pack("<IQ", len(u), 2 * i) + u for i, u in enumerate(units))
    path = tmp_path / "split.ivf"
    path.write_bytes(data[:32] + body)
    times = frame_times(path)
    assert times is not None
    np.testing.assert_allclose(times, 2 / 25 * np.array(shown))


@pytest.mark.parametrize("length", [b"nan:00:00.", b"inf:00:00."])
def test_length_that_is_not_a_number_is_ignored(
    clip: Path, ffmpeg: Ffmpeg, tmp_path: Path, length: bytes
) -> None:
    path = ffmpeg("-i", clip, "-c", "copy", tmp_path / "lies.mkv")
    data = path.read_bytes()
    assert b"00:00:00." in data
    path.write_bytes(data.replace(b"00:00:00.", length))
    assert read_file(path).likely_num_packets in (None, 16)
    assert read_info(path).num_shown == 16


@pytest.mark.parametrize("ending", ["mp4", "mkv", "ivf", "obu"])
def test_packets_are_counted_if_the_container_gives_no_number(
    clip: Path, ffmpeg: Ffmpeg, tmp_path: Path, ending: str
) -> None:
    file = read_file(ffmpeg("-i", clip, "-c", "copy", tmp_path / f"v.{ending}"))
    assert file.num_packets in ((16,) if ending == "mp4" else (16, None))
    with_count, damage = counted(file)
    assert with_count.num_packets == with_count.likely_num_packets == 16
    assert file.likely_num_packets == (None if ending == "obu" else 16)
    assert damage is None
    assert counted(with_count)[0] is with_count


def test_default_or_largest_stream_is_read(clip: Path, ffmpeg: Ffmpeg, tmp_path: Path) -> None:
    two = [
        "-i",
        clip,
        *["-map", "0:v", "-map", "0:v", "-c:v", "libx264", "-filter:v:0", "scale=96:-2"],
    ]
    for number, size in (("0", (96, 64)), ("1", (192, 128))):
        of_all = ["-disposition:v", "0", f"-disposition:v:{number}", "default"]
        assert read_file(ffmpeg(*two, *of_all, tmp_path / f"{number}.mkv")).stored_size == size
    equal = ffmpeg(*two, "-disposition:v", "default", tmp_path / "equal.mkv")
    assert read_file(equal).stored_size == (192, 128)


def test_container_without_a_decodable_picture(clip: Path, ffmpeg: Ffmpeg, tmp_path: Path) -> None:
    whole = ffmpeg("-i", clip, "-c", "copy", "-movflags", "+faststart", tmp_path / "whole.mp4")
    head, mdat, data = whole.read_bytes().partition(b"mdat")
    hurt = tmp_path / "hurt.mp4"
    hurt.write_bytes(head + mdat + bytes(len(data)))
    assert read_file(hurt).stored_size == (192, 128)
    with pytest.raises(BitstreamError, match=r"hurt\.mp4"):
        read_video(hurt)

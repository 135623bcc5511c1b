from __future__ import annotations

import os
import time
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import AV1, Encode, Ffmpeg, make_frames

from colmap_av1.errors import BitstreamError, EncodeError
from colmap_av1.motion.reading import read_motion
from colmap_av1.options import MatchOptions, ReadOptions, RefineOptions
from colmap_av1.tracks.tracks import build_tracks
from colmap_av1.tracks.video_tracks import (
    TrackedVideo,
    VideoSource,
    count_frames,
    decodable_frames,
    open_source,
    times_of_frames,
    track_video,
    with_stream_kept,
)
from colmap_av1.util.progress import Clock
from colmap_av1.util.run_context import RunContext
from colmap_av1.video.decoding import decode_frames
from colmap_av1.video.facts import read_video

OPTIONS = MatchOptions()
STRICT = MatchOptions(read=ReadOptions(strict=True))


def opened(video: Path, options: MatchOptions = OPTIONS) -> VideoSource:
    """Open a video that is not converted, so that its stream remains after closing."""
    next_to = video.with_name("a.db")
    with open_source(
        read_video(video), options.source, next_to=next_to, context=RunContext()
    ) as source:
        return source


def tracked(source: VideoSource, options: MatchOptions = OPTIONS) -> TrackedVideo:
    return track_video(source, options.tracking, one_size=False, context=RunContext())


@pytest.fixture(scope="module")
def phone(encode: Encode, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An H.264 clip of 6 frames, 96x64."""
    folder = tmp_path_factory.mktemp("phone")
    return encode(make_frames(6, 96, 64), folder / "phone.mp4", "-c:v", "libx264")


def test_temporary_stream_is_removed_after_reading(phone: Path, tmp_path: Path) -> None:
    next_to, context = tmp_path / "a.db", RunContext()
    with open_source(read_video(phone), OPTIONS.source, next_to=next_to, context=context) as source:
        assert source.pictures.path == phone
        assert source.stream.codec == "av1"
        assert source.stream.path.parent.parent == tmp_path
        assert not source.is_kept
        assert tracked(source).tracks.num_frames == 6
    assert context.clock.seconds["encoding"] > 0
    assert not list(tmp_path.iterdir())
    assert list(phone.parent.iterdir()) == [phone]
    with (
        pytest.raises(RuntimeError),
        open_source(read_video(phone), OPTIONS.source, next_to=next_to, context=context),
    ):
        raise RuntimeError
    assert not list(tmp_path.iterdir())


def test_kept_stream_is_reused(phone: Path, tmp_path: Path) -> None:
    options = with_stream_kept(OPTIONS, tmp_path)
    assert with_stream_kept(options, tmp_path / "other") is options
    source = opened(phone, options)
    assert source.stream.path == tmp_path / "stream.mp4"
    assert source.is_kept
    before = source.stream.state
    assert opened(phone, options).stream.state == before


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_unwritable_folder_suggests_keep_stream(phone: Path, tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with (
        pytest.raises(EncodeError, match="--keep_stream"),
        open_source(
            read_video(phone),
            OPTIONS.source,
            next_to=tmp_path / "a.db",
            context=RunContext(),
        ),
    ):
        pass


@pytest.fixture
def trimmed(clip: Path, ffmpeg: Ffmpeg, tmp_path: Path) -> Path:
    """The clip trimmed by an edit list: the first five frames are coded but not shown."""
    return ffmpeg("-ss", "0.2", "-i", clip, "-c", "copy", tmp_path / "trimmed.mp4")


def test_av1_video_is_not_converted(clip: Path) -> None:
    source = opened(clip)
    assert source.stream is source.pictures
    assert source.stream.path == clip
    assert source.stream.num_packets == 16
    assert source.pictures.presented is None


def test_frames_that_are_not_shown_have_no_tracks(trimmed: Path) -> None:
    source = opened(trimmed)
    assert source.stream.num_packets == 16
    assert source.pictures.presented is not None
    assert source.pictures.presented.tolist() == list(range(5, 16))
    found = tracked(source)
    assert found.num_coded_frames == 16
    assert found.tracks.num_frames == 11
    times = times_of_frames(source, 11, ReadOptions())
    assert times is not None
    np.testing.assert_allclose(np.diff(times), 1 / 25)


def test_frames_of_a_file_that_is_cut_short_are_counted(
    clip: Path, trimmed: Path, ffmpeg: Ffmpeg, tmp_path: Path
) -> None:
    """The container lists all frames, but the file ends after some of them."""
    assert count_frames(opened(trimmed), ReadOptions()) == 11
    short = ffmpeg("-i", clip, "-c", "copy", "-movflags", "faststart", tmp_path / "short.mp4")
    os.truncate(short, short.stat().st_size // 2)
    source = opened(short)
    assert source.stream.num_packets == 16
    count = count_frames(source, ReadOptions())
    assert 1 < count == tracked(source).tracks.num_frames < 16


def test_frame_times_are_given_for_all_frames_or_none(
    clip: Path, ffmpeg: Ffmpeg, tmp_path: Path
) -> None:
    source = opened(clip)
    times = times_of_frames(source, 7, ReadOptions())
    assert times is not None
    np.testing.assert_allclose(times, np.arange(7) / 25)
    assert times_of_frames(source, 17, ReadOptions()) is None
    timeless = ffmpeg("-i", clip, "-c", "copy", tmp_path / "timeless.ivf")
    data = timeless.read_bytes()
    timeless.write_bytes(data[:16] + bytes(8) + data[24:])  # neither rate nor scale
    assert times_of_frames(opened(timeless), 16, ReadOptions()) is None


def test_poor_stream_is_reported_if_it_could_be_reencoded(
    encode: Encode, ffmpeg: Ffmpeg, tmp_path: Path
) -> None:
    """A stream that this package encoded is not reported."""
    often = encode(make_frames(12), tmp_path / "often.mp4", *AV1[:-1], "4")
    source = opened(often)
    (note,) = tracked(source).warnings
    assert "key frame" in note
    assert "--reencode" in note
    video = ffmpeg("-i", often, "-c:v", "libx264", tmp_path / "video.mp4")
    assert tracked(replace(source, pictures=read_video(video))).warnings == ()


def test_overlay_is_reported(encode: Encode, tmp_path: Path) -> None:
    frames = make_frames(12)
    plain = tracked(opened(encode(frames, tmp_path / "plain.mp4")))
    frames[:, 32:96, 48:112] = frames[0, 32:96, 48:112]
    found = tracked(opened(encode(frames, tmp_path / "logo.mp4")))
    assert plain.warnings == ()
    num_before = build_tracks(read_motion(tmp_path / "logo.mp4")).num_tracks
    share = 1 - found.tracks.num_tracks / num_before
    assert share > 0.05
    (note,) = found.warnings
    assert f"{share:.0%}" in note


def test_time_of_a_stage_is_counted_once(clip: Path) -> None:
    clock = Clock()
    lk = replace(OPTIONS, refine=RefineOptions(refine="lk"))
    calls: list[tuple[str, int, int | None]] = []
    start = time.perf_counter()
    for _ in range(2):  # as with two videos
        track_video(
            opened(clip),
            lk.tracking,
            one_size=True,
            context=RunContext(clock, lambda *w: calls.append(w)),
        )
    assert set(clock.seconds) == {"motion", "tracks", "decoding", "refinement"}
    assert min(clock.seconds.values()) > 0
    assert sum(clock.seconds.values()) <= time.perf_counter() - start
    assert ("motion", 16, 16) in calls
    assert calls[-1] == ("refinement", 16, 16)


@pytest.fixture
def hurt(clip: Path, ffmpeg: Ffmpeg, tmp_path: Path) -> Path:
    """The clip, truncated."""
    whole = ffmpeg("-i", clip, "-c", "copy", tmp_path / "whole.ivf")
    cut = tmp_path / "cut.ivf"
    cut.write_bytes(whole.read_bytes()[: int(whole.stat().st_size * 0.7)])
    return cut


def test_decoding_stops_at_the_damage(hurt: Path) -> None:
    with pytest.warns(UserWarning, match=r"cut\.ivf"):
        count = len(list(decodable_frames(read_video(hurt), 16, OPTIONS.reading, use="tested")))
    assert 4 < count < 16
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # the requested frames are intact
        whole = list(decodable_frames(read_video(hurt), count, OPTIONS.reading, use="tested"))
    assert [index for index, _ in whole] == list(range(count))
    with pytest.raises(BitstreamError, match=r"cut\.ivf"):
        list(decodable_frames(read_video(hurt), 16, STRICT.reading, use="tested"))


def test_decodable_frames_are_the_first_frames(clip: Path) -> None:
    asked = list(decodable_frames(read_video(clip), 3, OPTIONS.reading, use="tested"))
    assert [index for index, _ in asked] == [0, 1, 2]
    for (_, picture), (_, whole) in zip(asked, decode_frames(clip), strict=False):
        np.testing.assert_array_equal(picture, whole)

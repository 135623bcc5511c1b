"""Conversion of videos to AV1 streams for matching."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import av
import cv2
import imageio_ffmpeg
import numpy as np
import pytest
from conftest import HANDLE_INTERRUPTS, Encode, Ffmpeg, make_frames

from colmap_av1.cli import main
from colmap_av1.errors import BitstreamError, ColmapAv1Error, EncodeError, OptionError, VideoError
from colmap_av1.match import match
from colmap_av1.motion.info import read_info
from colmap_av1.motion.reading import read_motion
from colmap_av1.options import EncodeOptions, MatchOptions
from colmap_av1.video.decoding import decode_frames
from colmap_av1.video.encode import encode as encode_video
from colmap_av1.video.encode import stream_of
from colmap_av1.video.encoders import ENCODERS, find_encoder
from colmap_av1.video.facts import read_video

TO_A_FILE = ("encode", "--output", "out.mp4")
TO_A_DATABASE = ("match", "--database", "a.db")
H264 = ("-c:v", "libx264", "-g", "6", "-bf", "2")


@pytest.fixture(scope="session")
def phone(encode: Encode, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An H.264 clip of 12 frames, 96x64, with B frames."""
    return encode(make_frames(12, 96, 64), tmp_path_factory.mktemp("phone") / "phone.mp4", *H264)


def times(video: Path) -> list[float]:
    with av.open(str(video)) as container:
        stamps = sorted(float(p.pts * p.time_base) for p in container.demux(video=0) if p.size)
    return [stamp - stamps[0] for stamp in stamps]


@pytest.mark.parametrize("encoder", ["libaom", "svt"])
@pytest.mark.parametrize("ending", ["mp4", "mkv"])
def test_frames_refer_only_to_earlier_frames(
    phone: Path, tmp_path: Path, encoder: str, ending: str
) -> None:
    done: list[tuple[str, int, int | None]] = []
    report = encode_video(
        phone,
        tmp_path / f"out.{ending}",
        options=EncodeOptions(encoder=encoder),
        progress=lambda *step: done.append(step),
    )
    assert report.num_frames == 12
    assert done[0] == ("encoding", 0, 12)
    assert done[-1] == ("encoding", 12, 12)
    frames = list(read_motion(report.output))
    assert [f.display_index for f in frames] == list(range(12))
    assert sum(f.header["frame_type"] == 0 for f in frames) == 1
    for f in frames:
        assert f.ref_display_index[1:].max() < max(f.display_index, 1)
    np.testing.assert_allclose(times(report.output), times(phone), atol=2e-3)
    assert [p.name for p in tmp_path.iterdir()] == [f"out.{ending}"]
    # Good tracks need motion vectors that refer to the previous frame.
    assert read_info(report.output).reference_distances[-1] > 0.6


def test_libaom_speeds_above_8_change_the_stream(phone: Path, tmp_path: Path) -> None:
    """ffmpeg's own option for the speed of libaom ends at 8."""
    streams = []
    for speed in (8, 10):
        options = EncodeOptions(encoder="libaom", speed=speed)
        report = encode_video(phone, tmp_path / f"{speed}.ivf", options=options)
        assert report.num_frames == 12
        streams.append(report.output.read_bytes())
    assert streams[0] != streams[1]
    with pytest.raises(EncodeError, match="libaom"):
        find_encoder(EncodeOptions(encoder="libaom", speed=99))


def test_quick_stream_of_a_turning_camera_can_be_decoded(
    shared: Path, ffmpeg: Ffmpeg, tmp_path: Path
) -> None:
    """libaom writes invalid streams if it updates no costs of symbols and uses warps."""
    clip = shared / "sequences" / "log_building" / "clip.mp4"
    picture = ffmpeg("-i", clip, "-frames:v", "1", tmp_path / "still.png")
    turn = "scale=640:360,rotate='0.3*sin(t*t/8)'"
    turning = ffmpeg(
        *("-loop", "1", "-r", "60", "-i", picture, "-frames:v", "400", "-vf", turn),
        *("-c:v", "ffv1", "-pix_fmt", "yuv420p"),
        tmp_path / "turning.mkv",
    )
    options = EncodeOptions("libaom", effort="quick")
    stream = encode_video(turning, tmp_path / "turning.mp4", options=options).output
    assert len(list(read_motion(stream))) == 400
    assert sum(1 for _ in decode_frames(stream)) == 400


def test_quick_stream_is_reused_unless_full_effort_is_requested(
    phone: Path, tmp_path: Path
) -> None:
    quick, full = (EncodeOptions("libaom", effort=effort) for effort in ("quick", "full"))
    stream = tmp_path / "stream.mp4"
    assert not stream_of(phone, stream, options=quick).reused
    same = EncodeOptions("libaom", speed=ENCODERS["libaom"].quick_speed)
    assert stream_of(phone, stream, options=same).reused
    assert stream_of(phone, stream, options=EncodeOptions("libaom")).reused
    assert not stream_of(phone, stream, options=full).reused
    assert stream_of(phone, stream, options=full).reused
    assert stream_of(phone, stream, options=quick).reused


def test_each_ffmpeg_is_asked_once_for_its_encoders(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Encoders that it does not have are not tried, and the others once."""
    (tmp_path / "bin").mkdir()
    called = tmp_path / "called"
    script = f'echo "$*" >> {called}; case "$*" in *-encoders*) echo libsvtav1; exit;; esac'
    fake_ffmpeg(tmp_path / "bin", script)
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(fake_ffmpeg(tmp_path, "exit 1")))
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:{os.environ['PATH']}")
    for _ in range(2):
        name, program = find_encoder(EncodeOptions())
        assert (name, program) == ("svt", str(tmp_path / "bin" / "ffmpeg"))
    assert ["libsvtav1" in line for line in called.read_text().splitlines()] == [False, True]


def test_converted_pictures_look_like_those_of_a_rotated_video(
    phone: Path, ffmpeg: Ffmpeg, tmp_path: Path
) -> None:
    turned = ffmpeg("-display_rotation", "90", "-i", phone, "-c", "copy", tmp_path / "t.mp4")
    report = encode_video(turned, tmp_path / "out.mp4", options=EncodeOptions(quality=5))
    for (_, before), (_, after) in zip(
        decode_frames(turned), decode_frames(report.output), strict=True
    ):
        assert after.shape == (96, 64, 3)
        assert cv2.PSNR(before, after) > 30


def test_varying_frame_rate_keeps_every_frame(phone: Path, ffmpeg: Ffmpeg, tmp_path: Path) -> None:
    uneven = ffmpeg(
        *("-i", phone, "-vf", "setpts=N*N*0.004/TB", "-fps_mode", "passthrough"),
        *("-enc_time_base", "1/1000", *H264, tmp_path / "uneven.mp4"),
    )
    report = encode_video(uneven, tmp_path / "out.mp4")
    assert report.num_frames == 12
    np.testing.assert_allclose(times(report.output), times(uneven), atol=2e-3)


@pytest.mark.parametrize("encoder", ["libaom", "svt"])
def test_ten_bit_hdr_video_is_converted_and_matched(
    encode: Encode, ffmpeg: Ffmpeg, tmp_path: Path, encoder: str
) -> None:
    """A video like those of newer phones, with 60 frames per second."""
    plain = encode(make_frames(12, 96, 64), tmp_path / "plain.mkv", "-c:v", "ffv1")
    colours = "setparams=colorspace=bt2020nc:color_primaries=bt2020:color_trc=smpte2084"
    video = ffmpeg(
        *("-i", plain, "-vf", f"setpts=N/60/TB,{colours}", "-fps_mode", "passthrough"),
        *("-enc_time_base", "1/600", "-c:v", "libx265", "-tag:v", "hvc1", "-x265-params"),
        *("log-level=error", "-pix_fmt", "yuv420p10le"),
        tmp_path / "phone.mov",
    )
    options = EncodeOptions(encoder=encoder, quality=5)
    report = encode_video(video, tmp_path / "out.mp4", options=options)
    assert report.num_frames == 12
    np.testing.assert_allclose(times(report.output), np.arange(12) / 60, atol=2e-3)
    with av.open(str(report.output)) as container:
        assert container.streams.video[0].format.name == "yuv420p"
    for (_, before), (_, after) in zip(
        decode_frames(video), decode_frames(report.output), strict=True
    ):
        # Decoders convert these colours differently, but matching only needs the structure.
        grey = [cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY) for picture in (before, after)]
        assert np.corrcoef(grey[0].ravel(), grey[1].ravel())[0, 1] > 0.98
    found = match(tmp_path / "a.db", video, options=MatchOptions(encode=options))
    assert found.num_images == 12
    assert found.num_verified_pairs > 0
    assert found.conversion is not None
    assert found.conversion.startswith("hevc at 96x64")
    assert any("PQ" in warning for warning in found.warnings)


def test_slow_motion_keeps_every_frame(phone: Path, ffmpeg: Ffmpeg, tmp_path: Path) -> None:
    """The video has 240 frames per second and a gap of two frames."""
    video = ffmpeg(
        *("-i", phone, "-vf", "setpts=(N+2*gt(N\\,5))/240/TB", "-fps_mode", "passthrough"),
        *("-enc_time_base", "1/24000", *H264, tmp_path / "slow.mov"),
    )
    report = encode_video(video, tmp_path / "out.mp4")
    assert report.num_frames == 12
    expected = (np.arange(12) + 2 * (np.arange(12) > 5)) / 240
    np.testing.assert_allclose(times(video), expected, atol=5e-4)
    np.testing.assert_allclose(times(report.output), expected, atol=5e-4)


@pytest.mark.parametrize("encoder", ["libaom", "svt"])
def test_odd_sizes_are_kept(encode: Encode, tmp_path: Path, encoder: str) -> None:
    source = encode(make_frames(4, 97, 65), tmp_path / "odd.mkv", "-c:v", "ffv1")
    report = encode_video(source, tmp_path / "out.mp4", options=EncodeOptions(encoder=encoder))
    assert {image.shape for _, image in decode_frames(report.output)} == {(65, 97, 3)}


def test_stream_is_reused_until_the_settings_or_the_video_change(
    phone: Path, tmp_path: Path
) -> None:
    video = Path(shutil.copy(phone, tmp_path / "phone.mov"))
    stream = tmp_path / "stream.mp4"
    first = stream_of(video, stream)
    assert first.output == stream
    assert not first.reused
    bytes_before = first.output.read_bytes()
    assert stream_of(video, stream).reused
    assert stream_of(video, stream, options=EncodeOptions(quality=20)).reused
    assert not stream_of(video, stream, options=EncodeOptions(quality=40)).reused
    assert not stream_of(video, stream, options=EncodeOptions(quality=20)).reused
    # The options that are left out have their defaults again.
    assert not stream_of(video, stream, options=EncodeOptions(quality=60)).reused
    assert not stream_of(video, stream).reused
    assert not stream_of(video, stream, options=EncodeOptions(speed=8)).reused
    assert not stream_of(video, stream).reused
    assert first.output.read_bytes() == bytes_before
    # A truncated stream is not recognized as one of this package, so it is not replaced.
    first.output.write_bytes(bytes_before[: len(bytes_before) // 2])
    with pytest.raises(OptionError, match="exists"):
        stream_of(video, stream)
    first.output.unlink()
    stream_of(video, stream)
    # A stream older than the video is encoded again.
    os.utime(first.output, (0, 0))
    assert not stream_of(video, stream).reused


def test_stream_of_another_video_is_not_reused(phone: Path, ffmpeg: Ffmpeg, tmp_path: Path) -> None:
    video = Path(shutil.copy(phone, tmp_path / "phone.mp4"))
    stream = tmp_path / "stream.mp4"
    stream_of(video, stream)
    # This video has as many frames and is older than the stream.
    other = ffmpeg("-i", phone, "-vf", "hflip", *H264, tmp_path / "phone.mov")
    os.utime(other, (0, 0))
    assert not stream_of(other, stream).reused
    assert not stream_of(video, stream).reused
    with pytest.raises(OptionError, match=r"\.mkv"):
        stream_of(video, tmp_path / "out.ivf")


def test_stream_of_a_raw_video_is_not_reused_for_another(ffmpeg: Ffmpeg, tmp_path: Path) -> None:
    """Uncompressed videos with the same resolution and length have the same file size."""
    videos = []
    for change in ("null", "hflip"):
        words = ["-f", "lavfi", "-i", "testsrc=s=64x64:r=25", "-frames:v", "4", "-vf", change]
        videos.append(ffmpeg(*words, "-pix_fmt", "yuv420p", tmp_path / f"{change}.y4m"))
        os.utime(videos[-1], (0, 0))
    assert videos[0].stat().st_size == videos[1].stat().st_size
    stream = tmp_path / "stream.mp4"
    stream_of(videos[0], stream)
    assert stream_of(videos[0], stream).reused
    assert not stream_of(videos[1], stream).reused


def test_files_that_are_not_streams_are_not_replaced(phone: Path, tmp_path: Path) -> None:
    video = Path(shutil.copy(phone, tmp_path / "phone.mp4"))
    other = tmp_path / "other.mp4"
    shutil.copy(phone, other)
    with pytest.raises(OptionError, match="exists"):
        stream_of(video, other)
    with pytest.raises(OptionError, match="--overwrite"):
        encode_video(video, other)
    with pytest.raises(OptionError, match="input"):
        encode_video(video, video, overwrite=True)
    assert other.read_bytes() == video.read_bytes() == phone.read_bytes()
    assert encode_video(video, other, overwrite=True).num_frames == 12
    # Streams of `encode` are files of the user, too, even if they are made from a kept stream.
    kept = stream_of(video, tmp_path / "kept.mp4").output
    encode_video(kept, tmp_path / "again.mp4")
    for made in (other, tmp_path / "again.mp4"):
        with pytest.raises(OptionError, match="exists"):
            stream_of(video, made)


def test_match_accepts_any_codec(phone: Path, tmp_path: Path) -> None:
    video = Path(shutil.copy(phone, tmp_path / "phone.mp4"))
    stream = tmp_path / "stream.mp4"
    options = MatchOptions(keep_stream=str(stream))
    report = match(tmp_path / "a.db", video, image_path=tmp_path / "frames", options=options)
    assert report.streams == (stream,)
    assert report.num_images == 12
    assert report.num_verified_pairs > 0
    # The images are decoded from the video, not from the stream.
    for index, picture in decode_frames(video):
        written = cv2.imread(str(tmp_path / "frames" / f"frame_{index:06d}.png"))
        np.testing.assert_array_equal(written, picture)
    again = match(tmp_path / "b.db", video, options=options)
    assert again.num_matches == report.num_matches


def test_temporary_stream_is_removed(phone: Path, tmp_path: Path) -> None:
    """During the match, it lies next to the database."""
    (tmp_path / "videos").mkdir()
    video = Path(shutil.copy(phone, tmp_path / "videos" / "phone.mp4"))
    (tmp_path / "work").mkdir()
    found: set[str] = set()

    def list_files(stage: str, done: int, total: int | None) -> None:
        found.update(p.name for p in (tmp_path / "work").iterdir() if stage == "motion")

    report = match(tmp_path / "work" / "a.db", video, progress=list_files)
    assert report.streams == (None,)
    assert report.num_images == 12
    assert len(found) == 1
    assert [p.name for p in (tmp_path / "work").iterdir()] == ["a.db"]
    assert list(video.parent.iterdir()) == [video]


def test_only_poor_av1_streams_are_reencoded(
    clip: Path, encode: Encode, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    how = ("-c:v", "libaom-av1", "-cpu-used", "8", "-g", "1", "-crf", "20")
    intra = encode(make_frames(8), tmp_path / "intra.mp4", *how)
    assert not read_info(intra).good
    words = ["match", "--database", str(tmp_path / "a.db"), "--video", str(intra)]
    # Without motion vectors, SIFT links join the images, and a warning suggests to reencode.
    assert main(words) == 0
    assert "--reencode 1" in capsys.readouterr().err
    (tmp_path / "a.db").unlink()
    assert main([*words, "--reencode", "1"]) == 0
    assert "--reencode 1" not in capsys.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.db", "intra.mp4"]
    good = match(tmp_path / "b.db", clip, options=MatchOptions(reencode=True))
    assert good.streams == (clip,)


def damage(video: Path, output: Path, packet: int) -> Path:
    """Copy an MP4 file, and damage the packet with this index in coding order."""
    with av.open(str(video)) as container:
        coded = [p for p in container.demux(video=0) if p.size][packet]
        start, end = coded.pos, coded.pos + coded.size
    data = bytearray(video.read_bytes())
    data[start:end] = b"\xff" * (end - start)
    output.write_bytes(data)
    return output


def test_damaged_video_is_used_up_to_the_damage(
    encode: Encode, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # Without B frames, the packets are in display order.
    how = ("-c:v", "libx264", "-g", "6", "-bf", "0")
    whole = encode(make_frames(24, 96, 64), tmp_path / "whole.mp4", *how)
    video = damage(whole, tmp_path / "video.mp4", 13)
    with pytest.warns(UserWarning, match="13 of 24"):
        first = stream_of(video, tmp_path / "stream.mp4")
    assert first.num_frames == len(list(decode_frames(first.output))) == 13
    for (_, before), (_, after) in zip(
        decode_frames(whole), decode_frames(first.output), strict=False
    ):
        assert cv2.PSNR(before, after) > 30
    # The warning appears again when the stream is reused.
    with pytest.warns(UserWarning, match="13 of 24"):
        again = stream_of(video, first.output)
    assert again.reused
    assert again.num_frames == 13
    bytes_before = first.output.read_bytes()
    with pytest.raises(BitstreamError, match="13 frames"):
        stream_of(video, first.output, strict=True)
    words = ["encode", "--video", str(video), "--output", str(tmp_path / "out.mp4"), "--quiet"]
    assert main([*words, "--strict"]) == 2
    assert not (tmp_path / "out.mp4").exists()
    assert main(words) == 0
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(":")[1] for line in lines] == [" error", " warning"]
    assert first.output.read_bytes() == bytes_before
    assert not list(tmp_path.glob(".*"))


def test_video_whose_end_is_missing_is_used_with_a_warning(
    phone: Path, ffmpeg: Ffmpeg, tmp_path: Path
) -> None:
    whole = ffmpeg("-i", phone, "-c", "copy", tmp_path / "whole.mkv")
    video = tmp_path / "cut.mkv"
    video.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    stream = tmp_path / "kept.mp4"
    for given in (video, read_video(video)):
        for _ in range(2):  # the stream is reused the second time
            with pytest.warns(UserWarning, match="damaged"):
                report = stream_of(given, stream)
            assert 0 < report.num_frames < len(times(phone))
        stream.unlink()
        for make in (encode_video, stream_of):
            with pytest.raises(BitstreamError, match="cut off"):
                make(given, tmp_path / "strict.mp4", strict=True)
            assert not (tmp_path / "strict.mp4").exists()
    # The last packet in coding order is not the last picture.
    slower = "setpts='if(gt(N,9),N*8,N)/25/TB'"
    varying = ["-i", phone, "-vf", slower, "-fps_mode", "vfr", "-c:v", "libx264", "-bf", "3"]
    reordered = ffmpeg(*varying, tmp_path / "reordered.mkv")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for complete in (whole, reordered):
            encode_video(complete, tmp_path / f"{complete.stem}.mp4", strict=True)


def test_frames_are_counted_if_the_container_does_not_store_their_number(
    phone: Path, ffmpeg: Ffmpeg, tmp_path: Path
) -> None:
    video = ffmpeg("-i", phone, "-c", "copy", tmp_path / "phone.ts")
    done: list[tuple[str, int, int | None]] = []
    encode_video(video, tmp_path / "out.mp4", progress=lambda *step: done.append(step))
    assert done[0] == ("encoding", 0, 12)
    assert done[-1] == ("encoding", 12, 12)


def test_video_that_changes_during_conversion_is_refused(phone: Path, tmp_path: Path) -> None:
    """For example, the video is still being copied from the phone."""
    video = tmp_path / "v.mov"
    shutil.copyfile(phone, video)

    def append(stage: str, done: int, total: int | None) -> None:
        if done == 0:
            with video.open("ab") as file:
                file.write(b"more")

    with pytest.raises(VideoError, match="changed"):
        encode_video(video, tmp_path / "s.mp4", progress=append)
    assert list(tmp_path.iterdir()) == [video]


def test_video_that_changes_its_resolution_is_refused(encode: Encode, tmp_path: Path) -> None:
    video = tmp_path / "video.h264"
    video.write_bytes(
        b"".join(
            encode(make_frames(4, *size), tmp_path / "part.h264", "-c:v", "libx264").read_bytes()
            for size in [(96, 64), (128, 96)]
        )
    )
    with pytest.raises(VideoError, match="96x64 to 128x96"):
        encode_video(video, tmp_path / "out.mp4", options=EncodeOptions(encoder="svt"))
    assert not list(tmp_path.glob("*out*"))


@pytest.fixture(scope="module")
def long(ffmpeg: Ffmpeg, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A clip whose conversion takes several seconds."""
    return ffmpeg(
        *("-f", "lavfi", "-i", "testsrc2=size=1280x720:rate=30:duration=5"),
        *("-c:v", "libx264", "-preset", "ultrafast"),
        tmp_path_factory.mktemp("long") / "long.mp4",
    )


@contextmanager
def long_conversion(
    clip: Path, folder: Path, words: Sequence[str] = TO_A_FILE
) -> Iterator[subprocess.Popen[bytes]]:
    """A process that has started to convert a copy of a clip in a folder.

    Args:
        clip: the clip, which becomes long.mp4.
        folder: the folder.
        words: the command and its output.
    """
    long = shutil.copyfile(clip, folder / "long.mp4")
    words = [*words, "--video", str(long), "--encoder", "libaom", "--speed", "2"]
    command = [sys.executable, "-c", HANDLE_INTERRUPTS, *words]
    with subprocess.Popen(command, cwd=folder) as process:
        deadline = time.monotonic() + 60
        while not [p for p in folder.rglob(".*.partial") if p.is_file()]:
            assert time.monotonic() < deadline
            assert process.poll() is None
            time.sleep(0.05)
        yield process


def is_being_converted(video: Path) -> bool:
    """Whether a running process has the video among its arguments."""
    running = subprocess.run(
        ["ps", "-ww", "-eo", "args"], capture_output=True, text=True, check=True
    )
    return str(video) in running.stdout


@pytest.mark.parametrize("words", [TO_A_FILE, TO_A_DATABASE], ids=["encode", "match"])
@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_interrupted_conversion_leaves_nothing(
    long: Path, tmp_path: Path, number: int, status: int, words: Sequence[str]
) -> None:
    with long_conversion(long, tmp_path, words) as process:
        process.send_signal(number)
        assert process.wait(30) == status
    assert [p.name for p in tmp_path.iterdir()] == ["long.mp4"]
    assert not is_being_converted(tmp_path / "long.mp4")


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux can end a child with its parent")
def test_encoder_of_a_killed_conversion_ends_and_the_next_run_cleans_up(
    phone: Path, long: Path, tmp_path: Path
) -> None:
    with long_conversion(long, tmp_path) as process:
        process.kill()
        process.wait(30)
    deadline = time.monotonic() + 10
    while is_being_converted(tmp_path / "long.mp4"):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert list(tmp_path.glob(".out.mp4.*.partial"))
    others = [".out.mp4.1.partial", ".out.mp4.backup.partial", ".in.mp4.1.partial"]
    for name in others:
        (tmp_path / name).touch()
    encode_video(phone, tmp_path / "out.mp4", options=EncodeOptions(encoder="svt"))
    assert {p.name for p in tmp_path.iterdir()} == {"long.mp4", "out.mp4", *others}


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux can end a child with its parent")
@pytest.mark.parametrize("next_video", ["phone", "clip"])
def test_next_match_removes_the_files_of_a_killed_one(
    next_video: str, long: Path, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    """The next match with the same database does so even if it converts no video."""
    video = request.getfixturevalue(next_video)
    with long_conversion(long, tmp_path, TO_A_DATABASE) as process:
        process.kill()
        process.wait(30)
    left = [p.name for p in tmp_path.iterdir() if p.name != "long.mp4"]
    assert len(left) == 1
    match(tmp_path / "a.db", video)
    assert {p.name for p in tmp_path.iterdir()} == {"long.mp4", "a.db"}


def fake_ffmpeg(folder: Path, script: str) -> Path:
    """Write a shell program that runs `script` and, unless that exits, the real ffmpeg."""
    path = folder / "ffmpeg"
    path.write_text(f'#!/bin/sh\n{script}\nexec {imageio_ffmpeg.get_ffmpeg_exe()} "$@"\n')
    path.chmod(0o755)
    return path


# Options of hardware encoders for quality 20, which is quantizer index 81 of 255. They forbid
# references to later frames.
HARDWARE = {
    "nvenc": "-tune hq -preset p1 -rc constqp -qp 81 -b_ref_mode 0 -bf 0",
    "qsv": "-preset 7 -q:v 81 -bf 0 -low_delay_brc 1",
    "amf": "-usage lowlatency -quality 100 -bf 0 -rc cqp -qp_i 81 -qp_p 81",
    "vaapi": "-compression_level 7 -rc_mode CQP -global_quality 81 -bf 0",
}
PICTURES = {"nvenc": "format=yuv420p", "vaapi": "format=nv12,hwupload"}
# Options that ffmpeg has for every encoder.
OF_ALL_ENCODERS = {"-bf", "-q:v", "-global_quality", "-compression_level"}


@pytest.mark.parametrize(
    ("downscale", "scaled"),
    [(None, ""), (2, "scale=w=max(2\\,2*floor(iw/2/2+0.5)):h=max(2\\,2*floor(ih/2/2+0.5)):")],
)
@pytest.mark.parametrize("name", HARDWARE)
def test_hardware_encoders_get_these_options(
    phone: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    *,
    name: str,
    downscale: float | None,
    scaled: str,
) -> None:
    """A fake ffmpeg claims to have the encoder and logs its arguments instead of encoding."""
    arguments = tmp_path / "arguments"
    log = f'printf "%s\\n" "$@" > {arguments}'
    script = f'case "$*" in *lavfi*) exit 0;; *) {log}; exit 1;; esac'
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(fake_ffmpeg(tmp_path, script)))
    options = EncodeOptions(encoder=name, downscale=downscale)
    with pytest.raises(EncodeError, match="failed"):
        encode_video(phone, tmp_path / "out.mp4", options=options)
    pictures = f"{scaled and f'{scaled}flags=area,'}{PICTURES.get(name, 'format=nv12')}"
    words = arguments.read_text().splitlines()
    device = ["-vaapi_device", "/dev/dri/renderD128"] if name == "vaapi" else []
    assert words[words.index("-y") + 1 : words.index("-i")] == device
    assert words[words.index("-i") : words.index("-progress")] == [
        *("-i", f"file:{phone}", "-map", "0:0", "-vf", pictures),
        *("-fps_mode", "passthrough", "-enc_time_base", "demux", "-c:v", f"av1_{name}"),
        *("-g", "9999", *HARDWARE[name].split()),
    ]


@pytest.mark.parametrize("name", HARDWARE)
def test_ffmpeg_knows_the_options_of_hardware_encoders(name: str) -> None:
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-hide_banner", "-h", f"encoder=av1_{name}"]
    text = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    if "is not recognized" in text:
        pytest.skip(f"this ffmpeg is built without av1_{name}")
    words = HARDWARE[name].split()
    for option, value in zip(words[::2], words[1::2], strict=True):
        # The line of the option, and the lines of its values, which are indented more.
        own = re.search(rf"^  {option} .*\n((?:     .*\n)*)", text, re.MULTILINE)
        if own is None:
            assert option in OF_ALL_ENCODERS
        elif not value.isdecimal():
            assert re.search(rf"^     {value} ", own[1], re.MULTILINE), (option, value)
        elif bounds := re.search(r"\(from (-?\d+) to (\d+)\)", own[0]):
            assert int(bounds[1]) <= int(value) <= int(bounds[2])


FAIL_HALF_WAY = """case "$*" in *lavfi*) ;; *)
  echo frame=7; echo 'Error submitting a packet to the encoder' >&2; exit 1;; esac"""


def test_encoder_that_fails_half_way_is_reported_with_its_frame_count(
    phone: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "bin").mkdir()
    program = fake_ffmpeg(tmp_path / "bin", FAIL_HALF_WAY)
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(program))
    with pytest.raises(EncodeError, match="7 frames"):
        encode_video(phone, tmp_path / "out.mp4")
    assert [p.name for p in tmp_path.iterdir()] == ["bin"]


def test_lack_of_space_is_reported(
    phone: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = """Svt[info]: ----
    [vost#0:0/libsvtav1 @ 0x55d5b6f68380] [error] Error muxing a packet: No space left"""
    script = f"case \"$*\" in *lavfi*) ;; *) echo '{words} on device' >&2; exit 1;; esac"
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(fake_ffmpeg(tmp_path, script)))
    with pytest.raises(EncodeError, match="disk"):
        encode_video(phone, tmp_path / "out.mp4")
    assert [p.name for p in tmp_path.iterdir()] == ["ffmpeg"]


def test_ffmpeg_without_av1_is_reported(
    phone: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = fake_ffmpeg(tmp_path, "echo 'Unknown encoder' >&2; exit 1")
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(program))
    monkeypatch.setenv("PATH", "")
    with pytest.raises(EncodeError, match="encoder"):
        encode_video(phone, tmp_path / "out.mp4")
    with pytest.raises(EncodeError, match="svt"):
        find_encoder(EncodeOptions(encoder="svt"))


@pytest.mark.parametrize(
    ("names", "error", "message"),
    [
        (("missing.mp4", "out.mp4"), VideoError, "no such file"),
        ((".", "out.mp4"), VideoError, "folder"),
        (("text.mp4", "out.mp4"), VideoError, "not a video"),
        (("phone.mp4", "out.avi"), OptionError, r"\.mp4"),
        (("phone.mp4", "missing/out.mp4"), EncodeError, "folder"),
    ],
)
def test_bad_paths_are_reported_in_one_line(
    phone: Path,
    tmp_path: Path,
    names: tuple[str, str],
    error: type[ColmapAv1Error],
    message: str,
) -> None:
    shutil.copy(phone, tmp_path / "phone.mp4")
    (tmp_path / "text.mp4").write_text("no video\n" * 50)
    with pytest.raises(error, match=message) as caught:
        encode_video(tmp_path / names[0], tmp_path / names[1])
    assert "\n" not in str(caught.value)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["phone.mp4", "text.mp4"]


def test_video_without_a_decodable_frame_is_reported_in_one_line(
    phone: Path, tmp_path: Path
) -> None:
    data = phone.read_bytes()
    start, end = data.index(b"mdat") + 4, data.index(b"moov")
    assert start < end
    damaged = tmp_path / "damaged.mp4"
    damaged.write_bytes(data[:start] + bytes(end - start) + data[end:])
    with pytest.raises(ColmapAv1Error, match=str(damaged)) as caught:
        encode_video(damaged, tmp_path / "out.mp4")
    assert "\n" not in str(caught.value)
    assert [p.name for p in tmp_path.iterdir()] == ["damaged.mp4"]

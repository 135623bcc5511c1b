from __future__ import annotations

import gc
import hashlib
import json
import shlex
import shutil
import struct
from collections.abc import Iterator
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from conftest import AV1, SHARED, Encode, Ffmpeg, make_frames
from ivf_files import frame_headers, ivf_of, packets, with_repeats

from colmap_av1.cli import main
from colmap_av1.errors import BitstreamError, NotAv1Error, VideoError
from colmap_av1.motion.info import read_info
from colmap_av1.motion.reading import read_motion
from colmap_av1.options import ReadOptions
from colmap_av1.video.container import open_stream
from colmap_av1.video.decoding import decode_frames
from colmap_av1.video.facts import count_shown, read_video

TEMPORAL_DELIMITER = 2
KIT = SHARED / "conformance"


def manifest() -> list[dict]:
    path = KIT / "manifest.json"
    return json.loads(path.read_text())["streams"] if path.exists() else []


def leb128(data: bytes, at: int) -> tuple[int, int]:
    value = 0
    for i in range(8):
        value |= (data[at + i] & 0x7F) << (7 * i)
        if not data[at + i] & 0x80:
            return value, at + i + 1
    raise ValueError("leb128 of more than 8 bytes")


def obus(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Type and payload of the OBUs of a packet (5.3.1), without delimiters."""
    at = 0
    while at < len(data):
        header = data[at]
        start = at + 1 + (header >> 2 & 1)
        size = len(data) - start
        if header >> 1 & 1:
            size, start = leb128(data, start)
        if header >> 3 & 15 != TEMPORAL_DELIMITER:
            yield header >> 3 & 15, data[start : start + size]
        at = start + size


def read_until_error(path: Path) -> tuple[list[bytes], Exception | None]:
    found: list[bytes] = []
    try:
        found.extend(packet.data for packet in packets(path))
    except (BitstreamError, VideoError) as error:
        return found, error
    return found, None


@pytest.mark.shared
def test_all_containers_of_a_stream_give_the_same_obus() -> None:
    compared = 0
    for stream in manifest():
        kinds = [c for c in stream["containers"] if c["kind"] != "variant"]
        contents = [
            [obu for packet in packets(KIT / c["file"]) for obu in obus(packet.data)] for c in kinds
        ]
        assert contents[0]
        for kind, content in zip(kinds, contents, strict=True):
            assert content == contents[0], kind["file"]
            compared += 1
    assert compared > 150


@pytest.mark.shared
def test_ivf_packets_are_the_bytes_of_the_file() -> None:
    path = KIT / "streams/good_lag0.ivf"
    data, at, expected = path.read_bytes(), 32, []
    while at < len(data):
        size = int.from_bytes(data[at : at + 4], "little")
        expected.append(data[at + 12 : at + 12 + size])
        at += 12 + size
    found = list(packets(path))
    assert [p.data for p in found] == expected
    assert [p.index for p in found] == list(range(len(expected)))


@pytest.mark.shared
@pytest.mark.parametrize("ending", ["mp4", "mkv", "webm"])
def test_configuration_holds_the_sequence_header(ending: str) -> None:
    with open_stream(KIT / f"streams/good_cpu2_lag19.{ending}") as stream:
        ((kind, payload),) = obus(stream.configuration)
        first = next(obu for p in stream.packets() for obu in obus(p.data))
    assert kind == 1
    assert first == (1, payload)


# File, packets before the damage, error.
DAMAGED = [
    ("cut_in_inter_frame.ivf", 6, BitstreamError),
    ("cut_last_byte.ivf", 9, BitstreamError),
    ("cut_after_obu_header.ivf", 1, BitstreamError),
    ("cut_in_frame_header_field.ivf", 2, BitstreamError),
    ("ivf_frame_size_huge.ivf", 1, BitstreamError),
    ("ivf_frame_size_zero.ivf", 1, BitstreamError),
    ("cut.obu", None, BitstreamError),
    ("cut_half.mkv", 0, BitstreamError),
    ("stco_past_end.mp4", 0, BitstreamError),
    ("cut_half.mp4", 0, VideoError),
    ("empty.ivf", 0, VideoError),
    ("garbage.ivf", 0, VideoError),
    ("text.ivf", 0, VideoError),
    ("h264.mp4", 0, NotAv1Error),
    ("h264.mkv", 0, NotAv1Error),
    ("wrong_fourcc.ivf", 0, NotAv1Error),
]


@pytest.mark.shared
@pytest.mark.parametrize(("name", "count", "error"), DAMAGED)
def test_damage_is_reported_after_the_packets_before_it(
    name: str, count: int | None, error: type[Exception]
) -> None:
    found, caught = read_until_error(KIT / "bad" / name)
    assert type(caught) is error
    assert count is None or len(found) == count
    assert "\n" not in str(caught)
    assert name in str(caught)


@pytest.mark.shared
def test_damaged_files_only_raise_errors_of_the_package() -> None:
    for path in sorted((KIT / "bad").iterdir()):
        _, error = read_until_error(path)
        assert "\n" not in str(error)


@pytest.mark.parametrize("ending", ["mp4", "mkv", "webm", "ivf", "obu"])
def test_truncated_files_give_a_prefix_and_are_reported(
    clip: Path, ffmpeg: Ffmpeg, tmp_path: Path, ending: str
) -> None:
    flags = ["-movflags", "+faststart"] if ending == "mp4" else []
    whole = ffmpeg("-i", clip, "-c", "copy", *flags, tmp_path / f"whole.{ending}")
    expected = [p.data for p in packets(whole)]
    assert len(expected) == 16
    data = whole.read_bytes()
    cut = tmp_path / f"cut.{ending}"
    for share in (0.9, 0.75, 0.6):
        cut.write_bytes(data[: int(len(data) * share)])
        found, error = read_until_error(cut)
        assert isinstance(error, BitstreamError)
        assert "cut off" in str(error)
        assert 0 < len(found) < 16
        whole_ones = found if ending != "obu" else found[:-1]  # FFmpeg ends with whole OBUs
        assert whole_ones == expected[: len(whole_ones)]


@pytest.mark.parametrize(
    ("ending", "how"),
    [
        ("webm", ["-live", "1"]),
        ("mkv", ["-live", "1"]),
        ("mkv", []),
        ("mp4", ["-movflags", "frag_every_frame+empty_moov"]),
    ],
)
def test_recordings_truncated_in_the_last_packet_are_reported(
    clip: Path, ffmpeg: Ffmpeg, tmp_path: Path, ending: str, how: list[str]
) -> None:
    """Such files contain neither their duration nor the number of packets."""
    whole = ffmpeg("-i", clip, "-c", "copy", *how, tmp_path / f"whole.{ending}")
    expected = [p.data for p in packets(whole)]
    assert len(expected) == 16
    with open_stream(whole) as stream:
        last = next(p for p in stream.packets() if p.index == 15).data
    data = whole.read_bytes()
    end = data.rindex(bytes(last)) + len(last)
    cut = tmp_path / f"cut.{ending}"
    for missing in (1, len(last) - 1, len(last) + 1):
        cut.write_bytes(data[: end - missing])
        found, error = read_until_error(cut)
        assert isinstance(error, BitstreamError)
        assert "cut off" in str(error)
        assert found == expected[:15]
    with pytest.warns(UserWarning, match="cut off"):
        assert len(list(read_motion(cut))) >= 15
    with pytest.raises(BitstreamError, match="cut off"):
        list(read_motion(cut, ReadOptions(strict=True)))


@pytest.mark.skipif(
    not hasattr(av.Packet, "has_sidedata"), reason="PyAV does not report encryption"
)
@pytest.mark.parametrize("codec", [AV1, ["-c:v", "libx264"]])
def test_encrypted_videos_are_reported_as_encrypted(
    clip: Path, ffmpeg: Ffmpeg, tmp_path: Path, codec: list[str]
) -> None:
    words = ["-encryption_scheme", "cenc-aes-ctr", "-encryption_key", "76" * 16]
    words += ["-encryption_kid", "a7" * 16]
    path = ffmpeg("-i", clip, *codec, *words, tmp_path / "encrypted.mp4")
    with pytest.raises(VideoError, match="is encrypted"):
        read_video(path)
    with pytest.raises(VideoError, match="is encrypted"):
        list(decode_frames(path))
    if codec == AV1:
        with pytest.raises(VideoError, match="is encrypted"):
            list(read_motion(path))
    assert main(["encode", "--video", str(path), "--output", str(tmp_path / "out.mp4")]) == 2
    assert not (tmp_path / "out.mp4").exists()


def test_packets_after_the_index_of_a_recording_are_counted(
    clip: Path, ffmpeg: Ffmpeg, tmp_path: Path
) -> None:
    """The index at the beginning lists only those before the first fragment."""
    h264 = ffmpeg("-i", clip, "-c:v", "libx264", "-g", "4", tmp_path / "h264.mp4")
    path = ffmpeg("-i", h264, "-c", "copy", "-movflags", "frag_keyframe", tmp_path / "f.mp4")
    video = read_video(path)
    assert count_shown(video) == len(list(decode_frames(path))) == 16


def test_data_after_the_last_packet_is_not_reported(
    clip: Path, ffmpeg: Ffmpeg, tmp_path: Path
) -> None:
    for ending in ("mkv", "mp4"):
        flags = ["-movflags", "frag_keyframe+empty_moov"] if ending == "mp4" else []
        path = ffmpeg("-i", clip, "-c", "copy", *flags, tmp_path / f"whole.{ending}")
        for rest in (b"", bytes(100), b"\xec\x83abc" if ending == "mkv" else b"\0\0\0\x0afreeab"):
            path.write_bytes(path.read_bytes() + rest)
            assert len(list(packets(path))) == 16


def test_stream_facts(clip: Path) -> None:
    with open_stream(clip) as stream:
        file = stream.file
        assert (file.path, file.codec) == (clip, "av1")
        assert file.stored_size == (192, 128)
        assert file.frame_rate == 25
        assert file.duration == pytest.approx(16 / 25)
        assert file.num_packets == file.likely_num_packets == 16
        assert file.is_mp4
        assert not file.is_matroska
        times = [p.pts for p in stream.packets()]
    assert times == pytest.approx(np.arange(16) / 25)


def test_edit_lists_drop_no_packet(encode: Encode, ffmpeg: Ffmpeg, tmp_path: Path) -> None:
    clip = encode(make_frames(12), tmp_path / "clip.mp4")
    trimmed = ffmpeg("-ss", "0.2", "-i", clip, "-c", "copy", tmp_path / "trimmed.mp4")
    with av.open(str(trimmed)) as container:
        shown = sum(1 for _ in container.decode(video=0))
    assert shown < 12  # the edit list hides frames that later ones reference
    assert len(list(packets(trimmed))) == 12
    assert len(list(decode_frames(trimmed))) == shown


@pytest.mark.parametrize("angle", [0, 90, 180, 270])
@pytest.mark.parametrize("codec", ["av1", "h264"])
def test_pictures_are_rotated_like_ffmpeg(
    encode: Encode, ffmpeg: Ffmpeg, tmp_path: Path, angle: int, codec: str
) -> None:
    how = AV1 if codec == "av1" else ["-c:v", "libx264"]
    plain = encode(make_frames(3, 96, 64), tmp_path / "plain.mp4", *how)
    turned = ffmpeg(
        "-display_rotation", str(angle), "-i", plain, "-c", "copy", tmp_path / "turned.mp4"
    )
    video = read_video(turned)
    assert video.codec == codec
    assert video.display.rotation == angle
    assert video.stored_size == (96, 64)
    assert video.picture_size == ((64, 96) if angle in (90, 270) else (96, 64))
    ffmpeg("-i", turned, tmp_path / "%d.png")
    decoded = list(decode_frames(turned))
    assert [index for index, _ in decoded] == [0, 1, 2]
    for index, image in decoded:
        written = cv2.imread(str(tmp_path / f"{index + 1}.png"))
        assert image.shape == written.shape
        # FFmpeg and PyAV may round differently when converting from YUV.
        assert np.abs(image.astype(int) - written.astype(int)).mean() < 2


def test_decoded_frames_show_the_picture(encode: Encode, tmp_path: Path) -> None:
    frames = make_frames(5)
    clip = encode(frames, tmp_path / "clip.mp4", *" ".join(AV1).replace("20", "5").split())
    decoded = list(decode_frames(clip))
    assert [index for index, _ in decoded] == list(range(5))
    smooth = [np.mean(f.reshape(16, 8, 24, 8, 3), axis=(1, 3)) for _, f in decoded]
    truth = [np.mean(f.reshape(16, 8, 24, 8, 3), axis=(1, 3)) for f in frames]
    assert np.abs(np.array(smooth) - truth).mean() < 8
    assert decoded[0][1].dtype == np.uint8


@pytest.mark.shared
@pytest.mark.parametrize(
    ("name", "count"),
    [("cut_in_inter_frame.ivf", 6), ("tu_shortened.ivf", 6), ("frame_header_one_byte.ivf", 1)],
)
@pytest.mark.parametrize("num_threads", [None, 1, 4])
def test_frames_before_damage_are_decoded(name: str, count: int, num_threads: int | None) -> None:
    found = []
    try:
        for index, _ in decode_frames(KIT / "bad" / name, num_threads=num_threads):
            found.append(index)
    except BitstreamError:
        pass
    else:
        pytest.fail("the damage is not reported")
    assert found == list(range(count))


@pytest.mark.shared
def test_film_grain_is_not_applied() -> None:
    """The checksums of the conformance kit are of pictures without grain."""
    stream = next(s for s in manifest() if s["name"] == "film_grain_test")
    path = KIT / stream["containers"][0]["file"]
    grainless = hashlib.md5()
    with av.open(str(path)) as container:
        container.streams.video[0].codec_context.options = {"export_side_data": "film_grain"}
        pictures = list(container.decode(video=0))
        for picture in pictures:
            for plane in picture.planes:
                rows = np.frombuffer(plane, np.uint8).reshape(plane.height, plane.line_size)
                grainless.update(rows[:, : plane.width].tobytes())
    assert grainless.hexdigest() == stream["output_md5"]
    for (_, image), picture in zip(decode_frames(path), pictures, strict=True):
        np.testing.assert_array_equal(image, picture.to_ndarray(format="bgr24"))


def test_error_for_other_codecs_gives_the_conversion_command(
    encode: Encode, tmp_path: Path
) -> None:
    source = encode(make_frames(3), tmp_path / "it's one.mp4", "-c:v", "libx264")
    with pytest.raises(NotAv1Error) as caught:
        open_stream(source)
    command = shlex.split(str(caught.value).partition("convert it: ")[2])
    assert command[0] == "colmap-av1"
    assert main([*command[1:-1], str(tmp_path / command[-1]), "--quiet"]) == 0
    assert len(list(packets(tmp_path / "it's one_av1.mp4"))) == 3


def test_metadata_that_is_not_utf8_does_not_matter(
    clip: Path, ffmpeg: Ffmpeg, tmp_path: Path
) -> None:
    """Some cameras write Latin-1."""
    words = ("-metadata", "title=Familie", "-metadata:s:v", "title=Familie")
    named = ffmpeg("-i", clip, "-c", "copy", *words, tmp_path / "named.mkv")
    data = named.read_bytes()
    assert b"Familie" in data
    named.write_bytes(data.replace(b"Familie", b"Fam\xeflie"))
    assert len(list(packets(named))) == len(list(packets(clip)))


def test_audio_file_is_refused(ffmpeg: Ffmpeg, tmp_path: Path) -> None:
    tone = ffmpeg("-f", "lavfi", "-i", "sine=duration=0.2", tmp_path / "tone.mp4")
    with pytest.raises(VideoError, match="audio"):
        open_stream(tone)


@pytest.mark.parametrize("ending", ["m4a", "mp3"])
def test_audio_file_with_a_cover_picture_is_refused(
    clip: Path, ffmpeg: Ffmpeg, tmp_path: Path, ending: str
) -> None:
    cover = ffmpeg("-i", clip, "-frames:v", "1", tmp_path / "cover.png")
    tone = ffmpeg(
        *("-f", "lavfi", "-i", "sine=duration=0.2", "-i", cover, "-map", "0", "-map", "1"),
        *("-c:v", "copy", "-disposition:v:0", "attached_pic", tmp_path / f"tone.{ending}"),
    )
    for read in (open_stream, read_video):
        with pytest.raises(VideoError, match="cover"):
            read(tone)


def test_missing_files_folders_and_empty_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(VideoError, match="no such file"):
        open_stream(tmp_path / "none.mp4")
    with pytest.raises(VideoError, match="is a folder"):
        open_stream(tmp_path)
    empty = tmp_path / "empty.mp4"
    empty.touch()
    with pytest.raises(VideoError, match="empty"):
        open_stream(empty)


def test_file_names_are_not_interpreted_as_protocols(
    clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(clip, "concat:clip.mp4")
    assert len(list(packets("concat:clip.mp4"))) == 16


@pytest.mark.parametrize("field", [slice(16, 20), slice(20, 24), slice(16, 24)])
@pytest.mark.filterwarnings("error::pytest.PytestUnraisableExceptionWarning")
def test_ivf_without_a_frame_rate_is_read(
    clip: Path, ffmpeg: Ffmpeg, tmp_path: Path, field: slice
) -> None:
    whole = ffmpeg("-i", clip, "-c", "copy", tmp_path / "whole.ivf")
    data = bytearray(whole.read_bytes())
    data[field] = bytes(field.stop - field.start)
    path = tmp_path / "zero.ivf"
    path.write_bytes(data)
    with open_stream(path) as stream:
        assert (stream.file.frame_rate, stream.file.duration) == (None, None)
        read = list(stream.packets())
    assert [p.data for p in read] == [p.data for p in packets(whole)]
    assert {p.pts for p in read} == {None}
    assert len(list(decode_frames(path))) == 16
    assert path.read_bytes() == data

    path.write_bytes(data[:-50])
    with pytest.raises(BitstreamError, match="cut off"):
        list(packets(path))
    path.write_bytes(data[:40])
    with pytest.raises((BitstreamError, VideoError)):
        list(packets(path))
    gc.collect()  # a file left open would warn now


@pytest.mark.parametrize("is_count", [True, False])
def test_ivf_time_unit_may_be_finer_than_frames(clip: Path, tmp_path: Path, is_count: bool) -> None:
    """The header contains the number of frames or the duration in time units."""
    data = bytearray(ivf_of(clip))
    fine = 12800 // 25
    struct.pack_into("<II", data, 16, 12800, 1)
    struct.pack_into("<I", data, 24, 16 if is_count else 16 * fine)
    for at, pts in frame_headers(data):
        struct.pack_into("<Q", data, at + 4, pts * fine)
    path = tmp_path / "fine.ivf"
    path.write_bytes(data)
    with open_stream(path) as stream:
        assert stream.file.frame_rate == pytest.approx(25)
        assert stream.file.duration == pytest.approx(16 / 25)
        assert stream.file.num_packets == 16
        assert [p.pts for p in stream.packets()] == pytest.approx(np.arange(16) / 25)


def test_repeated_pictures_at_the_end_are_counted(clip: Path, tmp_path: Path) -> None:
    """Players show 4 coded pictures, and then the first of them 20 more times."""
    path = with_repeats(clip, tmp_path / "again.ivf", range(4), [(3, 0, 20)])
    assert len(list(decode_frames(path))) == 24
    report = read_info(path)
    assert (report.num_shown, report.num_coded) == (24, 4)


def test_animated_avif_is_read_from_its_track(
    encode: Encode, ffmpeg: Ffmpeg, tmp_path: Path
) -> None:
    """Such a file also contains a still picture, which comes first."""
    clip = encode(make_frames(6), tmp_path / "clip.mp4", *AV1)
    moving = ffmpeg("-i", clip, "-c", "copy", tmp_path / "moving.avif")
    still = ffmpeg("-i", clip, "-frames:v", "1", "-c", "copy", tmp_path / "still.avif")
    with av.open(str(moving)) as container:
        assert len(container.streams.video) == 2
    assert [bytes(p.data) for p in packets(moving)] == [bytes(p.data) for p in packets(clip)]
    assert read_video(moving).num_packets == 6
    assert len(list(decode_frames(moving))) == 6
    assert len(list(packets(still))) == 1

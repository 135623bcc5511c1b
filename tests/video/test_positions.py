"""Positions in metadata of phones, GoPro cameras and DJI drones."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from conftest import Ffmpeg
from hypothesis import given, settings
from hypothesis import strategies as st
from telemetry import dji_text, gpmf, gpmf_nest, gps5, gps9, grav, with_gpmf

from colmap_av1.images.choosing import ChosenImages
from colmap_av1.images.image_set import number_images
from colmap_av1.images.positions import image_positions
from colmap_av1.video.container import read_file
from colmap_av1.video.facts import read_video
from colmap_av1.video.metadata.gpmf import read_payload
from colmap_av1.video.metadata.positions import Positions, implausible_position, read_positions

PLACES = np.array([[59.33 + k * 1e-5, 18.07 - k * 2e-5, 20 + k * 0.1] for k in range(10)])


def positions_of(path: Path) -> Positions:
    found = read_positions(read_file(path))
    assert found is not None
    return found


@pytest.mark.parametrize(
    ("words", "place"),
    [
        (["-metadata", "location=+59.3293+018.0686/"], (59.3293, 18.0686, 0.0)),
        (["-metadata", "location=-33.8568+151.2153+058.215/"], (-33.8568, 151.2153, 58.215)),
        (
            [
                *("-movflags", "use_metadata_tags", "-metadata"),
                "com.apple.quicktime.location.ISO6709=+59.3293-018.0686+028.125/",
            ],
            (59.3293, -18.0686, 28.125),
        ),
    ],
)
def test_position_of_a_phone_is_read(
    clip: Path, ffmpeg: Ffmpeg, tmp_path: Path, words: list[str], place: tuple[float, ...]
) -> None:
    found = positions_of(ffmpeg("-i", clip, "-c", "copy", *words, tmp_path / "phone.mp4"))
    assert found.place == pytest.approx(place, abs=1e-3)
    assert len(found.times) == 0


@pytest.mark.parametrize("value", ["+00.0000+000.0000/", "+95.0000+018.0686/", "at home", ""])
def test_invalid_position_of_a_phone_is_ignored(
    clip: Path, ffmpeg: Ffmpeg, tmp_path: Path, value: str
) -> None:
    words = ["-movflags", "use_metadata_tags", "-metadata"]
    words.append(f"com.apple.quicktime.location.ISO6709={value}")
    path = ffmpeg("-i", clip, "-c", "copy", *words, tmp_path / "phone.mp4")
    assert read_positions(read_file(path)) is None


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("+95.0000+218.0686/", "+95.0000+218.0686/"),
        ("+00.0000+000.0000/", "Earth"),
        ("at home\x1b[2J" + 60 * "!", "'at home?[2J!!!"),
        ("-33.8568+151.2153/", None),
        ("", None),
    ],
)
def test_invalid_position_of_a_phone_is_reported(value: str, message: str | None) -> None:
    warning = implausible_position((("com.apple.quicktime.location.iso6709", value),))
    if message is None:
        assert warning is None
        return
    assert warning is not None
    assert message in warning
    assert warning.isprintable()
    assert len(warning) < 140


def test_invalid_positions_of_a_path_are_reported(clip: Path, tmp_path: Path) -> None:
    wrong, no_fix = PLACES + np.array([40.0, 0, 0]), PLACES * [0, 0, 1]
    payload = gps5(PLACES)
    video = tmp_path / "DJI_0001.mp4"
    shutil.copyfile(clip, video)
    srt = video.with_suffix(".srt")

    def of_gopro(body: bytes) -> tuple[int, str | None]:
        found = read_positions(read_file(with_gpmf(clip, tmp_path / "gopro.mp4", [(0.6, body)])))
        return (len(found.times), found.ignored) if found is not None else (0, None)

    def of_drone(text: str) -> tuple[int, str | None]:
        srt.write_text(text)
        found = read_positions(read_file(video))
        return (len(found.times), found.ignored) if found is not None else (0, None)

    count, warning = of_gopro(gps5(np.vstack([PLACES, wrong[:3]])))
    assert count == len(PLACES)
    assert warning is not None
    assert warning.endswith("gopro.mp4: ignored 3 invalid GPS positions")
    for body in (gps5(no_fix), gps5(PLACES, fix=0), payload[:100]):
        count, warning = of_gopro(body)
        assert count == 0
        assert warning is not None
        assert "no fix" in warning
    assert of_gopro(grav(np.eye(3))) == (0, None)

    count, warning = of_drone(dji_text(np.vstack([PLACES, wrong[:2]]), 25))
    assert count == len(PLACES)
    assert warning is not None
    assert " 2 " in warning
    stamp = "1\n00:00:00,000 --> 00:00:01,000\n"
    for text in ("[latitude: abc] [longitude: ] GPS(--,nan,1e999)", "Lat 59.3293 Lon 18.0686"):
        count, warning = of_drone(f"{stamp}{text}\n\n")
        assert count == 0
        assert warning is not None
        assert warning.endswith("has no positions in a known format")
    # An empty file, as left by cameras that were switched off, and a file that is not a .srt file.
    for text in ("", "no subtitles"):
        srt.write_text(text)
        count, warning = of_drone(text)
        assert warning == f"{srt} has no positions in a known format"
    # No GPS fix, and ordinary subtitles.
    assert of_drone(dji_text(no_fix, 25)) == (0, None)
    assert of_drone(f"{stamp}Hello there\n\n") == (0, None)


def test_positions_are_read_from_srt_files_and_subtitle_streams(
    clip: Path, ffmpeg: Ffmpeg, tmp_path: Path
) -> None:
    video = tmp_path / "DJI_0001.mp4"
    shutil.copyfile(clip, video)
    srt = tmp_path / "DJI_0001.SRT"
    srt.write_text(dji_text(PLACES, 25))
    inside = ffmpeg(
        *("-i", clip, "-i", srt, "-map", "0:v", "-map", "1", "-c:v", "copy"),
        *("-c:s", "mov_text", tmp_path / "inside.mp4"),
    )
    for path, source in ((video, str(srt)), (inside, f"the subtitles of {inside}")):
        found = positions_of(path)
        assert found.source == source
        np.testing.assert_allclose(found.times, np.arange(10) / 25, atol=1e-3)
        np.testing.assert_allclose(found.places, PLACES, atol=1e-7)


@pytest.mark.parametrize(
    ("text", "place"),
    [
        # Longitude first, then the number of satellites: Mavic Pro, its old firmware, Mini,
        # Phantom 4 RTK.
        ("HOME(149.02,-20.25) GPS(149.0251,-20.2533,16) BAROMETER:1.9", (-20.2533, 149.0251, 1.9)),
        ("GPS(-1.2218,42.4668,11) Hb:2.5 Hs:1.9", (42.4668, -1.2218, 2.5)),
        ("F/2.8, SS 206, GPS (8.2090, 47.4692, 18), D 24.26m, H 6.00m", (47.4692, 8.2090, 6)),
        (
            "GPS (-58.851745, -34.237922, 15), HOME (-58.847509, -34.232707, -57.98m), H 85.80m",
            (-34.237922, -58.851745, 85.8),
        ),
        ("RTK (-58.851745, -34.237922, 15), H 85.80m", (-34.237922, -58.851745, 85.8)),
        ("GPS(8.2090,47.4692,18)", (47.4692, 8.2090, 0)),
        # Latitude first, then the accuracy: Matrice 300, also east and south.
        ("GPS(40.0001,-3.0001,0.0M) BAROMETER:1.5M", (40.0001, -3.0001, 1.5)),
        ("GPS(-41.3899,174.0177,0.0M) BAROMETER:97.7M", (-41.3899, 174.0177, 97.7)),
        # With names: Mavic 2, Mavic 3, Air 2S; Autel.
        ("[latitude : -20.2533] [longtitude : 149.0251] [ev: 0]", (-20.2533, 149.0251, 0)),
        (
            "[latitude: 59.3023] [longitude: 18.2030] [rel_alt: 1.300 abs_alt: 132.860]",
            (59.3023, 18.2030, 132.86),
        ),
        ("[latitude: 41.4247] [longitude: 2.2341] [altitude: 117.0]", (41.4247, 2.2341, 117)),
        ("GPS(W: 8.6499, N: 53.1665, 12.5m)", (53.1665, -8.6499, 12.5)),
        ("GPS(E:8.6499,S:53.1665,-2m)", (-53.1665, 8.6499, -2)),
        # Unknown format: only one order gives a valid position.
        ("GPS(149.0251,-20.2533,16.5)", (-20.2533, 149.0251, 16.5)),
        ("GPS(-20.2533,149.0251)", (-20.2533, 149.0251, 0)),
        # Known format, decided by the valid range.
        ("GPS(120.5001,57.0002,0.5M) BAROMETER(12.5)", (57.0002, 120.5001, 12.5)),
    ],
)
def test_position_formats_of_drones(clip: Path, tmp_path: Path, text: str, place: object) -> None:
    found = positions_of(with_srt(clip, tmp_path, text))
    np.testing.assert_allclose(found.places, [place])
    assert found.ignored is None


@pytest.mark.parametrize(
    ("text", "tag", "place"),
    [
        ("GPS(40.0001,-3.0001,12.5m)", "+40.0100-003.0100/", (40.0001, -3.0001, 12.5)),
        ("GPS(40.0001,-3.0001,12.5m)", "-03.0100+040.0100/", (-3.0001, 40.0001, 12.5)),
        ("GPS(40.0001,-3.0001,12.5m)", "+52.0000+013.0000/", None),
        ("GPS(40.0001,-3.0001,12.5m)", None, None),
        # The location tag of the video contradicts the usual order of this format.
        ("GPS(40.0001,-3.0001,0.0M)", "-03.0100+040.0100/", (-3.0001, 40.0001, 0)),
        ("GPS(40.0001,-3.0001,12)", "+40.0100-003.0100/", (40.0001, -3.0001, 0)),
        # Radians, as written by some Mavic Air 2.
        (
            "[latitude : 0.698134] [longtitude : -0.052361]",
            "+40.0100-003.0100/",
            (40.000132, -3.000064, 0),
        ),
        ("[latitude : 0.698134] [longtitude : -0.052361]", None, None),
    ],
)
def test_location_tag_of_the_video_decides_the_order(
    clip: Path, ffmpeg: Ffmpeg, tmp_path: Path, *, text: str, tag: str | None, place: object
) -> None:
    words = [] if tag is None else ["-metadata", f"location={tag}"]
    video = ffmpeg("-i", clip, "-c", "copy", *words, tmp_path / "tagged.mp4")
    found = positions_of(with_srt(video, tmp_path, text))
    if place is None:
        assert len(found.times) == 0
        assert found.ignored is not None
        assert "unclear" in found.ignored
    else:
        np.testing.assert_allclose(found.places, [place], atol=1e-5)
        assert found.ignored is None


def test_subtitles_may_start_after_the_video(clip: Path, ffmpeg: Ffmpeg, tmp_path: Path) -> None:
    """The first subtitle of a Mavic Pro starts at 1 s."""
    cues = "".join(
        f"{k}\n00:00:0{k},000 --> 00:00:0{k + 1},000\nGPS(149.025{k},-20.2533,16)\n\n"
        for k in range(1, 5)
    )
    video = with_srt(clip, tmp_path, "")
    srt = video.with_suffix(".srt")
    srt.write_text(cues)
    inside = ffmpeg(
        *("-i", clip, "-i", srt, "-map", "0:v", "-map", "1", "-c:v", "copy"),
        *("-c:s", "mov_text", tmp_path / "inside.mp4"),
    )
    for path in (video, inside):
        found = positions_of(path)
        np.testing.assert_allclose(found.times, np.arange(1, 5), atol=1e-3)
        np.testing.assert_allclose(found.places[:, 1], 149.025 + np.arange(1, 5) * 1e-4)


def with_srt(clip: Path, folder: Path, text: str) -> Path:
    """A copy of a video with a .srt file next to it that has one subtitle, from 0 to 1 s."""
    video = folder / "DJI_0001.mp4"
    shutil.copyfile(clip, video)
    video.with_suffix(".srt").write_text(f"1\n00:00:00,000 --> 00:00:01,000\n{text}\n\n")
    return video


@pytest.mark.parametrize("is_first", [False, True])
def test_path_of_a_gopro_is_read(clip: Path, tmp_path: Path, is_first: bool) -> None:
    down = np.tile([0.0, 1.0, 0.0], (5, 1))
    payloads = [
        (0.4, gps5(PLACES[:4]) + grav(down)),
        (0.2, gps5(PLACES[:2], fix=0)),
        (0.4, gps9(PLACES[4:8], [3, 3, 0, 2])),
    ]
    path = with_gpmf(clip, tmp_path / "gopro.mp4", payloads, is_first=is_first)
    found = positions_of(path)
    np.testing.assert_allclose(found.times, [0, 0.1, 0.2, 0.3, 0.6, 0.7, 0.9], atol=1e-9)
    np.testing.assert_allclose(found.places, PLACES[[0, 1, 2, 3, 4, 5, 7]], atol=2e-7)
    np.testing.assert_allclose(found.gravity_times, np.arange(5) * 0.08, atol=1e-9)
    np.testing.assert_allclose(found.gravity, down, atol=1e-4)


@given(st.data())
@settings(max_examples=100, deadline=None)
def test_damaged_telemetry_raises_nothing(data: st.DataObject) -> None:
    whole = gpmf_nest(b"DEVC", gps5(PLACES), gps9(PLACES, [3] * 10), gpmf(b"SROT", "f", 15.2))
    body = bytearray(whole[: data.draw(st.integers(0, len(whole)))])
    for _ in range(data.draw(st.integers(0, 4)) if body else 0):
        body[data.draw(st.integers(0, len(body) - 1))] = data.draw(st.integers(0, 255))
    read_payload(bytes(body))


def test_positions_of_images_are_interpolated(clip: Path, tmp_path: Path) -> None:
    """16 frames at 25 per second, and three positions at 10 per second from 0.1 s on."""
    payloads = [(0.1, gps5(PLACES[:1], fix=0)), (0.3, gps5(PLACES[1:4]))]
    video = read_video(with_gpmf(clip, tmp_path / "gopro.mp4", payloads))
    frames = np.arange(16, dtype=np.int32)
    image_set = number_images([""], [ChosenImages([f"{k}.png" for k in frames], frames)], [16])
    found = image_positions(image_set, [video], [])
    times = frames / 25
    known = (times >= 0) & (times < 0.4)  # a position is valid until the next one is due
    assert np.isfinite(found.places).all(axis=1).tolist() == known.tolist()
    expected = np.interp(times[known], [0.1, 0.2, 0.3], PLACES[1:4, 1])
    np.testing.assert_allclose(found.places[known, 1], expected, atol=1e-7)


def test_deeply_nested_items_are_read() -> None:
    # Each of 5,000 items contains all following ones.
    data = b"".join(b"DEVC\0\1" + (8 * rest).to_bytes(2, "big") for rest in range(4999, -1, -1))
    payload = read_payload(data)
    assert len(payload.positions) == len(payload.gravity) == 0

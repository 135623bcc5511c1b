"""Positions in containers, as phones, GoPro's cameras and DJI's drones write them."""

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
from colmap_av1.images.positions import image_positions
from colmap_av1.images.takes import count_through
from colmap_av1.video.container import read_file
from colmap_av1.video.facts import read_video
from colmap_av1.video.metadata.gpmf import read_payload
from colmap_av1.video.metadata.positions import Positions, doubtful_place, read_positions

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
def test_one_position_of_a_phone(
    clip: Path, ffmpeg: Ffmpeg, tmp_path: Path, words: list[str], place: tuple[float, ...]
) -> None:
    found = positions_of(ffmpeg("-i", clip, "-c", "copy", *words, tmp_path / "phone.mp4"))
    assert found.place == pytest.approx(place, abs=1e-3)
    assert len(found.times) == 0


@pytest.mark.parametrize("said", ["+00.0000+000.0000/", "+95.0000+018.0686/", "at home", ""])
def test_no_position_that_can_be_one(clip: Path, ffmpeg: Ffmpeg, tmp_path: Path, said: str) -> None:
    words = ["-movflags", "use_metadata_tags", "-metadata"]
    words.append(f"com.apple.quicktime.location.ISO6709={said}")
    path = ffmpeg("-i", clip, "-c", "copy", *words, tmp_path / "phone.mp4")
    assert read_positions(read_file(path)) is None


@pytest.mark.parametrize(
    ("said", "why"),
    [
        ("+95.0000+218.0686/", "at '+95.0000+218.0686/', which is no place on Earth"),
        ("+00.0000+000.0000/", "no place on Earth"),
        ("at home\x1b[2J" + 60 * "!", "at 'at home?[2J!!!"),
        ("-33.8568+151.2153/", None),
        ("", None),
    ],
)
def test_a_place_that_is_none_is_told(said: str, why: str | None) -> None:
    told = doubtful_place((("com.apple.quicktime.location.iso6709", said),))
    if why is None:
        assert told is None
        return
    assert told is not None
    assert why in told
    assert told.isprintable()
    assert len(told) < 140


def test_positions_of_a_path_that_are_none_are_told(clip: Path, tmp_path: Path) -> None:
    wrong, no_fix = PLACES + np.array([40.0, 0, 0]), PLACES * [0, 0, 1]
    payload = gps5(PLACES)
    video = tmp_path / "DJI_0001.mp4"
    shutil.copyfile(clip, video)
    beside = video.with_suffix(".srt")

    def of_gopro(body: bytes) -> tuple[int, str | None]:
        found = read_positions(read_file(with_gpmf(clip, tmp_path / "gopro.mp4", [(0.6, body)])))
        return (len(found.times), found.left_out) if found is not None else (0, None)

    def of_drone(text: str) -> tuple[int, str | None]:
        beside.write_text(text)
        found = read_positions(read_file(video))
        return (len(found.times), found.left_out) if found is not None else (0, None)

    count, told = of_gopro(gps5(np.vstack([PLACES, wrong[:3]])))
    assert count == len(PLACES)
    assert told is not None
    assert told.endswith("gopro.mp4: 3 of its positions can be none on Earth: they are left out")
    for body in (gps5(no_fix), gps5(PLACES, fix=0), payload[:100]):
        count, told = of_gopro(body)
        assert count == 0
        assert told is not None
        assert told.endswith("holds no position: the receiver had no fix, or the track is damaged")
    assert of_gopro(grav(np.eye(3))) == (0, None)

    count, told = of_drone(dji_text(np.vstack([PLACES, wrong[:2]]), 25))
    assert count == len(PLACES)
    assert told is not None
    assert "2 of its positions can be none on Earth" in told
    stamp = "1\n00:00:00,000 --> 00:00:01,000\n"
    count, told = of_drone(f"{stamp}[latitude: abc] [longitude: ] GPS(--,nan,1e999)\n\n")
    assert count == 0
    assert told is not None
    assert "1 of its positions can be none on Earth" in told
    # Without a fix, and subtitles of another kind.
    assert of_drone(dji_text(no_fix, 25)) == (0, None)
    assert of_drone(f"{stamp}Hello there\n\n") == (0, None)


def test_subtitles_beside_a_video_and_in_it(clip: Path, ffmpeg: Ffmpeg, tmp_path: Path) -> None:
    video = tmp_path / "DJI_0001.mp4"
    shutil.copyfile(clip, video)
    beside = tmp_path / "DJI_0001.SRT"
    beside.write_text(dji_text(PLACES, 25))
    inside = ffmpeg(
        *("-i", clip, "-i", beside, "-map", "0:v", "-map", "1", "-c:v", "copy"),
        *("-c:s", "mov_text", tmp_path / "inside.mp4"),
    )
    for path, source in ((video, str(beside)), (inside, f"the subtitles of {inside}")):
        found = positions_of(path)
        assert found.source == source
        np.testing.assert_allclose(found.times, np.arange(10) / 25, atol=1e-3)
        np.testing.assert_allclose(found.places, PLACES, atol=1e-7)


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("HOME(149.02,-20.25) GPS(149.0251,-20.2533,16) BAROMETER:1.9", (-20.2533, 149.0251, 1.9)),
        ("GPS(149.0251,-20.2533,16)", (-20.2533, 149.0251, 16.0)),
        ("F/2.8, SS 206, GPS (149.0251, -20.2533, 16), D 24.26m, H 6.00m", (-20.2533, 149.0251, 6)),
        ("[latitude : 1.5] [longtitude : 2.5] [altitude: 12.3]", (1.5, 2.5, 12.3)),
    ],
)
def test_spellings_of_drones(clip: Path, tmp_path: Path, text: str, place: object) -> None:
    video = tmp_path / "a.mp4"
    shutil.copyfile(clip, video)
    video.with_suffix(".srt").write_text(f"1\n00:00:00,000 --> 00:00:01,000\n{text}\n\n")
    np.testing.assert_allclose(positions_of(video).places, [place])


def test_track_of_a_gopro(clip: Path, tmp_path: Path) -> None:
    down = np.tile([0.0, 1.0, 0.0], (5, 1))
    payloads = [
        (0.4, gps5(PLACES[:4]) + grav(down)),
        (0.2, gps5(PLACES[:2], fix=0)),
        (0.4, gps9(PLACES[4:8], [3, 3, 0, 2])),
    ]
    found = positions_of(with_gpmf(clip, tmp_path / "gopro.mp4", payloads))
    np.testing.assert_allclose(found.times, [0, 0.1, 0.2, 0.3, 0.6, 0.7, 0.9], atol=1e-9)
    np.testing.assert_allclose(found.places, PLACES[[0, 1, 2, 3, 4, 5, 7]], atol=2e-7)
    np.testing.assert_allclose(found.gravity_times, np.arange(5) * 0.08, atol=1e-9)
    np.testing.assert_allclose(found.gravity, down, atol=1e-4)


@given(st.data())
@settings(max_examples=100, deadline=None)
def test_damaged_telemetry_is_left_out(data: st.DataObject) -> None:
    whole = gpmf_nest(b"DEVC", gps5(PLACES), gps9(PLACES, [3] * 10), gpmf(b"SROT", "f", 15.2))
    body = bytearray(whole[: data.draw(st.integers(0, len(whole)))])
    for _ in range(data.draw(st.integers(0, 4)) if body else 0):
        body[data.draw(st.integers(0, len(body) - 1))] = data.draw(st.integers(0, 255))
    read_payload(bytes(body))


def test_images_lie_between_positions(clip: Path, tmp_path: Path) -> None:
    """16 frames at 25 per second, positions at 10 per second from 0.1 s on for 0.3 s."""
    payloads = [(0.1, gps5(PLACES[:1], fix=0)), (0.3, gps5(PLACES[1:4]))]
    video = read_video(with_gpmf(clip, tmp_path / "gopro.mp4", payloads))
    frames = np.arange(16, dtype=np.int32)
    takes = count_through([""], [ChosenImages([f"{k}.png" for k in frames], frames)], [16])
    found = image_positions(takes, [video], [])
    times = frames / 25
    known = (times >= 0) & (times < 0.4)  # one position holds until the next would come
    assert np.isfinite(found.places).all(axis=1).tolist() == known.tolist()
    expected = np.interp(times[known], [0.1, 0.2, 0.3], PLACES[1:4, 1])
    np.testing.assert_allclose(found.places[known, 1], expected, atol=1e-7)


def test_items_within_items_without_end() -> None:
    # Each of 5,000 items holds all that follow.
    data = b"".join(b"DEVC\0\1" + (8 * rest).to_bytes(2, "big") for rest in range(4999, -1, -1))
    payload = read_payload(data)
    assert len(payload.positions) == len(payload.gravity) == 0

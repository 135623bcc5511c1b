"""Cropped, rotated, trimmed and non-square videos: images and keypoints as players show them."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Iterator
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from conftest import AV1, Encode, Ffmpeg, make_frames
from databases import keypoints_of
from hypothesis import given, settings
from hypothesis import strategies as st

from colmap_av1.cli import reports
from colmap_av1.errors import OptionError, VideoError
from colmap_av1.match import match
from colmap_av1.motion.info import read_info
from colmap_av1.motion.reading import read_motion
from colmap_av1.options import CameraOptions, DensityOptions, MatchOptions, VerifyOptions
from colmap_av1.tracks.tracks import build_tracks
from colmap_av1.video.decoding import decode_frames
from colmap_av1.video.display import (
    Display,
    shown_picture,
    shown_points,
    shown_size,
    turn_of_matrix,
)
from colmap_av1.video.encode import encode as convert
from colmap_av1.video.facts import read_video

# The presets choose tracks by cells of the picture, which differ in cropped or scaled pictures.
PAIRS = VerifyOptions(verify="pairs")
ALL_TRACKS = MatchOptions(density=DensityOptions(preset="dense"), verify=PAIRS)
TURNS = [
    ((a, 0), (0, d)) if not swapped else ((0, a), (d, 0))
    for swapped in (False, True)
    for a in (1, -1)
    for d in (1, -1)
]


def keypoints(database: Path) -> list[np.ndarray]:
    return list(keypoints_of(database).values())


def images_of_ffmpeg(ffmpeg: Ffmpeg, video: Path, folder: Path, *words: str) -> list[np.ndarray]:
    """Write the frames of a video to a folder with ffmpeg, and read them."""
    folder.mkdir()
    ffmpeg("-i", video, *words, folder / "%04d.png")
    return [cv2.imread(str(path)) for path in sorted(folder.iterdir())]


def boxes(data: bytes, start: int, end: int) -> Iterator[tuple[int, int, bytes]]:
    """Start, size and type of the MP4 boxes in a range of bytes."""
    while start < end:
        size = int.from_bytes(data[start : start + 4], "big")
        yield start, size, data[start + 4 : start + 8]
        start += size


def with_clean_aperture(
    data: bytes, size: tuple[int, int], crop: tuple[int, int, int, int]
) -> bytes:
    """Add a 'clap' box (ISO/IEC 14496-12, 12.1.4) to an MP4 file with its index at the end."""
    left, top, right, bottom = crop
    width, height = size[0] - left - right, size[1] - top - bottom
    # Width, height and the offset of the centre, as fractions.
    values = (width, 1, height, 1, left - right, 2, top - bottom, 2)
    clap = struct.pack(">I4s8i", 40, b"clap", *values)
    start, end = 0, len(data)
    sizes = []
    for name in (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stsd"):
        at, length, _ = next(box for box in boxes(data, start, end) if box[2] == name)
        sizes.append(at)
        start, end = at + 8, at + length
    at, length, _ = next(boxes(data, start + 8, end))
    sizes.append(at)
    grown = bytearray(data[: at + length] + clap + data[at + length :])
    for at in sizes:
        grown[at : at + 4] = (int.from_bytes(grown[at : at + 4], "big") + 40).to_bytes(4, "big")
    return bytes(grown)


@settings(deadline=None)
@given(
    st.sampled_from(TURNS),
    st.tuples(*[st.integers(0, 3)] * 4),
    st.tuples(st.integers(8, 12), st.integers(8, 12)),
)
def test_points_move_with_their_pixels(
    turn: tuple[tuple[int, int], tuple[int, int]],
    crop: tuple[int, int, int, int],
    size: tuple[int, int],
) -> None:
    width, height = size
    display = Display(crop, turn)
    # The value of each pixel is its position.
    y, x = np.mgrid[:height, :width]
    stored = np.stack([x, y, np.zeros_like(x)], axis=2).astype(np.uint8)
    shown = shown_picture(stored, display)
    assert shown.shape[1::-1] == shown_size(size, display)
    centres = np.stack([x, y], axis=2).reshape(-1, 2).astype(np.float32) + 0.5
    points = shown_points(centres, size, display)
    inside = np.all((points > 0) & (points < shown_size(size, display)), axis=1)
    assert inside.sum() == shown.shape[0] * shown.shape[1]
    column, row = np.floor(points[inside]).astype(int).T
    np.testing.assert_array_equal(shown[row, column, :2], centres[inside] - 0.5)


def test_turn_of_matrix_accepts_only_quarter_turns() -> None:
    one = 1 << 16
    assert turn_of_matrix([0, one, 0, -one, 0, 0, 0, 0, 1 << 30]) == ((0, -1), (1, 0))
    assert turn_of_matrix([2 * one, 0, 0, 0, one, 0, 0, 0, 1 << 30]) == ((1, 0), (0, 1))
    assert turn_of_matrix([one, one, 0, -one, one, 0, 0, 0, 1 << 30]) is None
    assert turn_of_matrix([one, 0, 0, one, 0, 0, 0, 0, 1 << 30]) is None
    assert turn_of_matrix([0] * 9) is None


@pytest.mark.parametrize("angle", [0, 90, 180, 270])
@pytest.mark.parametrize("flip", [[], ["-display_hflip"]])
def test_rotated_pictures_agree_with_ffmpeg_and_tracks_with_pictures(
    clip: Path, ffmpeg: Ffmpeg, tmp_path: Path, angle: int, flip: list[str]
) -> None:
    words = ["-display_rotation", str(angle), *flip]
    turned = ffmpeg(*words, "-i", clip, "-c", "copy", tmp_path / "turned.mp4")
    display = read_video(turned).display
    assert display.is_mirrored == bool(flip)
    if not flip:
        assert display.rotation == angle
    stored = next(decode_frames(clip))[1]
    (first,) = images_of_ffmpeg(ffmpeg, turned, tmp_path / "cut", "-frames:v", "1")
    shown = next(decode_frames(turned))[1]
    np.testing.assert_array_equal(shown, shown_picture(stored, display))
    # FFmpeg and PyAV round differently when they convert YUV to RGB.
    assert np.abs(shown.astype(int) - first.astype(int)).mean() < 2

    tracks = build_tracks(read_motion(clip))
    moved = tracks.as_displayed(display)
    np.testing.assert_array_equal(moved.offsets, tracks.offsets)
    # Tracks start at the corner of four pixels, which must be the same before and after.
    starts = tracks.frame == 0
    around = [
        np.sort([picture[row + i, column + j] for i in (-1, 0) for j in (-1, 0)], axis=0)
        for picture, observed in ((stored, tracks.xy), (shown, moved.xy))
        for column, row in [np.rint(observed[starts]).astype(int).T]
    ]
    assert starts.sum() > 300
    np.testing.assert_array_equal(around[0], around[1])


def test_rotation_by_other_angles_is_refused(clip: Path, ffmpeg: Ffmpeg, tmp_path: Path) -> None:
    turned = ffmpeg("-display_rotation", "30", "-i", clip, "-c", "copy", tmp_path / "turned.mp4")
    with pytest.raises(VideoError, match="90 degrees"):
        match(tmp_path / "a.db", turned)
    assert not (tmp_path / "a.db").exists()


@pytest.mark.parametrize("ending", ["mp4", "mkv"])
@pytest.mark.parametrize("angle", [0, 90])
def test_cropping_by_the_container_is_applied(
    clip: Path, ffmpeg: Ffmpeg, tmp_path: Path, ending: str, angle: int
) -> None:
    crop = (12, 4, 20, 10)
    turned = ffmpeg(
        "-display_rotation", str(angle), "-i", clip, "-c", "copy", tmp_path / "turned.mp4"
    )
    cropped = tmp_path / "cropped.mp4"
    cropped.write_bytes(with_clean_aperture(turned.read_bytes(), (192, 128), crop))
    if ending == "mkv":
        if angle:
            pytest.skip("FFmpeg writes no display matrix to Matroska")
        cropped = ffmpeg("-i", cropped, "-c", "copy", tmp_path / "cropped.mkv")
    assert read_video(cropped).display.crop == crop
    assert read_info(cropped).display.crop == crop
    first, *_ = images_of_ffmpeg(ffmpeg, cropped, tmp_path / "cut", "-frames:v", "1")
    shown = next(decode_frames(cropped))[1]
    assert shown.shape == first.shape == ((160, 114, 3) if angle else (114, 160, 3))
    assert np.abs(shown.astype(int) - first.astype(int)).mean() < 2

    by_pairs = MatchOptions(verify=PAIRS)
    report = match(tmp_path / "a.db", cropped, image_path=tmp_path / "images", options=by_pairs)
    assert report.num_inliers > 1000
    with sqlite3.connect(tmp_path / "a.db") as connection:
        size = connection.execute("SELECT width, height FROM cameras").fetchone()
    assert size == shown.shape[1::-1]
    plain = build_tracks(read_motion(clip)).xy
    for xy in keypoints(tmp_path / "a.db"):
        assert np.all((xy >= 0) & (xy <= size))
        # Moved back to the stored picture, each keypoint is an observation of a track.
        x, y = xy.T if not angle else (size[1] - xy[:, 1], xy[:, 0])
        back = np.stack([x + crop[0], y + crop[1]], axis=1)
        distance = np.abs(plain[None, :] - back[:50, None]).sum(axis=2).min(axis=1)
        assert distance.max() < 1e-3


def test_metadata_that_looks_like_cropping_is_ignored(
    clip: Path, ffmpeg: Ffmpeg, tmp_path: Path
) -> None:
    words = "x\n    Side data:\n      Frame Cropping: 8/8/8/8"
    odd = ffmpeg(
        *("-i", clip, "-c", "copy", "-metadata:s:v", f"handler_name={words}"), tmp_path / "odd.mp4"
    )
    assert read_video(odd).display.crop == (0, 0, 0, 0)


def test_edit_list_of_a_trimmed_clip_is_applied(clip: Path, ffmpeg: Ffmpeg, tmp_path: Path) -> None:
    trimmed = ffmpeg("-ss", "0.2", "-i", clip, "-c", "copy", tmp_path / "trimmed.mp4")
    assert read_video(clip).presented is None
    presented = read_video(trimmed).presented
    assert presented is not None
    assert presented.tolist() == list(range(5, 16))
    assert read_info(trimmed).num_cut == 5
    cut = images_of_ffmpeg(ffmpeg, trimmed, tmp_path / "cut")
    decoded = list(decode_frames(trimmed))
    assert [index for index, _ in decoded] == list(range(len(cut))) == list(range(11))
    for (_, ours), theirs in zip(decoded, cut, strict=True):
        assert np.abs(ours.astype(int) - theirs.astype(int)).mean() < 2

    # Images are the frames that players show, but tracks may begin in earlier frames.
    tracks = build_tracks(read_motion(clip))
    shown = tracks.as_displayed(Display(), presented)
    assert shown.num_frames == 11
    np.testing.assert_array_equal(shown.frame, tracks.frame[tracks.frame >= 5] - 5)
    for name, folder in (("new", "images"), ("cut", "cut")):
        report = match(
            tmp_path / f"{name}.db", trimmed, image_path=tmp_path / folder, options=ALL_TRACKS
        )
        assert report.num_frames == report.num_images == 11
        for index, xy in enumerate(keypoints(tmp_path / f"{name}.db")):
            assert len(xy) > 300
            observed = set(map(tuple, tracks.xy[tracks.frame == index + 5].tolist()))
            assert observed.issuperset(map(tuple, xy.tolist()))


def test_edit_list_of_a_clip_with_b_frames_is_applied(
    encode: Encode, ffmpeg: Ffmpeg, tmp_path: Path
) -> None:
    how = ["-c:v", "libx264", "-bf", "3", "-g", "100", "-crf", "18"]
    phone = encode(make_frames(24), tmp_path / "phone.mp4", *how)
    trimmed = ffmpeg("-ss", "0.28", "-i", phone, "-c", "copy", tmp_path / "trimmed.mp4")
    with av.open(str(trimmed)) as container:
        expected = [frame.to_ndarray(format="bgr24") for frame in container.decode(video=0)]
    assert 10 < len(expected) < 24
    decoded = [image for _, image in decode_frames(trimmed)]
    np.testing.assert_array_equal(decoded, expected)
    report = match(tmp_path / "a.db", trimmed, image_path=tmp_path / "images")
    assert report.num_images == len(expected)
    assert report.num_coded_frames == 24
    for name, image in zip(sorted((tmp_path / "images").iterdir()), expected, strict=True):
        np.testing.assert_array_equal(cv2.imread(str(name)), image)
    check_motion(tmp_path / "a.db")
    encoded = convert(trimmed, tmp_path / "av1.mp4")
    assert encoded.num_frames == len(expected)
    with av.open(str(encoded.output)) as container:
        times = [
            float(packet.pts * packet.time_base) for packet in container.demux() if packet.size
        ]
    np.testing.assert_allclose(times, np.arange(len(expected)) / 25, atol=1e-3)


def check_motion(database: Path) -> None:
    """Check that keypoints move 2 or 4 px to the left per image, like the layers of the scene."""
    with sqlite3.connect(database) as connection:
        rows = connection.execute("SELECT pair_id, rows, data FROM matches").fetchall()
        ids = [i for (i,) in connection.execute("SELECT image_id FROM images ORDER BY image_id")]
    xy = dict(zip(ids, keypoints(database), strict=True))
    checked = 0
    for pair_id, count, data in rows:
        i, j = divmod(pair_id, 2147483647)
        if j - i != 1:
            continue
        a, b = np.frombuffer(data, np.uint32).reshape(count, 2).T
        step = xy[j][b] - xy[i][a]
        assert np.median(np.minimum(np.abs(step[:, 0] + 2), np.abs(step[:, 0] + 4))) < 0.4
        checked += 1
    assert checked == len(ids) - 1


@pytest.mark.parametrize("angle", [0, 90])
def test_non_square_pixels_get_a_camera_with_two_focal_lengths(
    encode: Encode, ffmpeg: Ffmpeg, tmp_path: Path, angle: int
) -> None:
    clip = encode(make_frames(10), tmp_path / "c.mp4", *AV1, "-vf", "setsar=3/2")
    turned = ffmpeg("-display_rotation", str(angle), "-i", clip, "-c", "copy", tmp_path / "t.mp4")
    aspect = 1.5 if angle == 0 else 1 / 1.5
    assert read_video(turned).display.pixel_aspect == pytest.approx(aspect)
    assert "pixel aspect" in dict(info_rows(turned))

    report = match(tmp_path / "a.db", turned, image_path=tmp_path / "images")
    # The images do not determine the focal length.
    assert all("focal length" in warning for warning in report.warnings)
    with sqlite3.connect(tmp_path / "a.db") as connection:
        model, params = connection.execute("SELECT model, params FROM cameras").fetchone()
    fx, fy, *_ = np.frombuffer(params)
    assert model == 4  # OPENCV
    # In square pixels, 288x128 or rotated, this is the usual assumed focal length.
    assert (fx * aspect, fy) == pytest.approx((0.9 * 288 / 1.5 * (1.5 if angle == 0 else 1),) * 2)
    # Images keep the stored pixels, like those that ffmpeg writes.
    (first,) = images_of_ffmpeg(ffmpeg, turned, tmp_path / "cut", "-frames:v", "1")
    written = cv2.imread(str(tmp_path / "images" / "frame_000000.png"))
    assert written.shape == first.shape

    options = MatchOptions(camera=CameraOptions("SIMPLE_RADIAL"), verify=PAIRS)
    (warning,) = match(tmp_path / "b.db", turned, options=options).warnings
    assert "SIMPLE_RADIAL" in warning


def test_conversion_to_a_format_without_pixel_aspect_is_refused(
    encode: Encode, tmp_path: Path
) -> None:
    clip = encode(make_frames(10), tmp_path / "c.mp4", *AV1, "-vf", "setsar=3/2")
    with pytest.raises(OptionError, match="aspect"):
        convert(clip, tmp_path / "d.ivf")
    convert(clip, tmp_path / "d.webm")
    assert read_video(tmp_path / "d.webm").display.pixel_aspect == pytest.approx(1.5)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["c.mp4", "d.webm"]


def info_rows(video: Path) -> list[tuple[str, str]]:
    return reports.info_rows(read_info(video))


def test_keypoints_fit_images_scaled_to_square_pixels(
    encode: Encode, ffmpeg: Ffmpeg, tmp_path: Path
) -> None:
    clip = encode(make_frames(10), tmp_path / "c.mp4", *AV1, "-vf", "setsar=3/2")
    images_of_ffmpeg(ffmpeg, clip, tmp_path / "cut", "-vf", "scale=288:128,setsar=1")
    report = match(tmp_path / "a.db", clip, image_path=tmp_path / "cut", options=ALL_TRACKS)
    assert (report.num_images, report.num_written_images, report.warnings) == (10, 0, ())
    with sqlite3.connect(tmp_path / "a.db") as connection:
        row = connection.execute("SELECT model, width, height, params FROM cameras").fetchone()
    assert row[:3] == (2, 288, 128)
    assert np.frombuffer(row[3])[0] == pytest.approx(0.9 * 288)
    match(tmp_path / "b.db", clip, options=ALL_TRACKS)
    for square, stored in zip(
        keypoints(tmp_path / "a.db"), keypoints(tmp_path / "b.db"), strict=True
    ):
        np.testing.assert_allclose(square, stored * [1.5, 1], atol=1e-4)


def test_superres_tracks_are_in_pixels_of_the_upscaled_picture(
    encode: Encode, ffmpeg: Ffmpeg, tmp_path: Path
) -> None:
    """With superres, pictures are coded with a smaller width."""
    rng = np.random.default_rng(3)
    scene = cv2.GaussianBlur(rng.integers(0, 256, (128, 400, 3), dtype=np.uint8), (0, 0), 3)
    scene = cv2.normalize(scene, None, 0, 255, cv2.NORM_MINMAX)
    pan = np.stack([scene[:, 6 * i : 6 * i + 256] for i in range(12)])
    how = ["-c:v", "libsvtav1", "-preset", "8", "-crf", "20", "-svtav1-params"]
    how += ["superres-mode=1:superres-denom=12:superres-kf-denom=12"]
    clip = encode(pan, tmp_path / "clip.mp4", *how)
    assert 171 in {frame.header["frame_width"] for frame in read_motion(clip)}
    tracks = build_tracks(read_motion(clip))
    is_next = (np.diff(tracks.frame) == 1) & (np.diff(tracks.xy[:, 1]) < 1)
    steps = np.diff(tracks.xy, axis=0)[is_next]
    assert np.median(steps[:, 0]) == pytest.approx(-6, abs=0.3)
    assert tracks.xy[:, 0].max() > 200
    by_pairs = MatchOptions(verify=PAIRS)
    match(tmp_path / "a.db", clip, image_path=tmp_path / "images", options=by_pairs)
    (first,) = images_of_ffmpeg(ffmpeg, clip, tmp_path / "cut", "-frames:v", "1")
    written = cv2.imread(str(tmp_path / "images" / "frame_000000.png"))
    assert written.shape == first.shape == (128, 256, 3)
    assert read_video(clip).display.pixel_aspect == pytest.approx(1, abs=5e-3)

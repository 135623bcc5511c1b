from __future__ import annotations

from pathlib import Path

import av
import cv2
import numpy as np
import pycolmap
import pytest
import render_scene
from conftest import PROJECT, Encode, Ffmpeg
from hypothesis import given
from hypothesis import strategies as st

from colmap_av1.cli import main
from colmap_av1.errors import VideoError
from colmap_av1.match import match
from colmap_av1.options import (
    CameraOptions,
    EncodeOptions,
    ImageOptions,
    MatchOptions,
    ReconstructOptions,
    TrackOptions,
)
from colmap_av1.reconstruct import reconstruct
from colmap_av1.tracks.video_tracks import open_source, track_video
from colmap_av1.util.run_context import RunContext
from colmap_av1.video.coded_size import coded_size, with_downscale
from colmap_av1.video.decoding import decode_frames
from colmap_av1.video.encode import encode as encode_video
from colmap_av1.video.encode import stream_of
from colmap_av1.video.facts import read_video

NUM_FRAMES = 8


@pytest.fixture(scope="module")
def courtyard(ffmpeg: Ffmpeg, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first frames of the rendered clip, 640x360, as H.264."""
    words = ("-frames:v", str(NUM_FRAMES), "-c:v", "libx264", "-crf", "10")
    folder = tmp_path_factory.mktemp("courtyard")
    return ffmpeg("-i", PROJECT / "examples" / "scene.mp4", *words, folder / "scene.mp4")


sides = st.integers(16, 8192)


@given(sides, sides, st.floats(1, 16))
def test_coded_size_keeps_the_aspect_ratio(width: int, height: int, downscale: float) -> None:
    options = EncodeOptions(downscale=downscale)
    coded = coded_size((width, height), options)
    if downscale == 1:
        assert coded == (width, height)
        return
    for full, small in zip((width, height), coded, strict=True):
        assert small % 2 == 0
        assert small >= 2
        assert abs(small - full / downscale) <= 1 or small == 2


@given(sides, sides)
def test_only_large_pictures_are_downscaled(width: int, height: int) -> None:
    options = with_downscale(EncodeOptions(), (width, height))
    assert options.downscale is not None
    if width * height < 2_000_000:
        assert options.downscale == 1
    kept = width * height / options.downscale**2
    assert kept >= min(width * height, 500_000)
    assert with_downscale(EncodeOptions(downscale=3), (width, height)).downscale == 3


def test_downscale_of_usual_sizes() -> None:
    sizes = [(1280, 720), (1080, 1920), (2704, 1520), (3840, 2160)]
    assert [with_downscale(EncodeOptions(), size).downscale for size in sizes] == [1, 2, 2, 4]


@pytest.mark.parametrize(("size", "downscale"), [((322, 242), 2.0), ((333, 251), 3.0)])
def test_downscaled_pictures_are_aligned_with_full_ones(
    encode: Encode, tmp_path: Path, size: tuple[int, int], downscale: float
) -> None:
    """The corners coincide: an offset of half a pixel would shift every keypoint."""
    rng = np.random.default_rng(1)
    noise = cv2.GaussianBlur(rng.standard_normal((size[1], size[0], 3)), (0, 0), 3 * downscale)
    picture = np.clip(128 + 40 * noise / noise.std(), 0, 255).astype(np.uint8)
    source = encode(picture[None].repeat(2, axis=0), tmp_path / "full.mkv", "-c:v", "ffv1")
    options = EncodeOptions("libaom", quality=5, downscale=downscale)
    report = encode_video(source, tmp_path / "small.mp4", options=options)
    small = next(iter(decode_frames(report.output)))[1]
    width, height = coded_size(size, options)
    assert small.shape == (height, width, 3)
    found = cv2.cvtColor(small, cv2.COLOR_BGR2GRAY).astype(np.float32)
    full = cv2.cvtColor(next(iter(decode_frames(source)))[1], cv2.COLOR_BGR2GRAY)
    along_x, along_y = size[0] / width, size[1] / height
    to_full = np.array([[along_x, 0, along_x / 2 - 0.5], [0, along_y, along_y / 2 - 0.5]])
    how = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    soft = cv2.GaussianBlur(full.astype(np.float32), (0, 0), downscale / 2)
    expected = cv2.warpAffine(soft, to_full, (width, height), flags=how)
    inner = np.s_[8:-8, 8:-8]
    slopes = [cv2.Sobel(expected, cv2.CV_32F, *d, scale=1 / 8)[inner] for d in ((1, 0), (0, 1))]
    columns = np.stack([*(s.ravel() for s in slopes), np.ones(slopes[0].size)], axis=1)
    shift = np.linalg.lstsq(columns, (expected - found)[inner].ravel(), rcond=None)[0][:2]
    assert np.abs(shift).max() < 0.02


def test_keypoints_and_images_have_the_size_of_the_video(courtyard: Path, tmp_path: Path) -> None:
    options = MatchOptions(
        encode=EncodeOptions("libaom", downscale=2), keep_stream=tmp_path / "stream.mp4"
    )
    database, frames = tmp_path / "a.db", tmp_path / "frames"
    match(database, courtyard, image_path=frames, options=options)
    with av.open(str(tmp_path / "stream.mp4")) as container:
        assert (container.streams.video[0].width, container.streams.video[0].height) == (320, 180)
    for index, picture in decode_frames(courtyard):
        written = cv2.imread(str(frames / f"frame_{index:06d}.png"))
        np.testing.assert_array_equal(written, picture)
    with pycolmap.Database.open(database) as opened:
        (camera,) = opened.read_all_cameras()
        images = sorted(opened.read_all_images(), key=lambda image: str(image.name))
        xy = {k: opened.read_keypoints(i.image_id)[:, :2] for k, i in enumerate(images)}
        matches = opened.read_matches(images[0].image_id, images[4].image_id)
    assert (camera.width, camera.height) == (640, 360)
    everywhere = np.concatenate(list(xy.values()))
    assert (everywhere.max(axis=0) > [600, 330]).all()
    scene = render_scene.build_scene()
    truth, visible = render_scene.transfer(scene, xy[0][matches[:, 0]], 0, 4)
    error = np.linalg.norm(truth - xy[4][matches[:, 1]], axis=1)[visible]
    assert len(error) > 200
    # Refined in full pictures: with motion of the downscaled ones only, the error is twice that.
    assert np.median(error) < 0.25


def test_model_of_a_downscaled_video_has_full_size(courtyard: Path, tmp_path: Path) -> None:
    encode = EncodeOptions("libaom", downscale=2)
    camera = CameraOptions(camera_model="PINHOLE", camera_params="520,520,320,180")
    match_options = MatchOptions(encode=encode, camera=camera)
    options = ReconstructOptions(match=match_options)
    report = reconstruct(courtyard, tmp_path / "out", options=options)
    assert report.num_registered == NUM_FRAMES
    assert report.conversion is not None
    assert "320x180" in report.conversion
    assert report.seconds["refinement"] > 0
    model = pycolmap.Reconstruction(tmp_path / "out" / "sparse" / "0")
    (pinhole,) = model.cameras.values()
    assert (pinhole.width, pinhole.height) == (640, 360)
    written = cv2.imread(str(min((tmp_path / "out" / "images").iterdir())))
    assert written.shape == (360, 640, 3)
    scene = render_scene.build_scene()
    seen = [(o.image_id, o.point2D_idx) for p in model.points3D.values() for o in p.track.elements]
    xy = np.array([model.images[image].points2D[index].xy for image, index in seen])
    assert (xy.max(axis=0) > [600, 330]).all()
    projected = model.compute_mean_reprojection_error()
    assert projected < 0.7
    centres = {i.name: i.projection_center() for i in model.images.values()}
    found = np.array([centres[name] for name in sorted(centres)])
    truth = scene.cam_from_world[:NUM_FRAMES]
    true_centres = -np.einsum("nji,nj->ni", truth[:, :, :3], truth[:, :, 3])
    similar = pycolmap.estimate_sim3d(found, true_centres)
    off = np.array([similar * centre for centre in found]) - true_centres
    extent = np.linalg.norm(np.ptp(true_centres, axis=0))
    assert np.sqrt((off**2).sum(axis=1).mean()) < 0.02 * extent


def test_sigma_is_in_pixels_of_the_video(courtyard: Path, tmp_path: Path) -> None:
    found = {}
    for downscale in (1, 2):
        options = MatchOptions(
            encode=EncodeOptions("libaom", downscale=downscale), tracks=TrackOptions(min_length=3)
        )
        context = RunContext()
        with open_source(
            read_video(courtyard), options.source, next_to=tmp_path / "x", context=context
        ) as source:
            found[downscale] = track_video(
                source, options.tracking, one_size=True, context=context
            ).tracks
    assert {(t.width, t.height) for t in found.values()} == {(640, 360)}
    ratio = np.median(found[2].sigma) / np.median(found[1].sigma)
    assert 1.3 < ratio < 3


def test_kept_stream_of_another_size_is_encoded_again(courtyard: Path, tmp_path: Path) -> None:
    stream = tmp_path / "stream.mp4"
    half = EncodeOptions("libaom", downscale=2)
    assert not stream_of(courtyard, stream, options=half).reused
    assert stream_of(courtyard, stream, options=half).reused
    assert not stream_of(courtyard, stream, options=EncodeOptions("libaom")).reused
    assert read_video(stream).picture_size == (640, 360)
    assert stream_of(courtyard, stream, options=EncodeOptions("libaom", downscale=1)).reused


def test_rotated_video_is_downscaled(courtyard: Path, ffmpeg: Ffmpeg, tmp_path: Path) -> None:
    turned = ffmpeg(
        *("-display_rotation", "90", "-i", courtyard, "-frames:v", "4"),
        *("-c", "copy", tmp_path / "turned.mp4"),
    )
    options = MatchOptions(
        encode=EncodeOptions("libaom", downscale=3), keep_stream=tmp_path / "stream.mp4"
    )
    report = match(tmp_path / "a.db", turned, image_path=tmp_path / "frames", options=options)
    assert report.num_verified_pairs > 0
    assert read_video(tmp_path / "stream.mp4").picture_size == (120, 214)
    with pycolmap.Database.open(tmp_path / "a.db") as opened:
        xy = np.concatenate(
            [opened.read_keypoints(i.image_id)[:, :2] for i in opened.read_all_images()]
        )
        (camera,) = opened.read_all_cameras()
    assert (camera.width, camera.height) == (360, 640)
    assert 500 < xy[:, 1].max() <= 640
    assert xy[:, 0].max() <= 360


def test_large_pictures_are_downscaled_if_only_motion_is_needed(
    encode: Encode, tmp_path: Path
) -> None:
    rng = np.random.default_rng(2)
    wide = cv2.resize(rng.integers(0, 256, (136, 260, 3), dtype=np.uint8), (2080, 1088))
    frames = np.stack([wide[:1080, 8 * k : 8 * k + 1920] for k in range(4)])
    video = encode(frames, tmp_path / "phone.mp4", "-c:v", "libx264", "-preset", "ultrafast")
    stream = tmp_path / "stream.mp4"
    options = MatchOptions(
        keep_stream=stream,
        encode=EncodeOptions("libaom"),
        images=ImageOptions(image_name="%06d.jpg"),
    )
    report = match(tmp_path / "a.db", video, image_path=tmp_path / "frames", options=options)
    assert report.num_images == 4
    assert read_video(stream).picture_size == (960, 540)
    assert {p.shape for p in map(cv2.imread, map(str, (tmp_path / "frames").iterdir()))} == {
        (1080, 1920, 3)
    }
    with pycolmap.Database.open(tmp_path / "a.db") as opened:
        xy = [opened.read_keypoints(i.image_id)[:, :2] for i in opened.read_all_images()]
        ids = [i.image_id for i in opened.read_all_images()]
        matches = opened.read_matches(ids[0], ids[1])
    moved = xy[1][matches[:, 1]] - xy[0][matches[:, 0]]
    np.testing.assert_allclose(np.median(moved, axis=0), [-8, 0], atol=0.1)
    # The encode command keeps the size, because its output is a video in its own right.
    assert main(["encode", "--video", str(video), "--output", str(tmp_path / "out.mp4")]) == 0
    assert read_video(tmp_path / "out.mp4").picture_size == (1920, 1080)


def test_stream_of_another_size_is_refused(
    courtyard: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Some encoders pad pictures to whole blocks."""
    monkeypatch.setattr("colmap_av1.video.encode.scaling", lambda options: ["scale=336:192"])
    options = MatchOptions(encode=EncodeOptions("libaom", downscale=2))
    with pytest.raises(VideoError, match="336x192"):
        match(tmp_path / "a.db", courtyard, options=options)
    assert not list(tmp_path.iterdir())

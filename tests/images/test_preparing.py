from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from conftest import AV1, PROJECT, Encode, Ffmpeg, make_frames

from colmap_av1.errors import ImageError, VideoError
from colmap_av1.images.files import write_images
from colmap_av1.images.names import image_names
from colmap_av1.images.preparing import PreparedImages, prepare_images
from colmap_av1.options import EncodeOptions, ImageOptions, MatchOptions, ReadOptions
from colmap_av1.util.progress import Clock
from colmap_av1.util.run_context import RunContext
from colmap_av1.video.decoding import decode_frames
from colmap_av1.video.encode import stream_of
from colmap_av1.video.facts import read_video

OPTIONS = MatchOptions()
# Not used, because no video here is converted to a temporary stream.
NEXT_TO = Path("absent/a.db")
LAYERS = PROJECT / "tests" / "data" / "conformance" / "svc_L2T1.ivf"


def prepared(
    video: Path,
    folder: Path | None = None,
    options: MatchOptions = OPTIONS,
    listed: Mapping[str, tuple[int, int]] | None = None,
) -> PreparedImages:
    return prepare_images(
        read_video(video, options.read.operating_point),
        folder,
        options,
        listed=listed or {},
        next_to=NEXT_TO,
        context=RunContext(),
    )


def test_no_picture_is_decoded_without_an_image_folder(clip: Path) -> None:
    clock, stages = Clock(), set()
    found = prepare_images(
        read_video(clip),
        None,
        replace(OPTIONS, images=ImageOptions(num_images=5)),
        listed={},
        next_to=NEXT_TO,
        context=RunContext(clock, lambda stage, done, total: stages.add(stage)),
    )
    assert "recognising" not in stages
    assert "decoding" not in clock.seconds
    assert found.tracked.chosen.names == image_names("frame_%06d.png", found.tracked.chosen.frames)
    assert found.shown.size == (192, 128)
    assert found.shown.pixel_aspect == 1.0


def test_tracks_are_in_pixels_of_scaled_images(clip: Path, tmp_path: Path) -> None:
    """The factors along x and y differ, as with programs that round sizes to even numbers."""
    (tmp_path / "images").mkdir()
    for index, picture in decode_frames(clip):
        small = cv2.resize(picture, (96, 63), interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(tmp_path / "images" / f"{index + 1}.png"), small)
    found = prepared(clip, tmp_path / "images")
    assert found.shown.size == (found.tracked.tracks.width, found.tracked.tracks.height) == (96, 63)
    assert found.tracked.chosen.names == [f"{i + 1}.png" for i in range(16)]
    factor = np.array([96 / 192, 63 / 128])
    in_video = prepared(clip).tracked.tracks
    np.testing.assert_allclose(found.tracked.tracks.xy, in_video.xy * factor, rtol=1e-6)
    # A pixel of the images is 2 video pixels wide and 128 / 63 high.
    assert found.shown.pixel_aspect == pytest.approx(2 / (128 / 63))
    listed = {f"{i}.png": (96, 63) for i in range(16)}
    assert prepared(clip, listed=listed).shown.size == (96, 63)


@pytest.mark.parametrize(("operating_point", "size"), [(0, (352, 288)), (1, (176, 144))])
def test_layers_of_a_scalable_stream_have_their_own_size(
    tmp_path: Path, operating_point: int, size: tuple[int, int]
) -> None:
    options = replace(OPTIONS, read=ReadOptions(operating_point=operating_point))
    first = prepared(LAYERS, tmp_path, options)
    assert first.shown.size == (first.tracked.tracks.width, first.tracked.tracks.height) == size
    names, frames = first.tracked.chosen.names, first.tracked.chosen.frames
    write_images(LAYERS, tmp_path, names, frames.tolist(), operating_point=operating_point)
    # A second run accepts these images.
    assert prepared(LAYERS, tmp_path, options).shown.size == size


def test_stream_of_another_size_than_its_video_is_refused(
    encode: Encode, ffmpeg: Ffmpeg, tmp_path: Path
) -> None:
    """Some encoders only support certain sizes."""
    video = encode(make_frames(6), tmp_path / "v.mp4", "-c:v", "libx264")
    stream = tmp_path / "stream.mp4"
    options = replace(OPTIONS, encode=EncodeOptions(encoder="libaom"), keep_stream=str(stream))
    stream_of(video, stream, options=options.encode)
    with av.open(str(stream)) as opened:
        mark = opened.metadata["comment"]
    larger = encode(make_frames(6, 208, 144), tmp_path / "larger.mp4", *AV1)
    ffmpeg("-i", larger, "-c", "copy", "-metadata", f"comment={mark}", stream)
    os.utime(stream)
    with pytest.raises(VideoError, match="208x144"):
        prepared(video, options=options)


def test_existing_images_of_another_video_are_refused(
    clip: Path, encode: Encode, tmp_path: Path
) -> None:
    other = encode(np.ascontiguousarray(make_frames(16)[:, ::-1]), tmp_path / "other.mp4")
    names = image_names("frame_%06d.png", range(16))
    write_images(other, tmp_path / "images", names[:3], range(3))
    with pytest.raises(ImageError, match=r"frame_000000\.png"):
        prepared(clip, tmp_path / "images")
    write_images(clip, tmp_path / "own", names[:3], range(3))
    assert prepared(clip, tmp_path / "own").tracked.chosen.names == names
    # Another program numbered every fifth frame from 0.
    write_images(clip, tmp_path / "fifth", names[:3], range(0, 15, 5))
    with pytest.raises(ImageError, match=r"frame_000002\.png"):
        prepared(clip, tmp_path / "fifth")

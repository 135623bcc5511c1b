"""Decode the pictures of a video as players show them."""

from __future__ import annotations

import os
from collections.abc import Collection, Generator, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_av1.errors import BitstreamError, VideoError
from colmap_av1.video.container import reason_of
from colmap_av1.video.deinterlacing import deinterlaced
from colmap_av1.video.display import Display, shown_picture
from colmap_av1.video.facts import Video, read_video
from colmap_av1.video.kept_pictures import KeptPictures, Stored
from colmap_av1.video.stored_frames import decode


def decode_frames(
    video: str | os.PathLike[str],
    *,
    operating_point: int = 0,
    num_threads: int | None = None,
    display: Display | None = None,
    wanted: Collection[int] | None = None,
    kept: KeptPictures | None = None,
) -> Generator[tuple[int, NDArray[np.uint8]], None, None]:
    """Decode the frames that players show, as they show them but without film grain.

    Args:
        video: a file of any codec that FFmpeg decodes.
        operating_point: operating point of a scalable stream.
        num_threads: number of decoder threads; None: chosen by the decoder.
        display: how pictures are cropped and rotated; None: as players do. Pictures with
            non-square pixels are not resampled.
        wanted: indices of the frames to yield, all others being decoded only; None: all frames.
        kept: store of decoded pictures. It keeps the wanted frames, and frames that it already
            holds are not decoded again; None: every frame is decoded.

    Yields:
        (index, image) in output order: the index among the frames that players show, see
        `Video.presented`, and the image, uint8 [height, width, 3] in BGR order.

    Raises:
        BitstreamError: the stream is damaged; the frames before the damage have been yielded.
        VideoError: as `read_video`, or the stream has an invalid colour matrix.
    """
    video = read_video(video, operating_point)
    how = display if display is not None else video.display
    decoded = _decoded(video, operating_point, num_threads, wanted)
    if kept is not None and wanted:
        decoded = kept.of(wanted, decoded)
    with closing(decoded):
        for index, stored in decoded:
            yield index, shown_picture(_to_bgr(stored, video.path), how)


def _decoded(
    video: Video, operating_point: int, num_threads: int | None, wanted: Collection[int] | None
) -> Generator[Stored, None, None]:
    """The frames that players show, or the wanted ones of them, with their indices, as stored."""
    index_of = None
    if video.presented is not None:
        index_of = {int(f): i for i, f in enumerate(video.presented)}

    def frames(threads: int | None) -> Generator[Any, None, None]:
        stored = decode(video, operating_point, threads)
        return deinterlaced(stored) if video.is_interlaced else stored

    def given(number: int, frame: Any) -> Iterator[Stored]:
        index = number if index_of is None else index_of.get(number)
        if index is not None and (wanted is None or index in wanted):
            yield index, frame

    count = 0
    try:
        for frame in frames(num_threads):
            yield from given(count, frame)
            count += 1
    except BitstreamError:
        if num_threads == 1:
            raise
        # At the damage a decoder with several threads loses the frames in flight. Decode again
        # with one thread, which has none in flight.
        for number, frame in enumerate(frames(1)):
            if number >= count:
                yield from given(number, frame)


def _to_bgr(frame: Any, path: Path) -> NDArray[np.uint8]:
    try:
        picture = np.asarray(frame.to_ndarray(format="bgr24"))
    except OSError as error:
        raise VideoError(
            f"{path}: pictures of format {frame.format.name} with colour matrix "
            f"{int(frame.colorspace)} cannot be converted: {reason_of(error)}: set the right "
            "matrix with 'ffmpeg -i VIDEO -c copy -bsf:v av1_metadata=matrix_coefficients=1 NEW'"
        ) from error
    # Without a conversion the array shares the memory of the frame, which may be overwritten.
    return picture.copy() if frame.format.name == "bgr24" else picture

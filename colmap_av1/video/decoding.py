"""Decoded pictures of a video, as players show them."""

from __future__ import annotations

import os
from collections.abc import Container, Generator, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_av1.errors import BitstreamError
from colmap_av1.video.display import Display, shown_picture
from colmap_av1.video.facts import read_video
from colmap_av1.video.stored_frames import decode


def decode_frames(
    video: str | os.PathLike[str],
    *,
    operating_point: int = 0,
    num_threads: int | None = None,
    display: Display | None = None,
    wanted: Container[int] | None = None,
) -> Generator[tuple[int, NDArray[np.uint8]], None, None]:
    """Decode the frames that players show, as they show them but for film grain.

    Args:
        video: a file of any codec that FFmpeg decodes.
        operating_point: operating point of a scalable stream.
        num_threads: threads of the decoder; None: as many as it likes.
        display: how pictures are cut and turned; None: as players do. Pixels stay as wide as
            they are stored.
        wanted: indices of the frames that are given, all others are decoded only; None: all.

    Yields:
        (index, image) in output order: the index counts the frames that players show, see
        `Video.presented`; the image is uint8 [height, width, 3] in BGR order.

    Raises:
        BitstreamError: the stream is damaged; the frames before have been given.
        VideoError: as `read_video`.
    """
    video = read_video(video, operating_point)
    how = display if display is not None else video.display
    index_of = None
    if video.presented is not None:
        index_of = {int(f): i for i, f in enumerate(video.presented)}

    def shown(number: int, frame: Any) -> Iterator[tuple[int, NDArray[np.uint8]]]:
        index = number if index_of is None else index_of.get(number)
        if index is not None and (wanted is None or index in wanted):
            yield index, shown_picture(frame.to_ndarray(format="bgr24"), how)

    count = 0
    try:
        for frame in decode(video, operating_point, num_threads):
            yield from shown(count, frame)
            count += 1
    except BitstreamError:
        if num_threads == 1:
            raise
        # Threads lose the frames in flight at the damage; one thread has none in flight.
        for number, frame in enumerate(decode(video, operating_point, 1)):
            if number >= count:
                yield from shown(number, frame)

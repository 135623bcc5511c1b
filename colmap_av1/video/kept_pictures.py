"""Pictures of some frames of a video, decoded once and kept in a file as long as they are needed.

Of a long video few frames become images, and all others are decoded with them. A file of these
few without loss is read again in a fraction of that time.
"""

from __future__ import annotations

from collections.abc import Collection, Generator
from contextlib import closing
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

_Picture = NDArray[np.uint8]

# FFmpeg's lossless intra codec that is the fastest to read, and a container that takes it.
_CODEC, _FORMAT, _CONTAINER = "utvideo", "gbrp", "nut"
# Frames decoded for each that is wanted from which on it pays: writing and reading a picture takes
# as long as decoding three or four.
_FEWEST_DECODED = 4
# Of the container's clock; the pictures' times are not kept.
_TICK = Fraction(1, 25)


class KeptPictures:
    """Keeps the pictures that were decoded last.

    Args:
        file: where; its folder is there, and removed by whoever made it.
    """

    def __init__(self, file: Path) -> None:
        self._file = file
        self._frames: list[int] = []

    def of(
        self, wanted: Collection[int], decoded: Generator[tuple[int, _Picture], None, None]
    ) -> Generator[tuple[int, _Picture], None, None]:
        """The pictures of some frames, from the file where it holds them.

        Args:
            wanted: the frames.
            decoded: (frame, uint8 BGR picture [height, width, 3]) of these, ascending, from the
                video: begun only where the file lacks one, and then kept in it if that pays.

        Yields:
            The same as `decoded`.

        Raises:
            OSError: they cannot be kept.
            BitstreamError: as `decoded`, of which nothing is kept then.
        """
        if set(wanted) <= set(self._frames):
            return self._read(wanted)
        pays = bool(wanted) and max(wanted) + 1 >= _FEWEST_DECODED * len(wanted)
        return self._kept(wanted, decoded) if pays else decoded

    def _read(self, wanted: Collection[int]) -> Generator[tuple[int, _Picture], None, None]:
        last = max(wanted, default=-1)
        with av.open(str(self._file)) as container:
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            for frame, shown in zip(self._frames, container.decode(stream), strict=False):
                if frame > last:
                    return
                if frame in wanted:
                    yield frame, np.asarray(shown.to_ndarray(format="bgr24"))

    def _kept(
        self, wanted: Collection[int], decoded: Generator[tuple[int, _Picture], None, None]
    ) -> Generator[tuple[int, _Picture], None, None]:
        """The decoded pictures; the file is whole before the last is given, where many stop."""
        last = max(wanted)
        frames: list[int] = []
        self._frames = []
        with closing(decoded):
            with av.open(str(self._file), "w", format=_CONTAINER) as container:
                stream: Any = None
                for frame, picture in decoded:
                    stream = stream or _stream_of(container, picture)
                    if picture.shape[1::-1] != (stream.width, stream.height):
                        # Nobody takes pictures of several sizes: what to say of it is theirs.
                        yield frame, picture
                        break
                    shown = av.VideoFrame.from_ndarray(picture, format="bgr24")
                    shown = shown.reformat(format=_FORMAT)
                    shown.pts, shown.time_base = len(frames), _TICK
                    container.mux(stream.encode(shown))
                    frames.append(frame)
                    if frame == last:
                        container.mux(stream.encode(None))
                        break
                    yield frame, picture
            if frames[-1:] == [last]:
                self._frames = frames
                yield frame, picture
            yield from decoded


def _stream_of(container: Any, picture: _Picture) -> Any:
    stream = container.add_stream(_CODEC, rate=1 / _TICK)
    stream.height, stream.width = picture.shape[:2]
    stream.pix_fmt = _FORMAT
    return stream

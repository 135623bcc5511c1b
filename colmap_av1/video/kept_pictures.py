"""Pictures of some frames of a video, decoded once and kept in a file while they are needed.

They are kept uncompressed. Writing and reading a picture takes less time than decoding it, and the
file is not much larger than the images that are made from it.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Generator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Index of a frame, and its av.VideoFrame as stored in the video.
Stored = tuple[int, Any]


class KeptPictures:
    """Keeps the pictures of the frames that were decoded last.

    Args:
        file: where to keep them; its folder exists and is removed by the caller.
    """

    def __init__(self, file: Path) -> None:
        self._file = file
        self._frames: list[int] = []
        # The last frame has the properties that the file lacks, such as the colour space.
        self._last: Any = None
        # For each plane, the size in bytes of the plane and of one line.
        self._sizes: list[tuple[int, int]] = []

    def of(
        self, wanted: Collection[int], decoded: Generator[Stored, None, None]
    ) -> Generator[Stored, None, None]:
        """The pictures of some frames, from the file if it holds them all.

        Args:
            wanted: indices of the frames.
            decoded: decodes the pictures of these frames, in ascending order. It is used if the
                file lacks a frame, and its pictures are then kept.

        Yields:
            The same as `decoded`. Each picture is overwritten by the next one.

        Raises:
            OSError: the file cannot be written.
            BitstreamError: as `decoded`; nothing is kept in this case.
        """
        if set(wanted) <= set(self._frames):
            return self._read(wanted)
        return self._kept(wanted, decoded)

    def _read(self, wanted: Collection[int]) -> Generator[Stored, None, None]:
        stored = self._last
        stored.make_writable()  # the decoder may still hold a reference to it
        planes = [_lines(plane, plane.line_size) for plane in stored.planes]
        with self._file.open("rb") as file:
            for frame in self._frames[: 1 + self._frames.index(max(wanted))]:
                if frame not in wanted:
                    file.seek(sum(size for size, _ in self._sizes), os.SEEK_CUR)
                    continue
                for own, (size, line_size) in zip(planes, self._sizes, strict=True):
                    kept = _lines(file.read(size), line_size)
                    # Lines may end in padding of different lengths.
                    length = min(line_size, own.shape[1])
                    own[:, :length] = kept[:, :length]
                yield frame, stored

    def _kept(
        self, wanted: Collection[int], decoded: Generator[Stored, None, None]
    ) -> Generator[Stored, None, None]:
        """Yield the decoded pictures and keep them.

        The file is complete before the last picture is yielded, because many callers stop there.
        """
        last = max(wanted)
        frames: list[int] = []
        kind: tuple[Any, ...] = ()
        self._frames = []
        with closing(decoded):
            with self._file.open("wb") as file:
                for frame, stored in decoded:
                    kind = kind or _kind_of(stored)
                    if _kind_of(stored) != kind or not _is_in_lines(stored):
                        # Callers reject a change of size or format with their own messages, so
                        # such pictures are yielded but not kept.
                        yield frame, stored
                        break
                    for plane in stored.planes:
                        file.write(plane)
                    frames.append(frame)
                    if frame == last:
                        break
                    yield frame, stored
            if frames[-1:] == [last]:
                self._frames, self._last, self._sizes = frames, stored, _sizes_of(stored)
                yield frame, stored
            yield from decoded


def _lines(samples: Any, line_size: int) -> NDArray[np.uint8]:
    """The samples of a plane as an array with one row per line."""
    return np.frombuffer(samples, np.uint8).reshape(-1, line_size)


def _sizes_of(stored: Any) -> list[tuple[int, int]]:
    """For each plane, the size in bytes of the plane and of one line."""
    return [(plane.buffer_size, plane.line_size) for plane in stored.planes]


def _kind_of(stored: Any) -> tuple[Any, ...]:
    """The properties that all pictures in a file share."""
    format_ = stored.width, stored.height, stored.format.name
    return *format_, stored.colorspace, stored.color_range, _sizes_of(stored)


def _is_in_lines(stored: Any) -> bool:
    """Whether its samples are stored line by line from the top, without a palette."""
    return all(plane.line_size > 0 for plane in stored.planes)

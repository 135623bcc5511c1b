"""Pictures of some frames of a video, decoded once and kept in a file as long as they are needed.

They are kept as they are stored, without compression: writing one and reading it again takes less
time than decoding it, and not much more of the disk than the image that is made of it.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Generator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Index of a frame, and the av.VideoFrame as it is stored.
Stored = tuple[int, Any]


class KeptPictures:
    """Keeps the pictures that were decoded last.

    Args:
        file: where; its folder is there, and removed by whoever made it.
    """

    def __init__(self, file: Path) -> None:
        self._file = file
        self._frames: list[int] = []
        # The last of them, which has what a file of samples lacks, such as their colour space.
        self._last: Any = None
        # Of each of its planes, the bytes of all lines and of one.
        self._sizes: list[tuple[int, int]] = []

    def of(
        self, wanted: Collection[int], decoded: Generator[Stored, None, None]
    ) -> Generator[Stored, None, None]:
        """The pictures of some frames, from the file where it holds them.

        Args:
            wanted: the frames.
            decoded: the pictures of these, ascending, from the video: begun only where the file
                lacks one, and then kept in it.

        Yields:
            The same as `decoded`. A picture is overwritten by the next one.

        Raises:
            OSError: they cannot be kept.
            BitstreamError: as `decoded`, of which nothing is kept then.
        """
        if set(wanted) <= set(self._frames):
            return self._read(wanted)
        return self._kept(wanted, decoded)

    def _read(self, wanted: Collection[int]) -> Generator[Stored, None, None]:
        stored = self._last
        stored.make_writable()  # the decoder may hold it, too
        planes = [_lines(plane, plane.line_size) for plane in stored.planes]
        with self._file.open("rb") as file:
            for frame in self._frames[: 1 + self._frames.index(max(wanted))]:
                if frame not in wanted:
                    file.seek(sum(size for size, _ in self._sizes), os.SEEK_CUR)
                    continue
                for own, (size, line_size) in zip(planes, self._sizes, strict=True):
                    kept = _lines(file.read(size), line_size)
                    # Lines may end in bytes that mean nothing, more or fewer of them.
                    length = min(line_size, own.shape[1])
                    own[:, :length] = kept[:, :length]
                yield frame, stored

    def _kept(
        self, wanted: Collection[int], decoded: Generator[Stored, None, None]
    ) -> Generator[Stored, None, None]:
        """The decoded pictures; the file is whole before the last is given, where many stop."""
        last = max(wanted)
        frames: list[int] = []
        kind: tuple[Any, ...] = ()
        self._frames = []
        with closing(decoded):
            with self._file.open("wb") as file:
                for frame, stored in decoded:
                    kind = kind or _kind_of(stored)
                    if _kind_of(stored) != kind or not _is_in_lines(stored):
                        # Nobody takes pictures of several kinds: what to say of it is theirs.
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
    """A plane's samples by its lines."""
    return np.frombuffer(samples, np.uint8).reshape(-1, line_size)


def _sizes_of(stored: Any) -> list[tuple[int, int]]:
    """Of each plane, the bytes of all lines and of one."""
    return [(plane.buffer_size, plane.line_size) for plane in stored.planes]


def _kind_of(stored: Any) -> tuple[Any, ...]:
    """What all pictures in a file have in common."""
    format_ = stored.width, stored.height, stored.format.name
    return *format_, stored.colorspace, stored.color_range, _sizes_of(stored)


def _is_in_lines(stored: Any) -> bool:
    """Whether its samples come line by line from the top, and are no places in a palette."""
    return all(plane.line_size > 0 for plane in stored.planes)

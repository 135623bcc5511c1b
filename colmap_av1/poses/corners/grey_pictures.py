"""Temporary storage for the grey pictures of images, which the search for corners reads twice."""

from __future__ import annotations

import tempfile
import threading
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray


class GreyPictures:
    """Stores grey pictures of images in an unnamed temporary file, which is deleted on exit.

    This avoids decoding the pictures twice or holding all of them in memory.
    """

    def __init__(self, folder: Path) -> None:
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 - closed by __exit__
        self._at: dict[int, tuple[int, tuple[int, int]]] = {}
        self._lock = threading.Lock()

    def __enter__(self) -> GreyPictures:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._file.close()

    def __contains__(self, image: int) -> bool:
        """Whether the picture of an image, given by its index, is stored."""
        return image in self._at

    def keep(self, image: int, grey: NDArray[np.uint8]) -> None:
        """Store the picture, uint8 [height, width], of an image that has none yet."""
        height, width = grey.shape
        self._at[image] = self._file.seek(0, 2), (height, width)
        self._file.write(grey.tobytes())

    def read(self, image: int) -> NDArray[np.uint8]:
        """The picture of an image. Several threads may call it."""
        start, shape = self._at[image]
        with self._lock:
            self._file.seek(start)
            pixels = self._file.read(shape[0] * shape[1])
        return np.frombuffer(pixels, np.uint8).reshape(shape)

    def size(self, image: int) -> tuple[int, int]:
        """The (width, height) of the picture of an image."""
        height, width = self._at[image][1]
        return width, height

"""Write HDF5 files; a full disk raises an error instead of a crash."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py


class _Storage(io.FileIO):
    """A file that keeps its first write error and hides it from HDF5, which would crash."""

    failure: OSError | None = None

    def write(self, data: Any) -> int:
        left = memoryview(data).cast("B")
        while left and self.failure is None:
            try:
                left = left[super().write(left) :]
            except OSError as error:
                self.failure = error
        return memoryview(data).nbytes

    def truncate(self, size: int | None = None) -> int:
        if self.failure is None:
            try:
                return super().truncate(size)
            except OSError as error:
                self.failure = error
        return size or 0


@contextmanager
def new_hdf5(path: Path) -> Iterator[Callable[..., h5py.Dataset]]:
    """Create an HDF5 file; the same data in the same order gives the same bytes.

    Args:
        path: the file.

    Yields:
        A function that writes a dataset, given its path in the file, its data, and further options
        of h5py.

    Raises:
        OSError: the file cannot be created or written.
    """
    with _Storage(path, "w+") as storage:
        file = h5py.File(storage, "w", libver="latest")

        def write(name: str, data: Any, **how: Any) -> h5py.Dataset:
            try:
                dataset = file.create_dataset(name, data=data, track_times=False, **how)
            except RuntimeError as error:
                raise storage.failure or error from error
            if storage.failure is not None:
                raise storage.failure
            return dataset

        try:
            yield write
        finally:
            try:
                file.close()
            except (OSError, RuntimeError):
                if storage.failure is None:
                    raise
        if storage.failure is not None:
            raise storage.failure

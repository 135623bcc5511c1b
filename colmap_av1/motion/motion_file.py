"""Write the motion of a video to a file."""

from __future__ import annotations

import dataclasses
import os
import zipfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from colmap_av1.errors import OptionError, VideoError, writing
from colmap_av1.motion.frame_motion import UNIT_FIELDS, FrameMotion
from colmap_av1.motion.reading import read_motion
from colmap_av1.options import ReadOptions
from colmap_av1.util.files import check_new_file, remove_leftovers, whole_file
from colmap_av1.util.hdf5 import new_hdf5
from colmap_av1.util.progress import Progress, no_progress

# Zip members have a date. A fixed one makes the bytes of the file reproducible.
_ZIP_EPOCH = (1980, 1, 1, 0, 0, 0)


def export_motion(
    video: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    options: ReadOptions = ReadOptions(),
    progress: Progress = no_progress,
    overwrite: bool = False,
) -> int:
    """Write the motion of every coded frame to a .npz or .h5 file.

    The arrays of coded frame i (in bitstream order, from 0) are stored under '%06d/' % i, with the
    names of `FrameMotion` (per unit, not per block), and its header values under '%06d/header/'.
    Frames are written one by one, so memory does not grow with the video. The file appears under
    its name only when it is complete.

    Args:
        video: the video file.
        output: the file; its extension .npz, .h5 or .hdf5 selects the format.
        options: how the bitstream is read.
        progress: called with the stage "motion" and the number of frames written so far.
        overwrite: replace an existing output.

    Returns:
        The number of coded frames.

    Raises:
        OptionError: the extension is unknown, or the file exists.
        WriteError: the file cannot be written.
        VideoError: the video cannot be read or has no frames.
        BitstreamError: the stream is damaged and `options.strict` is set.

    Examples:
        >>> import numpy as np
        >>> from colmap_av1 import export_motion
        >>> export_motion("video.mp4", "motion.npz")
        60
        >>> with np.load("motion.npz") as file:
        ...     file["000001/mv"].shape
        (90, 160, 2, 2)
    """
    path = Path(output)
    writers: dict[str, _Opener] = {".npz": _open_npz, ".h5": _open_h5, ".hdf5": _open_h5}
    if path.suffix.lower() not in writers:
        raise OptionError(f"{path}: give an output file that ends in .npz or .h5")
    check_new_file(path, [video], overwrite=overwrite)
    count = 0
    with writing(path):
        remove_leftovers(path.parent, path.name)
        with whole_file(path) as partial:
            with writers[path.suffix.lower()](partial) as write:
                for frame in read_motion(video, options):
                    for name, array in _arrays(frame):
                        write(f"{count:06d}/{name}", array)
                    count += 1
                    progress("motion", count, None)
            if count == 0:
                raise VideoError(f"{video}: has no frames: give another video")
    return count


class _Opener(Protocol):
    def __call__(
        self, path: Path
    ) -> AbstractContextManager[Callable[[str, NDArray[Any]], None]]: ...


@contextmanager
def _open_npz(path: Path) -> Iterator[Callable[[str, NDArray[Any]], None]]:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:

        def write(name: str, array: NDArray[Any]) -> None:
            info = zipfile.ZipInfo(f"{name}.npy", _ZIP_EPOCH)
            info.compress_type = zipfile.ZIP_DEFLATED
            with archive.open(info, "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.ascontiguousarray(array), allow_pickle=False)

        yield write


@contextmanager
def _open_h5(path: Path) -> Iterator[Callable[[str, NDArray[Any]], None]]:
    with new_hdf5(path) as write_dataset:

        def write(name: str, array: NDArray[Any]) -> None:
            how = {"compression": "gzip", "compression_opts": 1} if array.size > 1 else {}
            write_dataset(name, array, **how)

        yield write


def _arrays(frame: FrameMotion) -> Iterator[tuple[str, NDArray[Any]]]:
    names = [field.name for field in dataclasses.fields(frame)]
    at = names.index("blocks")
    names[at : at + 2] = UNIT_FIELDS  # in place of blocks and block_index
    for name in names:
        value = getattr(frame, name)
        if name == "header":
            for key, entry in value.items():
                yield f"header/{key}", np.asarray(entry)
        else:
            yield name, np.asarray(value)

"""Write drawn pictures and videos. A file appears only when it is complete."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import av.error
import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_av1.errors import OptionError, WriteError, cannot_write, writing
from colmap_av1.util.arrays import Picture
from colmap_av1.util.files import check_new_file, remove_leftovers, whole_file
from colmap_av1.util.memory import check_memory

# Fixed, because x264's output depends on the number of threads.
_ENCODER_THREADS = 4
# With `mbtree`, x264's output depends on uninitialized memory.
_ENCODER_OPTIONS = {"crf": "18", "x264-params": "mbtree=0"}


def check_picture(
    output: str | os.PathLike[str],
    inputs: Iterable[str | os.PathLike[str]] = (),
    *,
    overwrite: bool = False,
) -> None:
    """Check that `write_picture` can and may write an output, before anything is drawn.

    Args:
        output: the file.
        inputs: files that are read.
        overwrite: replace an existing file.

    Raises:
        OptionError: `output` has another extension, is an input, or exists and `overwrite` is not
            set.
    """
    path = Path(output)
    if path.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise OptionError(
            f"{path}: give an output that ends in .png or .jpg, or in .html for a model"
        )
    check_new_file(path, inputs, overwrite=overwrite)


def write_picture(
    picture: Picture, output: str | os.PathLike[str], *, overwrite: bool = False
) -> None:
    """Write a picture as PNG or JPEG, depending on the extension.

    Raises:
        OptionError: see `check_picture`.
        WriteError: the file cannot be written.
    """
    check_picture(output, overwrite=overwrite)
    _write_picture(picture, Path(output))


def _write_picture(picture: Picture, path: Path) -> None:
    suffix = path.suffix.lower()
    _, encoded = cv2.imencode(suffix, picture)
    with _output(path) as partial:
        partial.write_bytes(encoded.tobytes())


def side_by_side(panels: Sequence[Picture]) -> Picture:
    """Join pictures of the same size side by side, wide ones above each other."""
    wide = panels[0].shape[1] > panels[0].shape[0]
    return np.asarray(np.concatenate(panels, axis=0 if wide else 1), dtype=np.uint8)


def bgr(
    hue: NDArray[np.floating[Any]],
    saturation: NDArray[np.floating[Any]],
    value: NDArray[np.floating[Any]],
) -> NDArray[np.uint8]:
    """Convert OpenCV's hue (0 to 180), saturation and value (0 to 255) to BGR colours [n, 3]."""
    hsv = np.stack([hue, saturation, value], axis=-1).astype(np.uint8)
    if len(hsv) == 0:  # OpenCV refuses empty arrays
        return hsv
    return np.asarray(cv2.cvtColor(hsv[None], cv2.COLOR_HSV2BGR)[0], dtype=np.uint8)


def existing_pictures(path: Path) -> list[Path]:
    """The files that `open_pictures` may replace."""
    if path.suffix.lower() == ".mp4":
        return [path]
    return sorted(path.glob("frame_[0-9]*.png")) if path.is_dir() else []


@contextmanager
def open_pictures(path: Path, frame_rate: float) -> Iterator[Callable[[Picture], None]]:
    """Write pictures to an .mp4 file, or as numbered files to a folder."""
    if path.suffix.lower() != ".mp4":
        count = 0

        def write_file(picture: Picture) -> None:
            nonlocal count
            _write_picture(picture, path / f"frame_{count:06d}.png")
            count += 1

        with writing(path):
            path.mkdir(parents=True, exist_ok=True)
        yield write_file
        return
    with _output(path) as partial, av.open(str(partial), "w", "mp4") as container:
        rate = Fraction(frame_rate).limit_denominator(1001)
        stream: Any = container.add_stream("libx264", rate, options=_ENCODER_OPTIONS)
        stream.pix_fmt = "yuv420p"
        stream.codec_context.thread_count = _ENCODER_THREADS
        size: tuple[int, int] | None = None

        def write_frame(picture: Picture) -> None:
            nonlocal size
            # 4:2:0 needs even sizes, and all frames of a video have the same size.
            if size is None:
                size = (picture.shape[1] + 1 & ~1, picture.shape[0] + 1 & ~1)
                stream.width, stream.height = size
            fitted = cv2.copyMakeBorder(
                picture[: size[1], : size[0]],
                0,
                max(0, size[1] - picture.shape[0]),
                0,
                max(0, size[0] - picture.shape[1]),
                cv2.BORDER_CONSTANT,
            )
            container.mux(stream.encode(av.VideoFrame.from_ndarray(fitted, format="bgr24")))

        yield write_frame
        if size is not None:
            container.mux(stream.encode(None))


@contextmanager
def _output(path: Path) -> Iterator[Path]:
    """A `whole_file` whose errors become a WriteError."""
    try:
        remove_leftovers(path.parent, path.name)
        with whole_file(path) as partial:
            yield partial
    except (OSError, av.error.FFmpegError) as error:
        check_memory(error)
        raise WriteError(cannot_write(path, error)) from error

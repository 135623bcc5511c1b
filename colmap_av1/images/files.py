"""Image files: existing ones, and those that are written."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

try:
    import fcntl
except ImportError:  # on Windows
    fcntl = None  # type: ignore[assignment]

import av
import av.error
import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_av1.errors import ImageError, VideoError, cannot_write
from colmap_av1.images.names import (
    WRITE_PARAMETERS,
    image_file,
    image_names,
    natural_key,
    pattern_regex,
)
from colmap_av1.options.images import check_extension
from colmap_av1.util.cpus import threads_or_cpus
from colmap_av1.util.files import may_read, remove_leftovers, whole_file
from colmap_av1.util.memory import check_memory
from colmap_av1.util.spread import evenly_spread
from colmap_av1.video.decoding import decode_frames
from colmap_av1.video.display import Display
from colmap_av1.video.facts import read_video
from colmap_av1.video.kept_pictures import KeptPictures
from colmap_av1.video.unchanged import unchanged

# Images that others wrote are only read.
READABLE = {*WRITE_PARAMETERS, ".bmp", ".tif", ".tiff", ".webp"}
# Frames waiting to be compressed, per thread; bounds memory.
_QUEUE_PER_THREAD = 2
# Longer side in pixels at which detail is looked for: larger pictures are soft at their full size,
# and not the worse for it.
_DETAILED_SIZE = 960
# A pixel is detail where its grey value changes by more than this when the picture is halved and
# enlarged again. Of sharp videos 2 to 30 % of the pixels are, of one that was blurred by Gaussians
# of 2.5 to 12 px none of ten thousand or two.
_VISIBLE = 8.0
_LEAST_DETAIL = 0.005
# Detail along rows, columns and both diagonals, which motion blur leaves across its direction only:
# second differences of grey values. Sharp videos have 12 % and more of that in the richest
# direction in any other, those that were blurred along a line of 9 px 3 % at most, of 25 to 80 px
# half a per cent, with noise of 3 grey levels, too.
_SECOND_DIFFERENCES = tuple(
    np.array(kernel, np.float32) / 4
    for kernel in (
        [[0, 0, 0], [-1, 2, -1], [0, 0, 0]],
        [[0, -1, 0], [0, 2, 0], [0, -1, 0]],
        [[-1, 0, 0], [0, 2, 0], [0, 0, -1]],
        [[0, 0, -1], [0, 2, 0], [-1, 0, 0]],
    )
)
_LEAST_OF_RICHEST = 0.02
# Images that are looked at, of a video.
_NUM_DETAILED = 5


def size_of_images(
    sizes: Mapping[str, tuple[int, int]], video_size: tuple[int, int], pixel_aspect: float = 1.0
) -> tuple[int, int]:
    """The common size of existing images: that of the video's pictures, or these scaled.

    Args:
        sizes: (width, height) of each image, by name; empty where none exist.
        video_size: (width, height) of the pictures, turned as players do.
        pixel_aspect: width of the pictures' pixels over their height; images whose pixels were
            made square fit, too.

    Raises:
        ImageError: the images differ in size, or in shape from the video's pictures.
    """
    if not sizes:
        return video_size
    first_name, first = next(iter(sizes.items()))
    for name, size in sizes.items():
        if size != first:
            raise ImageError(
                f"image '{name}' is {size[0]}x{size[1]}, '{first_name}' {first[0]}x{first[1]}: "
                "images of one video have one size; match those of other cameras apart"
            )
    width, height = video_size
    square = (width * pixel_aspect, height)
    if not has_shape(first, video_size) and not has_shape(first, square):
        turned = first == video_size[::-1]
        raise ImageError(
            f"image '{first_name}' is {first[0]}x{first[1]}, the video's pictures are "
            f"{width}x{height}{' as players turn them' if turned else ''}: give the video that "
            "it comes from, or begin with a new database and folder"
        )
    return first


def has_shape(size: tuple[int, int], of: tuple[float, float]) -> bool:
    """Whether a (width, height) is another one scaled, rounded to whole pixels."""
    return abs(size[0] * of[1] - size[1] * of[0]) <= max(*size, *of)


def check_images_there(folder: str | os.PathLike[str], names: Sequence[str]) -> None:
    """Check that images, which are scaled and so cannot be written, are in a folder.

    Raises:
        ImageError: one is missing.
    """
    missing = next((n for n in names if not image_file(Path(folder), n).exists()), None)
    if missing is not None:
        raise ImageError(
            f"{Path(folder) / missing}: is missing, and the images have another size than the "
            "video, so it cannot be written: give the folder that holds all images"
        )


def existing_images(folder: str | os.PathLike[str], pattern: str) -> list[str]:
    """Images that a folder already holds, unless an earlier run of this package wrote them.

    Args:
        folder: the folder; it need not exist.
        pattern: pattern of the names of new images, see `image_names`.

    Returns:
        File names in their natural order; none where frame 0 is there under the name that the
        pattern gives it. Other programs count from 1.
    """
    root = Path(folder)
    if not root.is_dir():
        return []
    names = [
        p.name
        for p in root.iterdir()
        if p.suffix.lower() in READABLE and not p.name.startswith(".")
    ]
    if image_names(pattern, [0])[0] in names:
        return []
    return sorted(names, key=natural_key)


def check_image_folder(
    folder: str | os.PathLike[str],
    names: Sequence[str] | str,
    video_size: tuple[int, int],
) -> None:
    """Check that images can be written to a folder and that those there have the right size.

    Args:
        folder: the folder; it need not exist.
        names: the images' names, or the pattern of their names.
        video_size: (width, height) of the video.

    Raises:
        ImageError: the folder is a file or not writable, a name leaves the folder, or an
            image there is of another size or unreadable.
        OptionError: the pattern or an extension is none of an image.
    """
    root = Path(folder)
    existing_parent = root
    while not existing_parent.exists() and existing_parent != existing_parent.parent:
        existing_parent = existing_parent.parent
    if not existing_parent.is_dir():
        raise ImageError(f"{existing_parent}: is a file: give a folder for the images")
    is_complete = not isinstance(names, str) and all(image_file(root, n).exists() for n in names)
    if not is_complete and not os.access(existing_parent, os.W_OK | os.X_OK):
        raise ImageError(
            f"{existing_parent}: no permission to write images there: give another folder"
        )
    if isinstance(names, str):
        regex = pattern_regex(names)
        present = [p.name for p in root.iterdir()] if root.is_dir() else []
        names = sorted(name for name in present if regex.fullmatch(name))
    for name in names:
        path = image_file(root, name)
        if path.exists():
            size = image_size(path)
            if size != video_size:
                raise ImageError(
                    f"{path}: is {size[0]}x{size[1]}, the video {video_size[0]}x{video_size[1]}: "
                    "give another folder or remove the images"
                )


@contextlib.contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Make a folder of images and hold it as long as the body runs; waits for other processes.

    File systems without locks, and Windows, let others go on.

    Raises:
        ImageError: it cannot be made.
    """
    is_new = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ImageError(cannot_write(folder, error)) from error
    with contextlib.ExitStack() as ending:
        if fcntl is not None:
            held = os.open(folder, os.O_RDONLY)
            ending.callback(os.close, held)
            with contextlib.suppress(OSError):
                fcntl.flock(held, fcntl.LOCK_EX)
        try:
            yield
        except BaseException:
            if is_new:
                with contextlib.suppress(OSError):  # it holds images
                    folder.rmdir()
            raise


def files_in(folder: Path) -> set[Path]:
    """The files in a folder and those below it; none where there is no such folder."""
    return {Path(parent, name) for parent, _, names in os.walk(folder) for name in names}


def write_images(
    video: str | os.PathLike[str],
    folder: str | os.PathLike[str],
    names: Sequence[str],
    frames: Sequence[int],
    *,
    num_threads: int | None = None,
    operating_point: int = 0,
    change: Callable[[int, NDArray[np.uint8]], NDArray[np.uint8]] | None = None,
    display: Display | None = None,
    kept: KeptPictures | None = None,
    progress: Callable[[int], None] | None = None,
) -> int:
    """Write video frames as images, PNG or JPEG (quality 95) by the names' extensions.

    An image appears under its name only when complete. Existing images are kept, see
    `check_image_folder`.

    Args:
        video: the video file.
        folder: where the images go; made where missing.
        names: the images' names, which may hold folders.
        frames: display index of each image.
        num_threads: threads; None: one per CPU.
        operating_point: operating point of a scalable stream.
        change: called with (display_index, picture) of each image that is not there yet, in
            display order; gives the picture to write.
        display: how pictures are cut and turned; None: as players do.
        kept: what it holds is not decoded.
        progress: called with the number of images done so far.

    Returns:
        The number of images written; the others were there.

    Raises:
        ImageError: an image cannot be written, the frames change their size, or the decoder
            gives fewer frames than asked for.
        BitstreamError: the stream cannot be decoded up to the last frame asked for.
        VideoError: the video cannot be read, or changes meanwhile; then what was written of it
            is removed.
    """
    root = Path(folder)
    wanted = {
        int(frame): image_file(root, name)
        for frame, name in zip(frames, names, strict=True)
        if not image_file(root, name).exists()
    }
    num_kept = len(names) - len(wanted)

    def report(num_written: int) -> None:
        if progress is not None:
            progress(num_kept + num_written)

    report(0)
    if not wanted:
        return 0
    parents = {path.parent for path in wanted.values()}
    made = [parent for parent in parents if not parent.exists()]
    for parent in parents:
        try:
            parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ImageError(
                f"{parent}: cannot be made: {error.strerror}: fix that, or give another path"
            ) from error
        remove_leftovers(parent)
    try:
        video = read_video(video, operating_point)
        with unchanged(video.state):
            decoded = decode_frames(
                video,
                operating_point=operating_point,
                num_threads=num_threads,
                display=display,
                wanted=wanted,
                kept=kept,
            )
            with contextlib.closing(decoded):
                _write_frames(decoded, wanted, change, threads_or_cpus(num_threads), report)
    except VideoError:  # images of two videos would be kept as those of one
        for path in wanted.values():
            path.unlink(missing_ok=True)
        for parent in made:
            with contextlib.suppress(OSError):  # it holds what was not written here
                parent.rmdir()
        raise
    return len(wanted)


def _write_frames(
    decoded: Iterator[tuple[int, NDArray[np.uint8]]],
    wanted: Mapping[int, Path],
    change: Callable[[int, NDArray[np.uint8]], NDArray[np.uint8]] | None,
    num_threads: int,
    report: Callable[[int], None],
) -> None:
    """Write the wanted ones of the frames, on threads; `report` gets how many are written."""
    size: tuple[int, ...] | None = None
    queue: list[Future[None]] = []
    num_taken = 0
    last = max(wanted)
    # OpenCV releases the interpreter lock while it compresses.
    with ThreadPoolExecutor(max_workers=num_threads) as executor:
        try:
            for index, picture in decoded:
                size = size or picture.shape
                if picture.shape != size:
                    raise ImageError(
                        f"frame {index} is {picture.shape[1]}x{picture.shape[0]}, those before "
                        f"{size[1]}x{size[0]}: images of one camera cannot change their size; "
                        "re-encode the video at one size"
                    )
                if index in wanted:
                    image = change(index, picture) if change is not None else picture
                    queue.append(executor.submit(write_image, wanted[index], image))
                    num_taken += 1
                while len(queue) > (num_threads * _QUEUE_PER_THREAD if index < last else 0):
                    queue.pop(0).result()
                    report(num_taken - len(queue))
                if index >= last:
                    break
            for future in queue:  # left where the decoder ends early
                future.result()
        finally:
            executor.shutdown(wait=True, cancel_futures=True)
    if num_taken < len(wanted):
        raise ImageError(
            f"the decoder gives no frame {sorted(wanted)[num_taken]} of the {last + 1} that the "
            "stream shows: leave out the images, or re-encode the video"
        )


def read_image(path: Path) -> NDArray[np.uint8]:
    """Read an image file: uint8 [height, width, 3] BGR.

    Raises:
        ImageError: it is missing, or none that can be read.
    """
    # COLMAP, too, takes pixels as they are stored and leaves an orientation in EXIF alone.
    how = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    if not may_read(path):
        raise ImageError(f"{path}: no permission to read it: change that")
    image = None
    try:
        # OpenCV opens no path that is not UTF-8.
        data = path.read_bytes() if path.is_file() else b""
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), how) if data else None
    except cv2.error as error:  # more pixels than OpenCV takes
        raise ImageError(f"{path}: is too large for an image: give the folder of the images") from (
            error
        )
    except OSError as error:
        raise ImageError(f"{path}: cannot be read: {error.strerror}") from error
    if image is None:
        raise ImageError(f"{path}: is missing or not an image: give the folder of the images")
    return np.asarray(image, dtype=np.uint8)


def blur_warning(files: Sequence[Path]) -> str | None:
    """What the user should know of images that are all blurred, by the pictures of a few.

    Raises:
        ImageError: an image is missing or cannot be read.
    """
    some = [files[i] for i in evenly_spread(len(files), _NUM_DETAILED, rounded=True)]
    greys = [grey_within(read_image(file), _DETAILED_SIZE) for file in some]
    if float(np.median([_detail(grey) for grey in greys])) < _LEAST_DETAIL:
        return (
            f"{files[0].parent}: the images are blurred, dark or plain, half their size would show "
            "as much: tracks in them are few and inexact; film in focus, in good light and more "
            "slowly"
        )
    directions = np.median([_detail_by_direction(grey) for grey in greys], axis=0)
    if directions.min() < _LEAST_OF_RICHEST * directions.max():
        return (
            f"{files[0].parent}: the images are blurred along one direction, as by the camera's "
            "motion: tracks in them are few and inexact; film more slowly, or in more light, which "
            "makes exposures shorter"
        )
    return None


def _detail(grey: NDArray[np.uint8]) -> float:
    """Share of the pixels that are detail."""
    height, width = grey.shape
    half = (max(1, width // 2), max(1, height // 2))
    small = cv2.resize(grey, half, interpolation=cv2.INTER_AREA)
    again = cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC)
    return float(np.mean(cv2.absdiff(grey, again) > _VISIBLE))


def _detail_by_direction(grey: NDArray[np.uint8]) -> list[float]:
    """Share of the pixels that are detail along rows, columns and both diagonals."""
    return [
        float(np.mean(np.abs(cv2.filter2D(grey, cv2.CV_32F, kernel)) > _VISIBLE))
        for kernel in _SECOND_DIFFERENCES
    ]


def grey_within(picture: NDArray[np.uint8], longest: int) -> NDArray[np.uint8]:
    """The grey picture of a BGR one, made smaller where its longer side has more pixels than so."""
    scale = min(1.0, longest / max(picture.shape[:2]))
    grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.asarray(grey, np.uint8)


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image file, without decoding it in full.

    Raises:
        ImageError: it is none that can be read.
    """
    size = (0, 0)
    if path.exists() and not path.is_file():
        raise ImageError(f"{path}: is a pipe, device or folder, not an image: remove it")
    try:
        with av.open(os.path.abspath(path)) as container:
            if container.streams.video:
                size = container.streams.video[0].width, container.streams.video[0].height
    except PermissionError as error:
        raise ImageError(f"{path}: no permission to read it: change that") from error
    except (av.error.FFmpegError, OSError, ValueError) as error:
        check_memory(error)
        raise ImageError(f"{path}: is not a readable image: remove it") from error
    if size == (0, 0):
        raise ImageError(f"{path}: is not a readable image: remove it")
    return size


def write_image(path: Path, image: NDArray[np.uint8]) -> None:
    """Write an image (BGR), PNG or JPEG by its extension; it appears when it is complete.

    Raises:
        ImageError: it cannot be written.
        OptionError: the extension is none of these.
    """
    check_extension(path.name)
    suffix = path.suffix.lower()
    encoded = cv2.imencode(suffix, image, WRITE_PARAMETERS[suffix])[1].tobytes()
    try:
        with whole_file(path) as partial:
            partial.write_bytes(encoded)
    except OSError as error:
        raise ImageError(cannot_write(path, error)) from error

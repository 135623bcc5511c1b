"""Read, check and write image files."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

try:
    import fcntl
except ImportError:  # on Windows
    fcntl = None  # type: ignore[assignment]

import av
import av.error
import cv2
import numpy as np

from colmap_av1.errors import ImageError, VideoError, writing
from colmap_av1.images.names import image_file, pattern_regex
from colmap_av1.options.images import IMAGE_EXTENSIONS, check_extension
from colmap_av1.util.arrays import Picture
from colmap_av1.util.files import may_read, remove_leftovers, whole_file
from colmap_av1.util.memory import check_memory
from colmap_av1.util.threads import map_on_threads
from colmap_av1.video.decoding import decode_frames
from colmap_av1.video.display import Display
from colmap_av1.video.facts import read_video
from colmap_av1.video.kept_pictures import KeptPictures
from colmap_av1.video.unchanged import unchanged

# OpenCV's parameters for the images that are written, by extension.
WRITE_PARAMETERS: dict[str, list[int]] = {
    ".jpg": [cv2.IMWRITE_JPEG_QUALITY, 95],
    ".jpeg": [cv2.IMWRITE_JPEG_QUALITY, 95],
    ".png": [],  # OpenCV's defaults are fast
}
# Extensions of images that can be read.
READABLE = {*IMAGE_EXTENSIONS, ".bmp", ".tif", ".tiff"}
# Extensions of images of phones, cameras and programs that cannot be read. They cause a warning,
# unlike other files.
UNREADABLE = {
    ".webp",
    ".heic",
    ".heif",
    ".avif",
    ".dng",
    ".cr2",
    ".cr3",
    ".nef",
    ".arw",
    ".raf",
}


def size_of_images(
    sizes: Mapping[str, tuple[int, int]], video_size: tuple[int, int], pixel_aspect: float = 1.0
) -> tuple[int, int]:
    """The common size of existing images, which may be scaled.

    Args:
        sizes: (width, height) of each image, by name; empty if there are none.
        video_size: (width, height) of the video's pictures, rotated as players show them.
        pixel_aspect: width of the pictures' pixels over their height; images with square pixels
            are accepted as well.

    Raises:
        ImageError: the images differ in size, or their aspect ratio differs from the video's.
    """
    if not sizes:
        return video_size
    first_name, first = next(iter(sizes.items()))
    for name, size in sizes.items():
        if size != first:
            raise ImageError(
                f"image '{name}' is {size[0]}x{size[1]}, '{first_name}' {first[0]}x{first[1]}: "
                "images of one video have one size; match those of other cameras separately"
            )
    width, height = video_size
    square = (width * pixel_aspect, height)
    if not has_shape(first, video_size) and not has_shape(first, square):
        turned = first == video_size[::-1]
        raise ImageError(
            f"image '{first_name}' is {first[0]}x{first[1]}, the video's pictures are "
            f"{width}x{height}{' as players rotate them' if turned else ''}: give the video that "
            "it comes from, or start with a new database and folder"
        )
    return first


def has_shape(size: tuple[int, int], of: tuple[float, float]) -> bool:
    """Whether a (width, height) is a scaled version of another one, rounded to whole pixels."""
    return abs(size[0] * of[1] - size[1] * of[0]) <= max(*size, *of)


def check_images_there(folder: str | os.PathLike[str], names: Sequence[str]) -> None:
    """Check that scaled images, which cannot be written, exist in a folder.

    Raises:
        ImageError: an image is missing.
    """
    missing = next((n for n in names if not image_file(Path(folder), n).exists()), None)
    if missing is not None:
        raise ImageError(
            f"{Path(folder) / missing}: is missing, and cannot be written because the images "
            "differ in size from the video: give the folder that holds all images"
        )


def check_image_folder(
    folder: str | os.PathLike[str],
    names: Sequence[str] | str,
    video_size: tuple[int, int],
) -> None:
    """Check that images can be written to a folder and that existing ones have the right size.

    Args:
        folder: the folder; it need not exist.
        names: the images' names, or the pattern of their names.
        video_size: (width, height) of the video.

    Raises:
        ImageError: the folder is a file or not writable, a name leaves the folder, or an existing
            image is unreadable or has another size.
        OptionError: the pattern or an extension is not that of an image.
    """
    root = Path(folder)
    existing_parent = root
    while not existing_parent.exists() and existing_parent != existing_parent.parent:
        existing_parent = existing_parent.parent
    if not existing_parent.is_dir():
        raise ImageError(f"{existing_parent}: is a file: give a folder for the images")
    is_complete = not isinstance(names, str) and all(image_file(root, n).exists() for n in names)
    if not is_complete and not os.access(existing_parent, os.W_OK | os.X_OK):
        raise ImageError(f"{root}: no permission to write images there: give another folder")
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
    """Create a folder of images and lock it while the body runs; waits for other processes.

    On Windows, and on file systems without locks, the folder is not locked.

    Raises:
        WriteError: the folder cannot be created.
    """
    is_new = not folder.exists()
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
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
                with contextlib.suppress(OSError):  # not empty
                    folder.rmdir()
            raise


def files_in(folder: Path) -> set[Path]:
    """All files in a folder and its subfolders; empty if the folder does not exist."""
    return {Path(parent, name) for parent, _, names in os.walk(folder) for name in names}


def write_images(
    video: str | os.PathLike[str],
    folder: str | os.PathLike[str],
    names: Sequence[str],
    frames: Sequence[int],
    *,
    num_threads: int | None = None,
    operating_point: int = 0,
    change: Callable[[int, Picture], Picture] | None = None,
    look: Callable[[int, Picture], None] | None = None,
    display: Display | None = None,
    kept: KeptPictures | None = None,
    progress: Callable[[int], None] | None = None,
) -> int:
    """Write video frames as images, PNG or JPEG (quality 95) by the names' extensions.

    An image appears under its name only when complete. Existing images are kept, see
    `check_image_folder`.

    Args:
        video: the video file.
        folder: folder for the images; created if missing.
        names: the images' names, which may contain folders.
        frames: frame number of each image.
        num_threads: number of threads; None: one per CPU.
        operating_point: operating point of a scalable stream.
        change: called on several threads with (display_index, picture) of each missing image;
            returns the picture to write.
        look: called on this thread with (display_index, written picture) of each missing image, in
            display order.
        display: how pictures are cropped and rotated; None: as players do.
        kept: store of decoded pictures, which are not decoded again.
        progress: called with the number of images done so far.

    Returns:
        The number of images written; the others existed.

    Raises:
        ImageError: the frames change their size, or the decoder returns too few frames.
        WriteError: an image cannot be written.
        BitstreamError: the stream cannot be decoded up to the last frame.
        VideoError: the video cannot be read, or changes meanwhile; images written from it are then
            removed.
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

    def write(shown: tuple[int, Picture]) -> tuple[int, Picture | None]:
        index, picture = shown
        picture = change(index, picture) if change is not None else picture
        write_image(wanted[index], picture)
        return index, picture if look is not None else None

    report(0)
    if not wanted:
        return 0
    parents = {path.parent for path in wanted.values()}
    made = [parent for parent in parents if not parent.exists()]
    for parent in parents:
        with writing(parent):
            parent.mkdir(parents=True, exist_ok=True)
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
            done = 0
            with (
                contextlib.closing(decoded),
                contextlib.closing(
                    map_on_threads(write, _pictures(decoded, wanted), num_threads)
                ) as written,
            ):
                for index, picture in written:
                    done += 1
                    if look is not None and picture is not None:
                        look(index, picture)
                    report(done)
            if done < len(wanted):
                raise ImageError(
                    f"the decoder returns no frame {sorted(wanted)[done]} of the "
                    f"{max(wanted) + 1} that the stream shows: leave out the images, or re-encode "
                    "the video"
                )
    except VideoError:  # a later run would mix these images with those of the new video
        for path in wanted.values():
            path.unlink(missing_ok=True)
        for parent in made:
            with contextlib.suppress(OSError):  # not empty
                parent.rmdir()
        raise
    return len(wanted)


def _pictures(
    decoded: Iterable[tuple[int, Picture]], wanted: Collection[int]
) -> Iterator[tuple[int, Picture]]:
    """Yield decoded frames up to the last wanted one, which must have one size."""
    size: tuple[int, ...] | None = None
    last = max(wanted)
    for index, picture in decoded:
        size = size or picture.shape
        if picture.shape != size:
            raise ImageError(
                f"frame {index} is {picture.shape[1]}x{picture.shape[0]}, earlier ones are "
                f"{size[1]}x{size[0]}: images of one camera cannot change their size; "
                "re-encode the video at one size"
            )
        yield index, picture
        if index >= last:
            return


def read_image(path: Path) -> Picture:
    """Read an image file: uint8 [height, width, 3] BGR.

    Raises:
        ImageError: it is missing or cannot be read.
    """
    # COLMAP ignores the EXIF orientation, too.
    how = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    if not may_read(path):
        raise ImageError(f"{path}: permission denied: change its permissions")
    image = None
    try:
        # OpenCV cannot open paths that are not UTF-8.
        data = path.read_bytes() if path.is_file() else b""
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), how) if data else None
    except cv2.error as error:  # more pixels than OpenCV accepts
        raise ImageError(f"{path}: is too large for an image: give the folder of the images") from (
            error
        )
    except OSError as error:
        raise ImageError(
            f"{path}: cannot be read: {error.strerror}: fix that, or give other images"
        ) from error
    if image is None:
        what = "is not an image that OpenCV reads" if data else "is missing or empty"
        raise ImageError(f"{path}: {what}: give the folder of the images")
    return np.asarray(image, dtype=np.uint8)


def grey_within(picture: Picture, longest: int) -> Picture:
    """Convert a BGR picture to grey, downscaled if its longer side exceeds `longest` pixels."""
    scale = min(1.0, longest / max(picture.shape[:2]))
    grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.asarray(grey, np.uint8)


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image file, without decoding it in full.

    Raises:
        ImageError: the file cannot be read as an image.
    """
    size = (0, 0)
    if path.exists() and not path.is_file():
        raise ImageError(f"{path}: is a pipe, device or folder, not an image: remove it")
    try:
        with av.open(os.path.abspath(path)) as container:
            if container.streams.video:
                size = container.streams.video[0].width, container.streams.video[0].height
    except PermissionError as error:
        raise ImageError(f"{path}: permission denied: change its permissions") from error
    except (av.error.FFmpegError, OSError, ValueError) as error:
        check_memory(error)
        raise ImageError(f"{path}: is not a readable image: remove it") from error
    if size == (0, 0):
        raise ImageError(f"{path}: is not a readable image: remove it")
    return size


def write_image(path: Path, image: Picture) -> None:
    """Write an image (BGR), PNG or JPEG by its extension; it appears when it is complete.

    Raises:
        WriteError: the file cannot be written.
        OptionError: the extension is that of another format.
    """
    check_extension(path.name)
    suffix = path.suffix.lower()
    encoded = cv2.imencode(suffix, image, WRITE_PARAMETERS[suffix])[1].tobytes()
    with writing(path), whole_file(path) as partial:
        partial.write_bytes(encoded)

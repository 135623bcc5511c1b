"""Photos that become images together with those of videos."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import pycolmap

from colmap_av1.errors import ImageError, writing
from colmap_av1.images.files import READABLE, UNREADABLE, image_size, read_image
from colmap_av1.images.names import image_file, natural_key, plain_name
from colmap_av1.options.images import IMAGE_EXTENSIONS
from colmap_av1.util.files import whole_file
from colmap_av1.util.texts import check_name, some_names
from colmap_av1.video.unchanged import FileState, file_state

# Markers of JPEG (ITU-T T.81, table B.1). The end of the image does not occur within a scan.
_START_OF_IMAGE, _END_OF_IMAGE, _START_OF_SCAN = b"\xff\xd8", b"\xff\xd9", b"\xda"
_MARKER = re.compile(rb"\xff+([^\x00\xff])")


@dataclass(frozen=True)
class Photo:
    """A photo.

    Attributes:
        path: the file.
        name: path relative to the folder of all images.
        size: (width, height) in pixels as stored; the EXIF orientation is ignored, as in COLMAP.
        camera: the camera according to EXIF; empty if unknown.
        focal_length: focal length in pixels according to EXIF; None if unknown.
        place: latitude and longitude in degrees, altitude in metres, according to EXIF; None if
            unknown.
        state: the state of the file when it was read.
    """

    path: Path
    name: str
    size: tuple[int, int]
    camera: str
    focal_length: float | None
    place: tuple[float, float, float] | None
    state: FileState


def photo_files(folder: Path) -> tuple[list[Path], str | None]:
    """The photos in a folder and its subfolders, and a warning about those that cannot be read.

    Returns:
        Paths relative to the folder, in natural order, at least one; and the warning.

    Raises:
        ImageError: there is no such folder, it cannot be read, or it holds no photo.
    """
    if not folder.is_dir():
        what = "is a file" if folder.exists() else "no such folder"
        raise ImageError(f"{folder}: {what}: give the folder of the photos")
    found, unread = [], []
    for parent, folders, files in os.walk(folder, onerror=_raise_unreadable):
        folders[:] = [name for name in folders if not name.startswith(".")]
        for name in files:
            path = Path(parent, name).relative_to(folder)
            suffix = path.suffix.lower()
            if name.startswith("."):
                continue
            if suffix in READABLE:
                found.append(path)
            elif suffix in UNREADABLE:
                unread.append(path)
    named = sorted((p.as_posix() for p in unread), key=natural_key)
    convert = f"convert these to JPEG or PNG: {some_names(named)}"
    if not found:
        why = f"{convert}" if unread else "give a folder with JPEG or PNG files"
        raise ImageError(f"{folder}: holds no photo that can be read: {why}")
    order = sorted(found, key=lambda path: natural_key(path.as_posix()))
    warning = f"{folder}: ignored {len(unread)} photos: {convert}" if unread else None
    return order, warning


def _raise_unreadable(error: OSError) -> None:
    raise ImageError(
        f"{error.filename}: cannot be read: {error.strerror}: give another folder of photos"
    ) from error


def read_photos(
    folder: Path, files: Sequence[Path], label: str, *, for_trainers: bool
) -> list[Photo]:
    """Read the sizes and EXIF data of photos.

    Args:
        folder: the folder of the photos.
        files: their paths in it.
        label: their folder in the folder of all images.
        for_trainers: name them for trainers, with one dot and an extension that can be written.

    Raises:
        ImageError: a photo is damaged, or two would have the same name.
    """
    photos: list[Photo] = []
    names: dict[str, Path] = {}
    for file in files:
        path = folder / file
        name = str(
            PurePosixPath(label, _name_for_trainers(file) if for_trainers else file.as_posix())
        )
        check_name(name)
        # Masks for trainers are PNG files with the name of the image.
        key = str(PurePosixPath(name).with_suffix("")) if for_trainers else name
        if key in names:
            raise ImageError(
                f"{path} and {folder / names[key]} would both be image '{key}': rename one"
            )
        names[key] = file
        size = image_size(path)
        bitmap = pycolmap.Bitmap.read(path, as_rgb=False)
        if bitmap is None or _is_cut_short(path):
            raise ImageError(f"{path}: is damaged: copy it again, or remove it")
        if path.suffix.lower() not in {".jpg", ".jpeg"}:  # which are checked without decoding
            read_image(path)
        camera, focal_length = bitmap.exif_camera_model() or "", bitmap.exif_focal_length()
        place = _place_of(bitmap)
        photos.append(Photo(path, name, size, camera, focal_length, place, file_state(path)))
    return photos


def _place_of(bitmap: pycolmap.Bitmap) -> tuple[float, float, float] | None:
    """Position of a photo according to EXIF; the altitude is 0 if unknown."""
    latitude, longitude = bitmap.exif_latitude(), bitmap.exif_longitude()
    if latitude is None or longitude is None:
        return None
    return float(latitude), float(longitude), float(bitmap.exif_altitude() or 0)


def _is_cut_short(path: Path) -> bool:
    """Whether a JPEG file is truncated; decoders would fill the missing part with grey."""
    with path.open("rb") as file:
        if file.read(len(_START_OF_IMAGE)) != _START_OF_IMAGE:
            return False
        data = file.read()
    # Segments are skipped by their lengths because one may hold a thumbnail, which has the same
    # markers. What follows the image, such as the video of a motion photo, is not read.
    marker = _MARKER.search(data)
    while marker is not None and marker[1] != _START_OF_SCAN:
        length = int.from_bytes(data[marker.end() : marker.end() + 2], "big")
        marker = _MARKER.search(data, marker.end() + length)
    return marker is None or data.find(_END_OF_IMAGE, marker.end()) < 0


def _name_for_trainers(file: Path) -> str:
    """A photo's path in a form that trainers accept."""
    suffix = file.suffix.lower()
    plain = [plain_name(part) for part in file.with_suffix("").parts]
    return "/".join(plain) + (suffix if suffix in IMAGE_EXTENSIONS else ".png")


def copy_photos(photos: Sequence[Photo], folder: Path) -> int:
    """Copy photos to the folder of all images; existing copies stay.

    Returns:
        The number of photos copied.

    Raises:
        ImageError: another file has the name of a photo.
        WriteError: a photo cannot be copied.
    """
    num_copied = 0
    for photo in photos:
        file = image_file(folder, photo.name)
        if file.exists():
            _check_same(photo, file)
            continue
        with writing(file):
            file.parent.mkdir(parents=True, exist_ok=True)
            with whole_file(file) as partial:
                shutil.copyfile(photo.path, partial)
        num_copied += 1
    return num_copied


def check_copies(photos: Sequence[Photo], folder: Path) -> None:
    """Check that no other file in the folder of all images has the name of a photo.

    Raises:
        ImageError: another file has the name of a photo.
    """
    for photo in photos:
        file = image_file(folder, photo.name)
        if file.exists():
            _check_same(photo, file)


def _check_same(photo: Photo, file: Path) -> None:
    if file.samefile(photo.path) or file.read_bytes() == photo.path.read_bytes():
        return
    raise ImageError(
        f"{file}: is another file than the photo {photo.path}, which would get this name: give "
        "another image folder, or rename the folder of the photos"
    )

"""Photos that become images beside those of videos."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import pycolmap

from colmap_av1.errors import ImageError, cannot_write
from colmap_av1.images.files import READABLE, image_size
from colmap_av1.images.names import image_file, natural_key
from colmap_av1.options.images import IMAGE_EXTENSIONS
from colmap_av1.util.files import whole_file
from colmap_av1.util.texts import check_name
from colmap_av1.video.unchanged import FileState, file_state

# Photos as phones and cameras write them that nothing here reads: worth a word where they are left
# out; other files beside photos are not.
_UNREADABLE_PHOTOS = {".heic", ".heif", ".avif", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf"}
_NUM_NAMED = 3
_JPEG = {".jpg", ".jpeg"}
# Markers of JPEG (ITU-T T.81, table B.1); neither occurs within a scan.
_START_OF_SCAN, _END_OF_IMAGE = b"\xff\xda", b"\xff\xd9"


@dataclass(frozen=True)
class Photo:
    """A photo.

    Attributes:
        path: the file.
        name: path relative to the folder of all images.
        size: (width, height) in pixels as they are stored; an orientation in EXIF is left alone,
            as COLMAP does.
        camera: what EXIF says of the camera; empty where it says nothing.
        focal_length: in pixels, by EXIF; None where it says nothing.
        place: latitude and longitude in degrees, altitude in metres, by EXIF; None likewise.
        state: the state of the file when it was looked at.
    """

    path: Path
    name: str
    size: tuple[int, int]
    camera: str
    focal_length: float | None
    place: tuple[float, float, float] | None
    state: FileState


def photo_files(folder: Path) -> tuple[list[Path], str | None]:
    """The photos in a folder and those below it, and a warning of those that nothing reads.

    Returns:
        Paths relative to the folder, in their natural order; at least one.

    Raises:
        ImageError: there is no such folder, it cannot be read, or holds no photo.
    """
    if not folder.is_dir():
        what = "is a file" if folder.exists() else "no such folder"
        raise ImageError(f"{folder}: {what}: give the folder of the photos")
    found, unread = [], []
    for parent, folders, files in os.walk(folder, onerror=_refuse):
        folders[:] = [name for name in folders if not name.startswith(".")]
        for name in files:
            path = Path(parent, name).relative_to(folder)
            suffix = path.suffix.lower()
            if suffix in READABLE and not name.startswith("."):
                found.append(path)
            elif suffix in _UNREADABLE_PHOTOS:
                unread.append(path)
    said = sorted((p.as_posix() for p in unread), key=natural_key)
    some = ", ".join(said[:_NUM_NAMED]) + (", ..." if len(said) > _NUM_NAMED else "")
    convert = f"convert these to JPEG or PNG: {some}"
    if not found:
        why = f"{convert}" if unread else "give a folder with JPEG or PNG files"
        raise ImageError(f"{folder}: holds no photo that can be read: {why}")
    order = sorted(found, key=lambda path: natural_key(path.as_posix()))
    warning = f"{folder}: {len(unread)} photos are left out, {convert}" if unread else None
    return order, warning


def _refuse(error: OSError) -> None:
    raise ImageError(
        f"{error.filename}: cannot be read: {error.strerror}: give a folder of photos that can"
    ) from error


def read_photos(folder: Path, files: Sequence[Path], label: str, *, flat: bool) -> list[Photo]:
    """Look at photos: their sizes, and what EXIF says of their cameras.

    Args:
        folder: the folder of the photos.
        files: their paths in it.
        label: folder among all images that their names get.
        flat: they are written anew for trainers, which want names with one dot and an extension
            that can be written.

    Raises:
        ImageError: one is damaged, or two would have one name.
    """
    photos: list[Photo] = []
    names: dict[str, Path] = {}
    for file in files:
        path = folder / file
        name = str(PurePosixPath(label, _flat(file) if flat else file.as_posix()))
        check_name(name)
        if name in names:
            raise ImageError(
                f"{path} and {folder / names[name]} would both be image '{name}': rename one"
            )
        names[name] = file
        size = image_size(path)
        bitmap = pycolmap.Bitmap.read(path, as_rgb=False)
        if bitmap is None or _is_cut_short(path):
            raise ImageError(f"{path}: is damaged: copy it anew, or remove it")
        camera, focal_length = bitmap.exif_camera_model() or "", bitmap.exif_focal_length()
        place = _place_of(bitmap)
        photos.append(Photo(path, name, size, camera, focal_length, place, file_state(path)))
    return photos


def _place_of(bitmap: pycolmap.Bitmap) -> tuple[float, float, float] | None:
    """Where a photo was taken, by EXIF; at sea level where that says no altitude."""
    latitude, longitude = bitmap.exif_latitude(), bitmap.exif_longitude()
    if latitude is None or longitude is None:
        return None
    return float(latitude), float(longitude), float(bitmap.exif_altitude() or 0)


def _is_cut_short(path: Path) -> bool:
    """Whether a JPEG file ends within its picture, whose rest decoders paint grey."""
    if path.suffix.lower() not in _JPEG:
        return False
    data = path.read_bytes()
    return data.rfind(_END_OF_IMAGE) < data.rfind(_START_OF_SCAN)


def _flat(file: Path) -> str:
    """A photo's path as trainers take it."""
    suffix = file.suffix.lower()
    plain = [re.sub(r"[^\w-]+", "_", part) for part in file.with_suffix("").parts]
    return "/".join(plain) + (suffix if suffix in IMAGE_EXTENSIONS else ".png")


def place_photos(photos: Sequence[Photo], folder: Path) -> int:
    """Copy photos to their names in the folder of all images; those that are there stay.

    Returns:
        The number of photos copied.

    Raises:
        ImageError: another file has a photo's name, or one cannot be copied.
    """
    num_copied = 0
    for photo in photos:
        file = image_file(folder, photo.name)
        if file.exists():
            _check_same(photo, file)
            continue
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            with whole_file(file) as partial:
                shutil.copyfile(photo.path, partial)
        except OSError as error:
            raise ImageError(cannot_write(file, error)) from error
        num_copied += 1
    return num_copied


def check_places(photos: Sequence[Photo], folder: Path) -> None:
    """Refuse photos whose names other files have in the folder of all images.

    Raises:
        ImageError: so it is.
    """
    for photo in photos:
        file = image_file(folder, photo.name)
        if file.exists():
            _check_same(photo, file)


def _check_same(photo: Photo, file: Path) -> None:
    if file.samefile(photo.path) or file.read_bytes() == photo.path.read_bytes():
        return
    raise ImageError(
        f"{file}: is another file than {photo.path}, which would have this name: give another "
        "image folder, or rename the folder of the photos"
    )

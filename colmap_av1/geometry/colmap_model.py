"""Read COLMAP models with pycolmap, and write them quickly from arrays."""

from __future__ import annotations

import mmap
import os
import re
import struct
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap
from numpy.typing import NDArray

from colmap_av1.errors import ImageError, ModelError
from colmap_av1.geometry.cameras import camera_fault
from colmap_av1.util.arrays import Bools, Floats, Ints
from colmap_av1.util.files import may_read
from colmap_av1.util.grouping import grouped
from colmap_av1.util.texts import check_name

_FILES = ("cameras", "images", "points3D")
# Files that `map` and `densify` write to their output.
MODEL_FILES = re.compile(
    r"(\d+/)?(cameras|frames|images|points3D|rigs)\.(bin|txt)|(\d+/)?project\.ini"
    r"|mapper\.log|place\.json"
)

# Records of COLMAP's binary files, little-endian and packed.
_OBSERVATION = np.dtype([("xy", "<f8", 2), ("point3D_id", "<i8")])
_POINT = np.dtype(
    [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")]
)
_CAMERA_HEAD = 24
_ELEMENT = np.dtype([("image_id", "<u4"), ("point2D_idx", "<u4")])
# Sizes in bytes of the parts of COLMAP's binary files.
_COUNT = struct.Struct("<Q")
_SHORT_COUNT = struct.Struct("<I")
_SMALLEST_CAMERA = _CAMERA_HEAD + 2 * 8  # EQUIRECTANGULAR of COLMAP 4.2: width and height
_IMAGE_HEAD, _POINT_HEAD = 64, 43
_RIG_HEAD, _SENSOR, _POSE = 8, 8, 56
_FRAME_HEAD, _DATA_ID = 8 + _POSE, 16
# Number of points written at a time, to limit memory.
_CHUNK = 20_000
# Smallest number of observations of a point.
_FEWEST_OBSERVATIONS = 2


@dataclass(frozen=True)
class ModelImage:
    """An image of a model.

    Attributes:
        image_id: id of the image.
        name: path relative to the image folder.
        camera_id: id of the image's camera.
        cam_from_world: float64 [3, 4] pose, x_cam = R x_world + t.
    """

    image_id: int
    name: str
    camera_id: int
    cam_from_world: Floats


@dataclass(frozen=True)
class ModelPoints:
    """Points of a model and their observations, in compressed sparse row form.

    Point p has the observations offsets[p] : offsets[p + 1].

    Attributes:
        xyz: float64 [num_points, 3].
        rgb: uint8 [num_points, 3].
        error: float64 [num_points] mean reprojection error in pixels; -1 if unknown.
        offsets: int64 [num_points + 1].
        image: int64 [num_observations] index of the image.
        xy: float64 [num_observations, 2] position in pixels, the first pixel's centre at
            (0.5, 0.5).
    """

    xyz: Floats
    rgb: NDArray[np.uint8]
    error: Floats
    offsets: Ints
    image: Ints
    xy: Floats

    @property
    def point(self) -> Ints:
        """Index of the point of each observation: int64 [num_observations]."""
        return np.repeat(np.arange(len(self.xyz)), np.diff(self.offsets))


def joined_points(parts: Sequence[ModelPoints]) -> ModelPoints:
    """Concatenate sets of points that refer to the same images."""
    counts = np.concatenate([np.diff(part.offsets) for part in parts])
    return ModelPoints(
        xyz=np.concatenate([part.xyz for part in parts]),
        rgb=np.concatenate([part.rgb for part in parts]),
        error=np.concatenate([part.error for part in parts]),
        offsets=np.concatenate([[0], np.cumsum(counts)]),
        image=np.concatenate([part.image for part in parts]),
        xy=np.concatenate([part.xy for part in parts]),
    )


def take_rows(offsets: Ints, rows: Ints) -> tuple[Ints, Ints]:
    """Select rows of data in compressed sparse row form.

    Args:
        offsets: int64 [num_rows + 1] index of the first element of each row.
        rows: int64 [n] the rows to select, in this order.

    Returns:
        int64 [n + 1] offsets of the selected rows, and int64 [m] the indices of their elements.
    """
    lengths = offsets[rows + 1] - offsets[rows]
    taken = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
    return taken, np.arange(taken[-1]) + np.repeat(offsets[rows] - taken[:-1], lengths)


def take_points(points: ModelPoints, rows: Ints) -> ModelPoints:
    """Select points, in the order of `rows`."""
    offsets, seen = take_rows(points.offsets, rows)
    return ModelPoints(
        points.xyz[rows],
        points.rgb[rows],
        points.error[rows],
        offsets,
        points.image[seen],
        points.xy[seen],
    )


def keep_observations(points: ModelPoints, kept: Bools) -> tuple[ModelPoints, Ints]:
    """Keep some of the observations, and the points with two or more of them.

    Args:
        points: the points.
        kept: bool [num_observations].

    Returns:
        The points that are left, and int64 [n] their indices in `points`.
    """
    so_far = np.concatenate([[0], np.cumsum(kept)])
    lengths = np.diff(so_far[points.offsets])
    enough = lengths >= _FEWEST_OBSERVATIONS
    seen = kept & np.repeat(enough, np.diff(points.offsets))
    left = ModelPoints(
        points.xyz[enough],
        points.rgb[enough],
        points.error[enough],
        np.concatenate([[0], np.cumsum(lengths[enough])]),
        points.image[seen],
        points.xy[seen],
    )
    return left, np.flatnonzero(enough)


def no_points() -> ModelPoints:
    """An empty set of points."""
    return ModelPoints(
        np.empty((0, 3)),
        np.empty((0, 3), np.uint8),
        np.empty(0),
        np.zeros(1, np.int64),
        np.empty(0, np.int64),
        np.empty((0, 2)),
    )


def camera_centres(cam_from_world: Floats) -> Floats:
    """Camera centres in the world, float64 [n, 3], of cam_from_world poses [n, 3, 4]."""
    rotation, translation = cam_from_world[:, :, :3], cam_from_world[:, :, 3]
    return np.asarray(-np.einsum("nij,ni->nj", rotation, translation), dtype=np.float64)


def posed_images(reconstruction: pycolmap.Reconstruction) -> dict[str, ModelImage]:
    """The registered images of a pycolmap.Reconstruction, by name."""
    return {
        image.name: ModelImage(
            int(image.image_id),
            image.name,
            int(image.camera_id),
            np.asarray(image.cam_from_world().matrix()),
        )
        for image in reconstruction.images.values()
        if image.has_pose
    }


def model_points(
    reconstruction: pycolmap.Reconstruction, images: Sequence[ModelImage]
) -> ModelPoints:
    """All points of a pycolmap.Reconstruction, ordered by id, with their observations in `images`.

    Args:
        reconstruction: the model.
        images: the images whose observations are kept; `ModelPoints.image` is an index into them.
    """
    index = {image.image_id: k for k, image in enumerate(images)}
    xy = {
        i: np.array([p.xy for p in reconstruction.images[i].points2D], dtype=np.float64)
        for i in index
    }
    points = [reconstruction.points3D[i] for i in sorted(reconstruction.points3D)]
    own = [[e for e in p.track.elements if int(e.image_id) in index] for p in points]
    seen = [element for elements in own for element in elements]
    return ModelPoints(
        xyz=np.array([p.xyz for p in points], dtype=np.float64).reshape(-1, 3),
        rgb=np.array([p.color for p in points], dtype=np.uint8).reshape(-1, 3),
        error=np.array([p.error for p in points], dtype=np.float64),
        offsets=np.cumsum([0, *map(len, own)], dtype=np.int64),
        image=np.array([index[int(e.image_id)] for e in seen], dtype=np.int64),
        xy=np.array([xy[int(e.image_id)][e.point2D_idx] for e in seen], dtype=np.float64).reshape(
            -1, 2
        ),
    )


def write_model(
    folder: Path,
    cameras: Mapping[int, pycolmap.Camera],
    images: Sequence[ModelImage],
    points: ModelPoints,
) -> None:
    """Write cameras.bin, images.bin and points3D.bin, which all versions of COLMAP read.

    Args:
        folder: an existing folder.
        cameras: pycolmap.Camera by id.
        images: the images.
        points: the points; they get ids from 1.

    Raises:
        OSError: a file cannot be written.
    """
    with (folder / "cameras.bin").open("wb") as file:
        file.write(struct.pack("<Q", len(cameras)))
        for camera_id, camera in sorted(cameras.items()):
            size = int(camera.width), int(camera.height)
            file.write(struct.pack("<IiQQ", camera_id, int(camera.model.value), *size))
            file.write(np.asarray(camera.params, dtype="<f8").tobytes())

    lengths = np.diff(points.offsets)
    owner = np.repeat(np.arange(len(lengths)), lengths)
    by_image, bounds = grouped(points.image, len(images))
    index_in_image = np.empty(len(points.image), dtype=np.int64)
    index_in_image[by_image] = np.arange(len(by_image)) - np.repeat(bounds[:-1], np.diff(bounds))
    with (folder / "images.bin").open("wb") as file:
        file.write(struct.pack("<Q", len(images)))
        for image, start, stop in zip(images, bounds[:-1], bounds[1:], strict=True):
            x, y, z, w = pycolmap.Rotation3d(image.cam_from_world[:, :3]).quat
            pose = (w, x, y, z, *image.cam_from_world[:, 3])
            file.write(struct.pack("<I7dI", image.image_id, *pose, image.camera_id))
            file.write(image.name.encode() + b"\0")
            seen = by_image[start:stop]
            rows = np.empty(len(seen), dtype=_OBSERVATION)
            rows["xy"], rows["point3D_id"] = points.xy[seen], owner[seen] + 1
            file.write(struct.pack("<Q", len(rows)))
            file.write(rows.tobytes())

    elements = np.empty(len(points.image), dtype=_ELEMENT)
    elements["image_id"] = np.array([i.image_id for i in images], dtype=np.uint32)[points.image]
    elements["point2D_idx"] = index_in_image
    with (folder / "points3D.bin").open("wb") as file:
        file.write(struct.pack("<Q", len(lengths)))
        for first in range(0, len(lengths), _CHUNK):
            last = min(first + _CHUNK, len(lengths))
            file.write(_point_records(points, elements, first, last))


def _point_records(points: ModelPoints, elements: NDArray[Any], first: int, last: int) -> bytes:
    """The binary records, including tracks, of the points first : last."""
    offsets = points.offsets[first : last + 1]
    lengths = np.diff(offsets)
    heads = np.empty(last - first, dtype=_POINT)
    heads["id"] = np.arange(first, last) + 1
    heads["xyz"], heads["rgb"] = points.xyz[first:last], points.rgb[first:last]
    heads["error"], heads["length"] = points.error[first:last], lengths
    size, each = _POINT.itemsize, _ELEMENT.itemsize
    starts = np.arange(last - first) * size + (offsets[:-1] - offsets[0]) * each
    is_head = np.zeros(len(heads) * size + int(lengths.sum()) * each, dtype=np.bool_)
    is_head[(starts[:, None] + np.arange(size)).ravel()] = True
    records = np.empty(len(is_head), dtype=np.uint8)
    records[is_head] = heads.view(np.uint8).ravel()
    records[~is_head] = elements[offsets[0] : offsets[-1]].view(np.uint8).ravel()
    return records.tobytes()


def read_model(model: str | os.PathLike[str]) -> pycolmap.Reconstruction:
    """Read a COLMAP model.

    Args:
        model: folder with cameras, images and points3D, all .bin or all .txt.

    Returns:
        The pycolmap.Reconstruction without points whose position is not finite; a warning gives
        their number.

    Raises:
        ModelError: the folder has no model, or the model is damaged or has no registered images.
    """
    path = Path(model)
    if not any(
        all((path / f"{name}{suffix}").is_file() for name in _FILES) for suffix in (".bin", ".txt")
    ):
        found = sorted(path.glob("**/cameras.bin"))
        inside = next((p for p in found if ".stages" not in p.parts), None)
        hint = f": did you mean {inside.parent}?" if inside else ": give a mapper's output folder"
        raise ModelError(f"{path}: has no COLMAP model (cameras, images, points3D){hint}")
    for file in (path / f"{name}{suffix}" for name in _FILES for suffix in (".bin", ".txt")):
        if not may_read(file):
            raise ModelError(f"{file}: permission denied: change its permissions")
    is_binary = (path / "cameras.bin").is_file()
    unreadable = ModelError(
        f"{path}: the model cannot be read, it is damaged or from a newer COLMAP: map again, or "
        "update pycolmap"
    )
    try:
        # pycolmap aborts the process if a damaged file declares a huge count.
        if is_binary and not are_whole(path):
            raise unreadable
        reconstruction = pycolmap.Reconstruction(path)
    except (RuntimeError, ValueError, IndexError, KeyError, OSError, MemoryError) as error:
        raise unreadable from error
    cameras = path / "cameras.bin"
    sizes = [_CAMERA_HEAD + 8 * len(c.params) for c in reconstruction.cameras.values()]
    # pycolmap does not notice a truncated cameras.bin.
    if cameras.is_file() and cameras.stat().st_size < 8 + sum(sizes):
        raise unreadable
    if reconstruction.num_reg_images() == 0:
        raise ModelError(f"{path}: the model has no registered images: give a mapped model")
    _check_values(path, reconstruction)
    point_ids = list(reconstruction.points3D)
    xyz = np.array([p.xyz for p in reconstruction.points3D.values()]).reshape(-1, 3)
    nowhere = np.flatnonzero(~np.isfinite(xyz).all(axis=1))
    for index in nowhere:
        reconstruction.delete_point3D(point_ids[index])
    if len(nowhere):
        warnings.warn(
            f"{path}: ignored {len(nowhere)} points without a finite position", stacklevel=2
        )
    return reconstruction


def _check_values(path: Path, reconstruction: pycolmap.Reconstruction) -> None:
    """Raise if a name, pose or camera is invalid, which pycolmap does not check."""
    map_again = "map again, or give another model"
    for image_id, image in reconstruction.images.items():
        try:
            check_name(image.name)
        except UnicodeDecodeError:
            raise ModelError(
                f"{path}: the name of image {image_id} is not UTF-8: rename it"
            ) from None
        except ImageError as error:
            raise ModelError(f"{path}: {error}") from error
        if image.has_pose and not np.isfinite(image.cam_from_world().matrix()).all():
            raise ModelError(
                f"{path}: image {image.name!r} has a pose that is not finite: {map_again}"
            )
    for camera_id, camera in reconstruction.cameras.items():
        fault = camera_fault(camera)
        if fault:
            raise ModelError(f"{path}: camera {camera_id} has {fault}: {map_again}")


def are_whole(model: Path) -> bool:
    """Whether a model's binary files contain all records that their counts declare.

    Args:
        model: folder with cameras.bin, images.bin and points3D.bin; rigs.bin and frames.bin of
            COLMAP 3.12 and later are checked if they exist.

    Raises:
        OSError: a file cannot be read.
    """
    files: dict[str, Callable[[mmap.mmap], bool]] = {
        "cameras.bin": _cameras,
        "images.bin": _images,
        "points3D.bin": _points,
        "rigs.bin": _rigs,
        "frames.bin": _frames,
    }
    return all(
        _is_whole(model / name, holds) for name, holds in files.items() if (model / name).exists()
    )


def _is_whole(path: Path, holds: Callable[[mmap.mmap], bool]) -> bool:
    with path.open("rb") as file:
        if path.stat().st_size < _COUNT.size:
            return False
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            try:
                return holds(data)
            except struct.error:  # The file ends before a count.
                return False


def _cameras(data: mmap.mmap) -> bool:
    # The length of a record depends on the camera model; pycolmap checks it.
    (count,) = _COUNT.unpack_from(data)
    return bool(_COUNT.size + count * _SMALLEST_CAMERA <= len(data))


def _images(data: mmap.mmap) -> bool:
    (count,) = _COUNT.unpack_from(data)
    position = _COUNT.size
    for _ in range(count):
        end_of_name = data.find(b"\0", position + _IMAGE_HEAD)
        if end_of_name < 0:
            return False
        (num_points,) = _COUNT.unpack_from(data, end_of_name + 1)
        position = end_of_name + 1 + _COUNT.size + num_points * _OBSERVATION.itemsize
        if position > len(data):
            return False
    return True


def _points(data: mmap.mmap) -> bool:
    (count,) = _COUNT.unpack_from(data)
    position, end, each = _COUNT.size, len(data), _ELEMENT.itemsize
    unpack = _COUNT.unpack_from  # Saves the look-up for millions of points.
    for _ in range(count):
        (length,) = unpack(data, position + _POINT_HEAD)
        position += _POINT_HEAD + _COUNT.size + length * each
        if position > end:
            return False
    return True


def _rigs(data: mmap.mmap) -> bool:
    (count,) = _COUNT.unpack_from(data)
    position = _COUNT.size
    for _ in range(count):
        (num_sensors,) = _SHORT_COUNT.unpack_from(data, position + _RIG_HEAD - _SHORT_COUNT.size)
        position += _RIG_HEAD + (_SENSOR if num_sensors else 0)
        if position + (num_sensors - 1) * (_SENSOR + 1) > len(data):
            return False
        for _ in range(num_sensors - 1):
            has_pose = data[position + _SENSOR : position + _SENSOR + 1] != b"\0"
            position += _SENSOR + 1 + (_POSE if has_pose else 0)
        if position > len(data):
            return False
    return True


def _frames(data: mmap.mmap) -> bool:
    (count,) = _COUNT.unpack_from(data)
    position = _COUNT.size
    for _ in range(count):
        (num_ids,) = _SHORT_COUNT.unpack_from(data, position + _FRAME_HEAD)
        position += _FRAME_HEAD + _SHORT_COUNT.size + num_ids * _DATA_ID
        if position > len(data):
            return False
    return True

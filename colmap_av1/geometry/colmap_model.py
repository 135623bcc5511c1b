"""Read COLMAP models with pycolmap, and write them quickly from arrays."""

from __future__ import annotations

import os
import re
import struct
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap
from numpy.typing import NDArray

from colmap_av1.errors import ImageError, ModelError
from colmap_av1.geometry.binary_files import CAMERA_HEAD, ELEMENT, OBSERVATION, are_whole
from colmap_av1.geometry.cameras import camera_fault
from colmap_av1.geometry.model_points import ModelPoints
from colmap_av1.util.arrays import Floats
from colmap_av1.util.files import STAGES, may_read
from colmap_av1.util.grouping import grouped
from colmap_av1.util.texts import check_name

_FILES = ("cameras", "images", "points3D")
# Files that `map` and `densify` write to their output.
MODEL_FILES = re.compile(
    r"(\d+/)?(cameras|frames|images|points3D|rigs)\.(bin|txt)|(\d+/)?project\.ini"
    r"|mapper\.log|place\.json"
)

# The record of a point, see `binary_files`.
_POINT = np.dtype(
    [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")]
)
# Number of points written at a time, to limit memory.
_CHUNK = 20_000


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


def camera_centres(cam_from_world: Floats) -> Floats:
    """Camera centres in the world, float64 [n, 3], of cam_from_world poses [n, 3, 4]."""
    rotation, translation = cam_from_world[:, :, :3], cam_from_world[:, :, 3]
    return np.asarray(-np.einsum("nij,ni->nj", rotation, translation), dtype=np.float64)


def relative_pose(a: Floats, b: Floats) -> Floats:
    """The pose b_from_a, float64 [3, 4], of the poses a_from_world and b_from_world [3, 4]."""
    rotation = b[:, :3] @ a[:, :3].T
    return np.column_stack([rotation, b[:, 3] - rotation @ a[:, 3]])


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


def point_positions(reconstruction: pycolmap.Reconstruction) -> Floats:
    """The points of a pycolmap.Reconstruction: float64 [n, 3], in the order of their ids."""
    xyz = [point.xyz for point in _points(reconstruction)]
    return np.array(xyz, dtype=np.float64).reshape(-1, 3)


def point_colours(reconstruction: pycolmap.Reconstruction) -> NDArray[np.uint8]:
    """The colours of these points: uint8 [n, 3] RGB, in the order of their ids."""
    rgb = [point.color for point in _points(reconstruction)]
    return np.array(rgb, dtype=np.uint8).reshape(-1, 3)


def _points(reconstruction: pycolmap.Reconstruction) -> list[pycolmap.Point3D]:
    every = reconstruction.points3D
    return [every[i] for i in sorted(every)]


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
    points = _points(reconstruction)
    own = [[e for e in p.track.elements if int(e.image_id) in index] for p in points]
    seen = [element for elements in own for element in elements]
    return ModelPoints(
        xyz=point_positions(reconstruction),
        rgb=point_colours(reconstruction),
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

    point = points.point
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
            rows = np.empty(len(seen), dtype=OBSERVATION)
            rows["xy"], rows["point3D_id"] = points.xy[seen], point[seen] + 1
            file.write(struct.pack("<Q", len(rows)))
            file.write(rows.tobytes())

    elements = np.empty(len(points.image), dtype=ELEMENT)
    elements["image_id"] = np.array([i.image_id for i in images], dtype=np.uint32)[points.image]
    elements["point2D_idx"] = index_in_image
    with (folder / "points3D.bin").open("wb") as file:
        file.write(struct.pack("<Q", len(points.xyz)))
        for first in range(0, len(points.xyz), _CHUNK):
            last = min(first + _CHUNK, len(points.xyz))
            file.write(_point_records(points, elements, first, last))


def _point_records(points: ModelPoints, elements: NDArray[Any], first: int, last: int) -> bytes:
    """The binary records, including tracks, of the points first : last."""
    offsets = points.offsets[first : last + 1]
    lengths = np.diff(offsets)
    heads = np.empty(last - first, dtype=_POINT)
    heads["id"] = np.arange(first, last) + 1
    heads["xyz"], heads["rgb"] = points.xyz[first:last], points.rgb[first:last]
    heads["error"], heads["length"] = points.error[first:last], lengths
    size, each = _POINT.itemsize, ELEMENT.itemsize
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
        inside = next((p for p in found if STAGES not in p.parts), None)
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
    sizes = [CAMERA_HEAD + 8 * len(c.params) for c in reconstruction.cameras.values()]
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

"""Reading images, cameras, pose priors, keypoints and matches from a COLMAP database."""

from __future__ import annotations

import math
import os
import sqlite3
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_av1.database.file import is_new, open_unaltered
from colmap_av1.database.layout import MAX_NUM_IMAGES, columns
from colmap_av1.errors import DatabaseError
from colmap_av1.geometry.cameras import camera_fault
from colmap_av1.util.arrays import Floats

# Neutral values of a keypoint's columns after x and y, by the number of columns: scale and
# orientation for 4, a 2x2 affine shape for 6.
SHAPES = {2: (), 4: (1.0, 0.0), 6: (1.0, 0.0, 0.0, 1.0)}
# COLMAP's PosePriorCoordinateSystem: latitude, longitude and altitude, or Cartesian coordinates.
WGS84, _CARTESIAN = 0, 1
_POSITION_BYTES = 24


@dataclass(frozen=True)
class DatabaseImage:
    """An image that a database lists.

    Attributes:
        image_id: its id.
        name: path relative to the image folder.
        camera_id: id of its camera.
        width: width of the camera in pixels.
        height: height of the camera in pixels.
        num_keypoints: number of stored keypoints.
        num_matches: number of stored matches with other images, verified or not.
    """

    image_id: int
    name: str
    camera_id: int
    width: int
    height: int
    num_keypoints: int
    num_matches: int


def pair_id_from_image_ids(image_id1: int, image_id2: int) -> int:
    """Pair id of two images, in either order."""
    return MAX_NUM_IMAGES * min(image_id1, image_id2) + max(image_id1, image_id2)


def image_ids_from_pair_id(pair_id: int) -> tuple[int, int]:
    """Image ids of a pair, the smaller one first."""
    return pair_id // MAX_NUM_IMAGES, pair_id % MAX_NUM_IMAGES


def read_images(database: str | os.PathLike[str]) -> list[DatabaseImage]:
    """List the images of a database, ordered by id.

    Returns:
        The images; an empty list if the file is absent or empty.

    Raises:
        DatabaseError: the file is locked, unreadable, or not a COLMAP database.
    """
    path = Path(database)
    if is_new(path):
        return []
    with open_unaltered(path) as connection:
        rows = connection.execute(
            "SELECT image_id, name, camera_id, COALESCE(width, 0), COALESCE(height, 0), "
            "COALESCE(keypoints.rows, 0) FROM images LEFT JOIN cameras USING (camera_id) "
            "LEFT JOIN keypoints USING (image_id) ORDER BY image_id"
        ).fetchall()
        # Count a pair once, whether its matches are in one table or in both.
        pair_rows = connection.execute(
            "SELECT pair_id, MAX(rows) FROM (SELECT pair_id, rows FROM matches UNION ALL "
            "SELECT pair_id, rows FROM two_view_geometries) WHERE rows > 0 GROUP BY pair_id"
        ).fetchall()
    num_matches: dict[int, int] = {}
    for pair_id, count in pair_rows:
        for image_id in image_ids_from_pair_id(pair_id):
            num_matches[image_id] = num_matches.get(image_id, 0) + count
    return [
        DatabaseImage(
            image_id, name, camera_id, width, height, num_keypoints, num_matches.get(image_id, 0)
        )
        for image_id, name, camera_id, width, height, num_keypoints in rows
    ]


def read_cameras(database: str | os.PathLike[str]) -> dict[int, pycolmap.Camera]:
    """Read the cameras of a database, by id.

    Raises:
        DatabaseError: the file is locked, unreadable, or not a COLMAP database, or has a
            camera with invalid parameters or of a model that the installed pycolmap does not know.
    """
    path = Path(database)
    if is_new(path):
        return {}
    with open_unaltered(path) as connection:
        cameras = cameras_of(connection, path)
    for camera_id, camera in cameras.items():
        fault = camera_fault(camera)
        if fault:
            raise DatabaseError(f"{path}: camera {camera_id} has {fault}: import the images again")
    return cameras


@dataclass(frozen=True)
class PosePrior:
    """Position prior of an image.

    Attributes:
        position: float64 [3] latitude and longitude in degrees and altitude in metres (WGS 84), or
            Cartesian coordinates.
        is_cartesian: whether the position is Cartesian.
    """

    position: Floats
    is_cartesian: bool


def read_pose_priors(database: str | os.PathLike[str]) -> dict[str, PosePrior]:
    """Read the position priors of a database, by image name, for the images that have one.

    Raises:
        DatabaseError: the file is locked, unreadable, or not a COLMAP database.
    """
    with open_unaltered(Path(database)) as connection:
        rows: list[tuple[Any, ...]] = []
        if "prior_tx" in columns(connection, "images"):  # COLMAP 3.8 and 3.9
            rows += connection.execute(
                f"SELECT name, {WGS84}, prior_tx, prior_ty, prior_tz FROM images ORDER BY image_id"
            ).fetchall()
        kept = columns(connection, "pose_priors")
        if {"position", "coordinate_system"} <= kept:
            owner = "corr_data_id" if "pose_prior_id" in kept else "image_id"
            found = connection.execute(
                f"SELECT name, coordinate_system, position FROM pose_priors "
                f"JOIN images ON images.image_id = pose_priors.{owner} ORDER BY images.image_id"
            ).fetchall()
            rows += [(n, s, *struct.unpack("<3d", p)) for n, s, p in found if _is_position(p)]
    return {
        name: PosePrior(np.array(position, dtype=np.float64), system == _CARTESIAN)
        for name, system, *position in rows
        if system in (WGS84, _CARTESIAN)
        and all(isinstance(x, float) and math.isfinite(x) for x in position)
    }


def _is_position(blob: object) -> bool:
    return isinstance(blob, bytes) and len(blob) == _POSITION_BYTES


def cameras_of(connection: sqlite3.Connection, path: Path) -> dict[int, pycolmap.Camera]:
    """Cameras of an open database, by id. Sizes and parameter values are not checked.

    Raises:
        DatabaseError: a camera is of a model that the installed pycolmap does not know.
    """
    rows = connection.execute(
        "SELECT camera_id, model, width, height, params, prior_focal_length FROM cameras "
        "ORDER BY camera_id"
    ).fetchall()
    models = {int(model.value): model for model in pycolmap.CameraModelId.__members__.values()}
    cameras = {}
    for camera_id, model, width, height, params, prior in rows:
        data = params or b""
        camera = pycolmap.Camera(
            camera_id=camera_id,
            model=models.get(model, pycolmap.CameraModelId.INVALID),
            width=width,
            height=height,
            params=np.frombuffer(data[: len(data) // 8 * 8], dtype="<f8"),
        )
        if model not in models or len(data) % 8 or not camera.verify_params():
            raise DatabaseError(
                f"{path}: camera {camera_id} has model {model} with parameters of {len(data)} "
                "bytes, which pycolmap does not know: update pycolmap, or import the images again"
            )
        camera.has_prior_focal_length = bool(prior)
        cameras[camera_id] = camera
    return cameras


def read_keypoints(
    connection: sqlite3.Connection, path: Path, image_id: int
) -> NDArray[np.float32]:
    """Read the keypoints of an image: float32 [n, 2], [n, 4] or [n, 6], x and y first.

    Raises:
        DatabaseError: the row's size contradicts its counts, or a position is not finite.
    """
    row = connection.execute(
        "SELECT rows, cols, data FROM keypoints WHERE image_id = ? AND rows > 0", (image_id,)
    ).fetchone()
    if row is None:
        return np.empty((0, 2), np.float32)
    keypoints = stored_keypoints(path, image_id, *row)
    if not np.isfinite(keypoints[:, :2]).all():
        raise DatabaseError(
            f"{path}: image {image_id} has keypoints that are not finite numbers: "
            "run 'colmap-av1 check' for a full list of problems"
        )
    return keypoints


def stored_keypoints(
    path: Path, image_id: int, num_rows: int, num_cols: int, data: bytes | None
) -> NDArray[np.float32]:
    """Decode a row of keypoints, without checking that positions are finite.

    Raises:
        DatabaseError: the row's size contradicts its counts.
    """
    if num_cols not in SHAPES or len(data or b"") != 4 * num_rows * num_cols:
        raise DatabaseError(
            f"{path}: the keypoints of image {image_id} are damaged ({num_rows} rows of "
            f"{num_cols} columns in {len(data or b'')} bytes): restore the file from a copy"
        )
    return np.frombuffer(data or b"", dtype="<f4").reshape(num_rows, num_cols)


def matches_from_row(
    path: Path, pair_id: int, num_rows: int, data: bytes | None
) -> NDArray[np.uint32]:
    """Decode a row of matches or inliers: uint32 [n, 2], the smaller image id's column first.

    Raises:
        DatabaseError: the row's size contradicts its count.
    """
    if len(data or b"") != 8 * num_rows:
        i, j = image_ids_from_pair_id(pair_id)
        raise DatabaseError(
            f"{path}: the matches of images {i} and {j} are damaged ({num_rows} rows in "
            f"{len(data or b'')} bytes): restore the file from a copy"
        )
    return np.frombuffer(data or b"", dtype="<u4").reshape(num_rows, 2)

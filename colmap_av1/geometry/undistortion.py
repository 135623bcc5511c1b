"""Undistortion: the pinhole camera for a camera with distortion, and undistorted pictures."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap
from numpy.typing import NDArray

from colmap_av1.errors import ModelError
from colmap_av1.geometry.cameras import is_undistorted
from colmap_av1.geometry.masks import Mask, make_mask
from colmap_av1.util.arrays import Floats, Ints, Picture

# Range of the ratio of the focal lengths of the undistorted and the distorted camera.
_ZOOM_RANGE = (0.25, 4.0)
_BISECTIONS = 40
# Width of the table in which single pixels are sampled.
_COLUMNS = 512


def pinhole_camera(camera: pycolmap.Camera) -> pycolmap.Camera:
    """Find the pinhole camera of the same size with the widest field of view and no empty pixels.

    Args:
        camera: pycolmap.Camera of any perspective model.

    Returns:
        pycolmap.Camera, PINHOLE, with the id and the principal point of the given one.

    Raises:
        ModelError: there is no such camera, for example for a fisheye lens of 180 degrees.
    """
    size = {"width": int(camera.width), "height": int(camera.height)}
    centre = [camera.principal_point_x, camera.principal_point_y]
    focal = np.array([camera.focal_length_x, camera.focal_length_y])
    zoom = 1.0
    if not is_undistorted(camera):
        width, height = size["width"], size["height"]
        x, y = np.arange(width + 1.0), np.arange(height + 1.0)
        edge = np.concatenate(
            [
                *(np.column_stack([x, np.full_like(x, at)]) for at in (0, height)),
                *(np.column_stack([np.full_like(y, at), y]) for at in (0, width)),
            ]
        )

        def is_filled(zoom: float) -> bool:
            on_source = _project(camera, (edge - centre) / (focal * zoom))
            inside = (on_source >= -0.5) & (on_source <= np.array([width, height]) + 0.5)
            return bool(inside.all())

        low, high = _ZOOM_RANGE
        if not is_filled(high):
            raise ModelError(
                f"camera {camera.model_name} {camera.params.tolist()} cannot be undistorted: give "
                "--camera_model and --camera_params, or --camera_model SIMPLE_PINHOLE, or keep the "
                "distortion with --undistort 0"
            )
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            low, high = (low, middle) if is_filled(middle) else (middle, high)
        zoom = high
    params = [*(focal * zoom), *centre]
    camera_id = int(camera.camera_id)
    return pycolmap.Camera(camera_id=camera_id, model="PINHOLE", params=params, **size)


def output_cameras(
    cameras: Mapping[int, pycolmap.Camera], *, undistort: bool
) -> dict[int, pycolmap.Camera]:
    """The cameras of the written images by id: pinhole cameras if `undistort`, else as given.

    Raises:
        ModelError: see `pinhole_camera`.
    """
    return {i: pinhole_camera(c) if undistort else c for i, c in cameras.items()}


def _project(camera: pycolmap.Camera, rays: Floats) -> Floats:
    """Project undistorted positions (x / z, y / z) to pixels."""
    return np.asarray(camera.img_from_cam(np.column_stack([rays, np.ones(len(rays))])))


def on_pinholes(rays: Floats, view: Ints, pinholes: Sequence[pycolmap.Camera]) -> Floats:
    """Pixels [n, 2] of undistorted positions (x / z, y / z) in the pinhole cameras of views [n]."""
    params = np.array([pinhole.params for pinhole in pinholes])
    if len(params) and (params == params[0]).all():
        # With equal cameras, skip the look-up for each ray, which takes most of the time.
        return np.asarray(rays * params[0, :2] + params[0, 2:])
    xy = np.empty(rays.shape)
    for axis in range(2):
        xy[:, axis] = rays[:, axis] * params[view, axis] + params[view, 2 + axis]
    return xy


def undistorted_masks(
    masks: Sequence[Mask | None],
    cameras: Sequence[pycolmap.Camera],
    pinholes: Mapping[int, pycolmap.Camera],
) -> list[Mask | None]:
    """Undistort the masks of images, at the size of the undistorted images.

    Args:
        masks: the mask of each image, or None.
        cameras: the camera of each image.
        pinholes: the pinhole camera for each camera, by camera id.
    """

    # Only one map is cached, because it takes much memory and images of a camera are consecutive.
    @functools.lru_cache(maxsize=1)
    def change_of(camera_id: int) -> Undistortion | None:
        return undistortion(of_id[camera_id], pinholes[camera_id], cv2.INTER_NEAREST)

    @functools.cache
    def undistort(mask: Mask, camera_id: int) -> Mask:
        pinhole = pinholes[camera_id]
        size = (int(pinhole.width), int(pinhole.height))
        kept = mask.kept.astype(np.uint8)
        if mask.size != size:
            kept = cv2.resize(kept, size, interpolation=cv2.INTER_NEAREST)
        change = change_of(camera_id)
        return make_mask((change(kept) if change is not None else kept) > 0)

    of_id = {int(camera.camera_id): camera for camera in cameras}
    return [
        undistort(mask, int(camera.camera_id)) if mask is not None else None
        for mask, camera in zip(masks, cameras, strict=True)
    ]


@dataclass(frozen=True)
class Undistortion:
    """Undistorts the pictures of a camera.

    Attributes:
        source: float32 [height, width, 2] position in the distorted picture of each pixel of the
            undistorted one, with the first pixel's centre at (0, 0).
        interpolation: OpenCV's interpolation flag.
    """

    source: NDArray[np.float32]
    interpolation: int

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of undistorted pictures in pixels."""
        height, width = self.source.shape[:2]
        return width, height

    def __call__(self, picture: Picture) -> Picture:
        """Undistort a picture, uint8 [height, width, ...]."""
        return self._looked_up(picture, self.source)

    def pixels(self, picture: Picture, x: Ints, y: Ints) -> Picture:
        """Pixels [n, ...] of the undistorted picture at columns x [n] and rows y [n]."""
        # Arranged as a table, because cv2.remap limits the length of rows and columns.
        rows = -(-len(x) // _COLUMNS)
        source = np.resize(self.source[y, x], (rows, _COLUMNS, 2))
        found = self._looked_up(picture, source) if rows else picture[:0]
        return found.reshape(-1, *picture.shape[2:])[: len(x)]

    def _looked_up(self, picture: Picture, source: NDArray[np.float32]) -> Picture:
        edge = cv2.BORDER_REPLICATE
        found = cv2.remap(picture, source, None, self.interpolation, borderMode=edge)
        return np.asarray(found, np.uint8)


def undistortion(
    camera: pycolmap.Camera, pinhole: pycolmap.Camera, interpolation: int = cv2.INTER_CUBIC
) -> Undistortion | None:
    """Create the map that undistorts the pictures of a camera.

    Returns:
        The map; None if the pictures need no change, because the camera has no distortion or
        `pinhole` has distortion as well.
    """
    if is_undistorted(camera) or not is_undistorted(pinhole):
        return None
    fx, fy, cx, cy = pinhole.params
    width, height = int(pinhole.width), int(pinhole.height)
    rays = np.ones((height, width, 3))
    rays[..., 0] = (np.arange(width) + 0.5 - cx) / fx
    rays[..., 1] = ((np.arange(height) + 0.5 - cy) / fy)[:, None]
    source = np.asarray(camera.img_from_cam(rays.reshape(-1, 3)))
    # In OpenCV, the first pixel's centre is (0, 0).
    at = (source - 0.5).reshape(height, width, 2).astype(np.float32)
    return Undistortion(at, interpolation)

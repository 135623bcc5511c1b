"""Create and check pycolmap cameras: model, parameters, initial focal length."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import pycolmap

from colmap_av1.errors import OptionError
from colmap_av1.options import CameraOptions
from colmap_av1.options.camera import (
    DEFAULT_MODEL,
    DEFAULT_MODEL_OF_KNOWN_FOCAL_LENGTH,
    DEFAULT_MODEL_OF_OBLONG_PIXELS,
    camera_of_model,
    parse_camera_params,
)

# COLMAP's mappers ignore images whose camera is outside these limits: focal length in units of the
# longer image side, and absolute value of each distortion parameter.
MAPPER_FOCAL_RATIOS = (0.1, 10.0)
MAPPER_MAX_DISTORTION = 1.0
# Models without distortion, and all models that a pinhole camera can initialize.
_UNDISTORTED = ("SIMPLE_PINHOLE", "PINHOLE")
_RECTILINEAR = (*_UNDISTORTED, "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
# Initial focal lengths, as a share of the longer image side: 0.9 for phones and drones with about
# 60 degrees field of view, and 0.5 for fisheye lenses with about 115 degrees. COLMAP's default of
# 1.2 (45 degrees) often makes its mapper fail on videos of phones.
_INITIAL_SHARE, _INITIAL_FISHEYE_SHARE = 0.9, 0.5
# Plausible focal lengths in units of the longer image side: fields of view from 118 to 11 degrees.
_SHORTEST, _LONGEST = 0.3, 5.0
# Longer focal lengths, in units of the longer image side, are rare in videos: fields of view below
# 45 degrees. With little parallax, a mapper may converge to twice the true focal length.
_LONG = 1.2
# A principal point that is further off centre, as a share of the image side, is doubtful. Cropped
# pictures may have one.
_MOST_OFF_CENTRE = 0.2
# Larger image sides in pixels are damaged data.
_LONGEST_SIDE = 1 << 20
# Encoders round the display size of scaled pictures, by a few tenths of a percent.
_SQUARE_TOLERANCE = 5e-3


def make_camera(
    options: CameraOptions,
    width: int,
    height: int,
    pixel_aspect: float = 1.0,
    focal_length: float | None = None,
) -> pycolmap.Camera:
    """Create the camera of new images.

    Without parameters, the focal length is 0.9 times the longer side (0.5 times for fisheye
    models), the principal point is the image centre, and there is no distortion; the camera has no
    focal length prior. If pixels are not square, this refers to the picture as it is displayed.
    With given parameters or an estimated focal length, the camera has a focal length prior.

    Args:
        options: camera model and parameters.
        width: image width in pixels.
        height: image height in pixels.
        pixel_aspect: width of a pixel over its height.
        focal_length: estimated focal length in pixel heights; used if no parameters are given.

    Raises:
        OptionError: the parameters do not fit the given or the default model, or their principal
            point lies outside the image.
    """
    name = options.camera_model
    if name is None:
        estimated = focal_length is not None and options.camera_params is None
        square = DEFAULT_MODEL_OF_KNOWN_FOCAL_LENGTH if estimated else DEFAULT_MODEL
        name = square if is_square(pixel_aspect) else DEFAULT_MODEL_OF_OBLONG_PIXELS
    is_known = focal_length is not None or options.camera_params is not None
    if focal_length is None:
        focal_length = _initial_share(name) * max(width * pixel_aspect, height)
    camera = camera_of_model(name, focal_length, width, height)
    if has_two_focal_lengths(camera):
        params = camera.params
        params[camera.focal_length_idxs()[0]] = focal_length / pixel_aspect
        camera.params = params.tolist()
    camera.has_prior_focal_length = is_known
    if options.camera_params is not None:
        camera.params = parse_camera_params(options.camera_params, camera)
        x, y = camera.principal_point_x, camera.principal_point_y
        if not (0 < x < width and 0 < y < height):
            raise OptionError(
                f"camera_params has the principal point ({x:g}, {y:g}), but the images are "
                f"{width}x{height}: give the parameters for this size"
            )
    return camera


def _initial_share(model: str) -> float:
    """Initial focal length of a camera model, in units of the longer image side."""
    return _INITIAL_FISHEYE_SHARE if is_fisheye(model) else _INITIAL_SHARE


def camera_fault(camera: pycolmap.Camera) -> str | None:
    """The fault of an invalid camera, as a phrase that follows "has"; None if it is valid."""
    if not 0 < camera.width <= _LONGEST_SIDE or not 0 < camera.height <= _LONGEST_SIDE:
        return f"a size of {camera.width}x{camera.height}"
    if not np.isfinite(camera.params).all():
        return "parameters that are not numbers"
    if any(camera.params[i] <= 0 for i in camera.focal_length_idxs()):
        return "a focal length of 0 or less"
    return None


def focal_length_warning(cameras: Iterable[pycolmap.Camera]) -> str | None:
    """Warn of an implausible focal length, which is a sign of a wrong estimate.

    Args:
        cameras: pycolmap.Cameras. Fisheye lenses may have shorter focal lengths than others.
    """
    for camera in cameras:
        ratio = camera.mean_focal_length() / max(camera.width, camera.height)
        if ratio > _LONGEST or (ratio < _SHORTEST and not is_fisheye(camera.model_name)):
            return (
                f"the focal length is implausible, {camera.mean_focal_length():.0f} px at a size "
                f"of {camera.width}x{camera.height}: give --camera_model and --camera_params"
            )
    return None


def has_implausible_intrinsics(camera: pycolmap.Camera) -> bool:
    """Whether intrinsics are a sign that their refinement diverged.

    The focal length is as in `focal_length_warning`, or a distortion parameter exceeds the limit of
    COLMAP's mappers.
    """
    shortest = MAPPER_FOCAL_RATIOS[0] if is_fisheye(camera.model_name) else _SHORTEST
    return camera.has_bogus_params(shortest, _LONGEST, MAPPER_MAX_DISTORTION)


def off_centre_warning(camera: pycolmap.Camera) -> str | None:
    """Warn of a principal point far from the centre, as in parameters for another picture size."""
    x, y = camera.principal_point_x, camera.principal_point_y
    away = max(abs(x / camera.width - 0.5), abs(y / camera.height - 0.5))
    if away <= _MOST_OFF_CENTRE:
        return None
    return (
        f"camera_params has the principal point ({x:g}, {y:g}), far from the centre of images of "
        f"{camera.width}x{camera.height}: check that the parameters are for this size and not for "
        "the rotated picture"
    )


def has_long_focal_length(camera: pycolmap.Camera) -> bool:
    """Whether the focal length is longer than in most videos, as with a telephoto lens."""
    return bool(camera.mean_focal_length() > _LONG * max(camera.width, camera.height))


def with_initial_intrinsics(camera: pycolmap.Camera) -> pycolmap.Camera:
    """A camera of the same model with the focal length of a new camera, and without distortion."""
    initial = copy.copy(camera)
    focal_length = _initial_share(camera.model_name) * max(camera.width, camera.height)
    params = np.array(camera.params)
    params[camera.focal_length_idxs()] *= focal_length / camera.mean_focal_length()
    params[camera.extra_params_idxs()] = 0.0
    initial.params = params.tolist()
    initial.has_prior_focal_length = False
    return initial


def assumes_focal_length(cameras: Iterable[pycolmap.Camera]) -> bool:
    """Whether the focal length of a camera is assumed, neither estimated nor given."""
    return not all(camera.has_prior_focal_length for camera in cameras)


def with_known_focal_lengths(cameras: Sequence[pycolmap.Camera]) -> list[pycolmap.Camera]:
    """Copies of the cameras whose focal length counts as known.

    Otherwise COLMAP 4.2 replaces it by an estimate from the initial pair. Images share a camera if
    it is the same object.
    """
    copies = {id(camera): copy.copy(camera) for camera in cameras}
    for camera in copies.values():
        camera.has_prior_focal_length = True
    return [copies[id(camera)] for camera in cameras]


def as_radial(camera: pycolmap.Camera) -> pycolmap.Camera:
    """The same camera as a RADIAL one, from a SIMPLE_RADIAL one."""
    radial = copy.copy(camera)
    radial.model = pycolmap.CameraModelId.RADIAL
    radial.params = [*camera.params, 0.0]
    return radial


def poselib_camera(focal_length: float) -> dict[str, Any]:
    """A pinhole camera in PoseLib's form, with the principal point at the origin.

    Args:
        focal_length: in the units of the positions that PoseLib gets.
    """
    # PoseLib does not use the size.
    params = [focal_length, 0.0, 0.0]
    return {"model": "SIMPLE_PINHOLE", "width": 1, "height": 1, "params": params}


def is_undistorted(camera: pycolmap.Camera) -> bool:
    """Whether the model of a pycolmap.Camera has no distortion."""
    return camera.model_name in _UNDISTORTED


def is_nearly_pinhole(model: str | None) -> bool:
    """Whether a pinhole camera can initialize the named model; True for None."""
    return model is None or model in _RECTILINEAR


def is_fisheye(model: str | None) -> bool:
    """Whether the named model is one of COLMAP's fisheye models, which are nearly equidistant."""
    return model is not None and "FISHEYE" in model


def has_two_focal_lengths(camera: pycolmap.Camera) -> bool:
    """Whether the model of a pycolmap.Camera has separate focal lengths for x and y."""
    return len(camera.focal_length_idxs()) == 2


def check_pixel_aspect(camera: pycolmap.Camera, pixel_aspect: float, what_to_do: str) -> list[str]:
    """Warn of a camera with a single focal length if pixels are not square.

    Args:
        camera: a pycolmap.Camera.
        pixel_aspect: width of a pixel over its height.
        what_to_do: the remedy for the message.
    """
    if is_square(pixel_aspect) or has_two_focal_lengths(camera):
        return []
    return [
        f"pixels are {pixel_aspect:.3f} times as wide as high, but {camera.model_name} has a "
        f"single focal length; OPENCV and PINHOLE have two: {what_to_do}"
    ]


def largest_size(cameras: Iterable[pycolmap.Camera]) -> tuple[int, int]:
    """Smallest (width, height) that holds the images of all cameras."""
    sizes = [(int(camera.width), int(camera.height)) for camera in cameras]
    return max(width for width, _ in sizes), max(height for _, height in sizes)


def is_square(pixel_aspect: float) -> bool:
    """Whether pixels are square, up to rounding of the display size."""
    return abs(pixel_aspect - 1) < _SQUARE_TOLERANCE

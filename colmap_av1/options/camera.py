"""Camera options of new images."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from colmap_av1.errors import OptionError
from colmap_av1.options.fields import Options, option

if TYPE_CHECKING:
    import pycolmap

# Default models of new cameras. The first is COLMAP's own. If the focal length is estimated, a
# second distortion parameter is used, because unmodelled distortion biases the focal length and
# bends the path. The third is the simplest model with distortion and two focal lengths.
DEFAULT_MODEL = "SIMPLE_RADIAL"
DEFAULT_MODEL_OF_KNOWN_FOCAL_LENGTH = "RADIAL"
DEFAULT_MODEL_OF_OBLONG_PIXELS = "OPENCV"
# Largest accepted time from the first row of a picture to the last, in milliseconds.
_LONGEST_READ_OUT = 100


@dataclass(frozen=True)
class CameraOptions(Options):
    """The camera written for new images.

    Examples:
        >>> from colmap_av1 import CameraOptions, MatchOptions
        >>> camera = CameraOptions("SIMPLE_PINHOLE", "600,320,240")
        >>> MatchOptions(camera=camera).camera.camera_model
        'SIMPLE_PINHOLE'
    """

    title: ClassVar[str] = "camera"

    camera_model: str | None = option(
        None,
        "one of COLMAP's camera models; None: RADIAL if the focal length is recorded in the video "
        "or can be estimated from the tracks, or if the images of a video show that the lens needs "
        "it, else SIMPLE_RADIAL; OPENCV, which has two focal lengths, if pixels are not square",
        common=True,
        colmap="ImageReader.camera_model",
    )
    camera_params: str | None = option(
        None,
        "camera parameters in COLMAP's order, such as 'f,cx,cy,k'; None: the focal length is "
        "estimated from the tracks, else it starts at 0.9 times the longer side (fisheye models: "
        "0.5 times) and is refined; the principal point is the image centre",
        common=True,
        colmap="ImageReader.camera_params",
    )
    single_camera: bool | None = option(
        None,
        "1: one camera for all images; 0: one for each image; None: one for each video, and one "
        "for the photos of each camera and size",
        colmap="ImageReader.single_camera",
    )

    rolling_shutter: str = option(
        "none",
        "estimate: estimate from the tracks how long the shutter takes to read the rows of a "
        "picture, and move keypoints to the middle of the read-out if that fits the tracks better; "
        "or this time in milliseconds, negative if rows are read from the bottom; none: assume a "
        "global shutter",
    )

    @property
    def needs_every_frame(self) -> bool:
        """Whether the motion of all frames is needed, to correct the rolling shutter."""
        return self.rolling_shutter != "none"

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_shutter(self.rolling_shutter)
        if self.camera_model is not None:
            models = [self.camera_model]
        elif self.camera_params is not None:
            # The default model depends on the pixel aspect, which is not known yet.
            models = [DEFAULT_MODEL, DEFAULT_MODEL_OF_OBLONG_PIXELS]
        else:
            return  # avoids importing pycolmap
        cameras = [camera_of_model(name) for name in models]
        if self.camera_params is not None:
            num_given = self.camera_params.count(",") + 1
            fitting = (c for c in cameras if len(c.params) == num_given)
            parse_camera_params(self.camera_params, next(fitting, cameras[0]))


def _check_shutter(wanted: str) -> None:
    """Raise if a read-out time is invalid."""
    if wanted in ("estimate", "none"):
        return
    try:
        milliseconds = float(wanted)
    except ValueError:
        milliseconds = math.nan
    if not abs(milliseconds) <= _LONGEST_READ_OUT:
        raise OptionError(
            f"rolling_shutter is {wanted!r}: give estimate, none, or milliseconds from "
            f"{-_LONGEST_READ_OUT} to {_LONGEST_READ_OUT}"
        )


def camera_of_model(
    name: str, focal_length: float = 1.0, width: int = 1, height: int = 1
) -> pycolmap.Camera:
    """Create a camera of one of COLMAP's models, with the principal point in the centre.

    Raises:
        OptionError: there is no such model, or it has no focal length.
    """
    import pycolmap  # noqa: PLC0415 - slow to import

    models = pycolmap.CameraModelId.__members__
    if name not in models or name == "INVALID":
        known = ", ".join(n for n in models if n != "INVALID")
        raise OptionError(f"unknown camera model {name!r}: give one of {known}")
    camera = pycolmap.Camera.create_from_model_id(0, models[name], focal_length, width, height)
    if len(camera.focal_length_idxs()) == 0:
        raise OptionError(
            f"camera model {name} has no focal length: give a perspective or fisheye model such as "
            "SIMPLE_RADIAL"
        )
    return camera


def parse_camera_params(text: str, camera: pycolmap.Camera) -> list[float]:
    """Parse comma-separated camera parameters, in COLMAP's order.

    Raises:
        OptionError: the parameters do not fit the camera's model.
    """
    wanted = f"{camera.model.name} takes {len(camera.params)} numbers, {camera.params_info}"
    try:
        params = [float(word) for word in text.split(",")]
    except ValueError:
        raise OptionError(f"cannot read camera_params {text!r}: {wanted}") from None
    if len(params) != len(camera.params) or not all(map(math.isfinite, params)):
        raise OptionError(f"camera_params {text!r} do not fit the model: {wanted}")
    if min(params[i] for i in camera.focal_length_idxs()) <= 0:
        raise OptionError(f"camera_params {text!r} have a focal length of 0 or less: {wanted}")
    return params

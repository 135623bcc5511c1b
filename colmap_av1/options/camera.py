"""Options of the camera of new images."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from colmap_av1.errors import OptionError
from colmap_av1.options.fields import Options, option

if TYPE_CHECKING:
    import pycolmap

# Models of new cameras where none is given: COLMAP's own choice; where the focal length is
# estimated, one with two distortion parameters, as distortion beyond one bends focal length and
# path; and the simplest with two focal lengths and distortion.
DEFAULT_MODEL = "SIMPLE_RADIAL"
DEFAULT_MODEL_OF_KNOWN_FOCAL_LENGTH = "RADIAL"
DEFAULT_MODEL_OF_OBLONG_PIXELS = "OPENCV"
# Time from the first row of a picture to the last that no camera takes, in milliseconds.
_LONGEST_READ_OUT = 100


@dataclass(frozen=True)
class CameraOptions(Options):
    """The camera written for new images."""

    title: ClassVar[str] = "camera"
    colmap_prefix: ClassVar[str] = "ImageReader"

    camera_model: str | None = option(
        None,
        "one of COLMAP's camera models; None: RADIAL where the focal length can be estimated from "
        "the tracks, else SIMPLE_RADIAL; OPENCV, which has two focal lengths, where pixels are not "
        "square",
        common=True,
    )
    camera_params: str | None = option(
        None,
        "its parameters in COLMAP's order, such as 'f,cx,cy,k'; None: the focal length estimated "
        "from the tracks, else 0.9 times the longer side, 0.5 times with fisheye models, to be "
        "refined; principal point in the centre",
        common=True,
    )
    single_camera: bool | None = option(
        None,
        "1: one camera for all images; 0: one for each; None: one for each video, and for the "
        "photos of each camera and size",
    )

    rolling_shutter: str = option(
        "none",
        "estimate: from the tracks, the time in which the shutter reads the rows of a picture, and "
        "move keypoints to where they are in the middle of it, where that explains the tracks "
        "better; or that time in milliseconds, below 0 where rows are read from the bottom; none: "
        "all rows are taken at once",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_shutter(self.rolling_shutter)
        if self.camera_model is not None:
            models = [self.camera_model]
        elif self.camera_params is not None:
            # Which of them depends on the pixels' shape.
            models = [DEFAULT_MODEL, DEFAULT_MODEL_OF_OBLONG_PIXELS]
        else:
            return  # nothing that pycolmap would have to be imported for
        cameras = [camera_of_model(name) for name in models]
        if self.camera_params is not None:
            num_given = self.camera_params.count(",") + 1
            fitting = (c for c in cameras if len(c.params) == num_given)
            parse_camera_params(self.camera_params, next(fitting, cameras[0]))


def _check_shutter(wanted: str) -> None:
    """Refuse a read-out time that is none."""
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
    """A pycolmap.Camera of one of COLMAP's models, principal point in the centre.

    Raises:
        OptionError: there is no such model, or it has no focal length.
    """
    import pycolmap  # noqa: PLC0415 - slow to import, and options are not

    models = pycolmap.CameraModelId.__members__
    if name not in models or name == "INVALID":
        known = ", ".join(n for n in models if n != "INVALID")
        raise OptionError(f"unknown camera model {name!r}: give one of {known}")
    create = getattr(pycolmap.Camera, "create_from_model_id", None) or pycolmap.Camera.create
    camera: pycolmap.Camera = create(0, models[name], focal_length, width, height)
    if len(camera.focal_length_idxs()) == 0:
        raise OptionError(
            f"camera model {name} has no focal length, so it does not fit a "
            "video: give a perspective or fisheye model such as SIMPLE_RADIAL"
        )
    return camera


def parse_camera_params(text: str, camera: pycolmap.Camera) -> list[float]:
    """The parameters of a pycolmap.Camera's model from COLMAP's spelling.

    Raises:
        OptionError: they do not fit the model.
    """
    wanted = f"{camera.model.name} takes {len(camera.params)} numbers, {camera.params_info}"
    try:
        params = [float(word) for word in text.split(",")]
    except ValueError:
        raise OptionError(f"cannot read camera_params {text!r}: {wanted}") from None
    if len(params) != len(camera.params) or not all(map(math.isfinite, params)):
        raise OptionError(f"camera_params {text!r} do not fit: {wanted}")
    if min(params[i] for i in camera.focal_length_idxs()) <= 0:
        raise OptionError(f"camera_params {text!r} hold a focal length of 0 or less: {wanted}")
    return params

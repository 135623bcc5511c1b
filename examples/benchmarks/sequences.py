"""Image sequences with ground-truth cameras, and the images and poses of their frames."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap
from numpy.typing import NDArray

from colmap_av1 import CameraOptions, ImageOptions, MatchOptions, VerifyOptions, VideoError
from colmap_av1.evaluate import Footage, FrontendRun, make_frontends, run_frontend
from colmap_av1.evaluate.metrics.poses import frame_number, read_poses
from colmap_av1.geometry.colmap_model import posed_images
from colmap_av1.images.files import write_images
from colmap_av1.images.names import image_names
from colmap_av1.util.digests import file_digest
from colmap_av1.util.stages import run_stage_in
from colmap_av1.video.facts import read_video

# The front-ends by name. Image pairs are verified separately: the joint estimate would discard the
# tracks that are measured.
FRONTENDS = make_frontends(MatchOptions(verify=VerifyOptions(verify="pairs")))


@dataclass(frozen=True)
class Sequence:
    """A folder of frames or a clip, with its true intrinsics and poses if known.

    Attributes:
        name: name of the sequence.
        source: the clip, or the folder of frames.
        num_frames: number of frames.
        width: picture width in pixels.
        height: picture height in pixels.
        fps: frames per second.
        camera: pycolmap.Camera with the true intrinsics; None if unknown.
        cam_from_world: float64 [num_frames, 3, 4] true poses in metres, x_cam = R x_world + t,
            NaN for frames without one; None if no pose is known.
    """

    name: str
    source: Path
    num_frames: int
    width: int
    height: int
    fps: float
    camera: pycolmap.Camera | None
    cam_from_world: NDArray[np.float64] | None


def read_sequence(folder: str | os.PathLike[str]) -> Sequence:
    """Read a sequence's description and ground truth.

    The folder has `sequence.json` (name, frames, width, height, fps, intrinsics, clip), either
    `frames/` or the clip named there, and, if poses are known, `groundtruth.txt` with one line for
    each frame: `name tx ty tz qx qy qz qw`, the camera-to-world pose with x right, y down, z
    forward. The number in a name is the frame index, from 0. Intrinsics are the name and parameters
    of a COLMAP camera model, with the first pixel's centre at (0.5, 0.5).

    Raises:
        VideoError: the folder is not a sequence.
        ImageError: a pose refers to a frame that the sequence lacks.
    """
    folder = Path(folder)
    try:
        about = json.loads((folder / "sequence.json").read_text())
    except (OSError, ValueError) as error:
        raise VideoError(f"{folder}: has no readable sequence.json: {error}") from error
    width, height = int(about["width"]), int(about["height"])
    camera = None
    if about.get("intrinsics"):
        camera = pycolmap.Camera(
            model=about["intrinsics"]["model"],
            width=width,
            height=height,
            params=about["intrinsics"]["params"],
        )
    truth = folder / "groundtruth.txt"
    # The clip's description begins with its file name.
    source = folder / (about["clip"].split()[0] if about.get("clip") else "frames")
    if not source.exists():
        raise VideoError(f"{folder}: {source.name}, named in sequence.json, does not exist")
    return Sequence(
        name=about["name"],
        source=source,
        num_frames=int(about["frames"]),
        width=width,
        height=height,
        fps=float(about["fps"]),
        camera=camera,
        cam_from_world=read_poses(truth, int(about["frames"])) if truth.is_file() else None,
    )


def prepare_footage(
    video: Path, folder: Path, *, num_frames: int, image_step: int, camera: CameraOptions
) -> Footage:
    """Write frames of a video at regular steps as the images that every front-end gets.

    Args:
        video: an AV1 video.
        folder: gets `images/`; existing images of the same video are kept.
        num_frames: number of frames of the video.
        image_step: step between the frames that become images.
        camera: camera options of all images.

    Raises:
        VideoError: the video cannot be read.
        ImageError: the video has fewer frames.
    """
    frames = tuple(range(0, num_frames, image_step))
    opened = read_video(video)
    footage = Footage(
        video=video,
        image_path=folder / "images",
        names=image_names(ImageOptions().file_name, frames),
        frames=frames,
        num_frames=num_frames,
        size=opened.picture_size,
        pixel_aspect=opened.display.pixel_aspect,
        camera=camera,
    )

    def make() -> None:
        footage.image_path.mkdir()
        write_images(opened, footage.image_path, footage.names, frames)

    run_stage_in(folder, [file_digest(video), frames], None, make, products=[footage.image_path])
    return footage


def measure_frontend(name: str, footage: Footage, folder: Path) -> FrontendRun:
    """Fill a database with a front-end's default options, see `run_frontend`."""
    return run_frontend(name, footage, folder, FRONTENDS[name])


def model_poses(model: pycolmap.Reconstruction, num_frames: int) -> NDArray[np.float64]:
    """Poses of a model's registered images, by frame.

    Args:
        model: pycolmap.Reconstruction whose image names contain the frame number, from 0.
        num_frames: number of frames of the video.

    Returns:
        float64 [num_frames, 3, 4] cam_from_world, NaN for frames without a registered image.

    Raises:
        ImageError: an image's name has no frame number.
    """
    cam_from_world = np.full((num_frames, 3, 4), np.nan)
    for name, image in posed_images(model).items():
        cam_from_world[frame_number(name)] = image.cam_from_world
    return cam_from_world

"""Image sequences with ground-truth cameras."""

from __future__ import annotations

import json
import os
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from colmap_av1.errors import ImageError, VideoError
from colmap_av1.util.texts import read_lines

_WHAT_TO_GIVE = "give lines of 'name tx ty tz qx qy qz qw', or the folder of a COLMAP model"


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


def frame_number(name: str) -> int:
    """The frame number in a file name: its last group of digits.

    Raises:
        ImageError: the name has no number.
    """
    numbers = re.findall(r"\d+", Path(name).stem)
    if not numbers:
        raise ImageError(f"image '{name}': its name has no frame number: rename it")
    return int(numbers[-1])


def read_poses(path: Path, num_frames: int) -> NDArray[np.float64]:
    """Read true poses from lines of `name tx ty tz qx qy qz qw`, see `read_sequence`.

    Args:
        path: the file.
        num_frames: number of frames of the video.

    Returns:
        float64 [num_frames, 3, 4] cam_from_world, NaN for frames without a line.

    Raises:
        ImageError: the file cannot be read, or refers to a frame that the video lacks.
    """
    cam_from_world = np.full((num_frames, 3, 4), np.nan)
    try:
        lines = read_lines(path)
    except UnicodeDecodeError as error:
        raise ImageError(f"{path}: is not a text file: {_WHAT_TO_GIVE}") from error
    except OSError as error:
        raise ImageError(f"{path}: {error.strerror}: {_WHAT_TO_GIVE}") from error
    for line in lines:
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        frame = frame_number(words[0])
        if frame >= num_frames:
            raise ImageError(
                f"{path}: '{words[0]}' is not one of the {num_frames} frames: give the ground "
                "truth of this video"
            )
        try:
            values = np.array(words[1:], dtype=np.float64)
            rotation = Rotation.from_quat(values[3:7]).as_matrix().T
        except ValueError as error:
            raise ImageError(f"{path}: '{line[:80]}' is not a pose: {_WHAT_TO_GIVE}") from error
        cam_from_world[frame] = np.c_[rotation, -rotation @ values[:3]]
    return cam_from_world

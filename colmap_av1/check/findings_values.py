"""Findings in the values of a database: names, cameras and keypoints that no program can use."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pycolmap

from colmap_av1.check.contents import Images, Pairs
from colmap_av1.check.finding import Finding, some
from colmap_av1.errors import ImageError
from colmap_av1.geometry.cameras import camera_fault
from colmap_av1.util.texts import check_name

# COLMAP's mappers leave out images whose camera is beyond these: focal length in longer sides of
# the image, and any distortion parameter.
_FOCAL_RATIOS = (0.1, 10.0)
_LARGEST_DISTORTION = 1.0
# Keypoints this many pixels outside their image are no rounding.
_MARGIN = 1.0


def value_findings(
    images: Images, pairs: Pairs, cameras: dict[int, pycolmap.Camera]
) -> Iterator[Finding]:
    """Values that no program can use, whatever the rest of the database is like."""
    yield from _name_findings(images)
    yield from _camera_findings(cameras)
    yield from _keypoint_findings(images, cameras)
    for count, fault in (
        (pairs.num_with_itself, "of an image with itself"),
        (pairs.num_swapped, "stored under the larger image id first"),
    ):
        if count:
            yield Finding("warning", f"{count} pairs are {fault}: mappers mix them up", damage=True)


def _name_findings(images: Images) -> Iterator[Finding]:
    if "" in images.names:
        yield Finding("error", "an image has no name: programs find no file for it")
    unusable = [name for name in images.names if name and not _is_usable(name)]
    if unusable:
        yield Finding(
            "error",
            f"{some(unusable, 'image')} with a name outside the image folder, or none that a file "
            "can have: name it by its path within the folder",
        )


def _is_usable(name: str) -> bool:
    try:
        check_name(name)
    except ImageError:
        return False
    return True


def _camera_findings(cameras: dict[int, pycolmap.Camera]) -> Iterator[Finding]:
    faults = {i: camera_fault(camera) for i, camera in cameras.items()}
    for camera_id, fault in faults.items():
        if fault:
            yield Finding("error", f"camera {camera_id} has {fault}: mappers stop or find nothing")
            break
    unlike = [
        str(i)
        for i, camera in cameras.items()
        if not faults[i] and camera.has_bogus_params(*_FOCAL_RATIOS, _LARGEST_DISTORTION)
    ]
    if unlike:
        yield Finding(
            "warning",
            f"{some(unlike, 'camera')} with parameters that do not fit the size of the images: "
            "mappers leave their images out unless they refine the parameters",
        )


def _keypoint_findings(images: Images, cameras: dict[int, pycolmap.Camera]) -> Iterator[Finding]:
    unknown, outside = [], []
    for name, camera_id, xy in zip(images.names, images.camera_ids, images.keypoints, strict=True):
        if not np.isfinite(xy).all():
            unknown.append(name)
        elif len(xy) and camera_id in cameras:
            size = np.array([cameras[camera_id].width, cameras[camera_id].height], np.float64)
            if np.any(xy < -_MARGIN) or np.any(xy > size + _MARGIN):
                outside.append(name)
    if unknown:
        yield Finding(
            "error", f"{some(unknown, 'image')} with keypoints that are not numbers: mappers hang"
        )
    if outside:
        yield Finding(
            "warning",
            f"{some(outside, 'image')} with keypoints outside: is the camera's size that of the "
            "images the keypoints are of?",
            damage=True,
        )

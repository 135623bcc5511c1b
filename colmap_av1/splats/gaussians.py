"""Initial 3D Gaussians, with scales, rotations and opacities, for trainers that accept them."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_av1.errors import OptionError, writing
from colmap_av1.geometry.colmap_model import camera_centres, model_points, posed_images, read_model
from colmap_av1.geometry.distant_points import distance_uncertainty
from colmap_av1.geometry.model_points import ModelPoints
from colmap_av1.geometry.posed_camera import PosedCamera, views_of
from colmap_av1.util.arrays import Floats
from colmap_av1.util.files import check_creatable, check_new_file, whole_file
from colmap_av1.util.grouping import take_rows
from colmap_av1.util.spread import evenly_spread

# Number of evenly spread images in which the spacing of points is measured.
_IMAGES = 32
# Number of neighbours that determine a point's spacing, and the distance in pixels that a depth
# ratio of e adds, so that points on other surfaces are not neighbours.
_NEAREST = 4
_PER_DEPTH = 100.0
# Standard deviation in the tangent plane as a share of the spacing. Larger Gaussians blur detail,
# smaller ones leave gaps between points.
_ACROSS = 0.5
# Bounds on the standard deviation along the normal, as shares of that in the tangent plane. Discs
# are a better initialization than spheres, even if the depth is uncertain.
_THICKNESS = (0.2, 0.5)
# Lower bound on the spacing in pixels, for nearly coincident points.
_LEAST_SPACING = 0.25
# Number of nearest points whose plane gives the normal.
_AROUND = 8
# Training recovers hidden surfaces only if the Gaussians in front are not opaque.
_OPACITY = 0.5
# Value of the spherical harmonic of degree 0.
_SH0 = 0.28209479177387814
# Number of coefficients of degrees 1 to 3, which readers of the reference format require.
_REST = 45
# Number of points processed at a time, to limit memory.
_CHUNK = 100_000
# A line near the start of the files that this module writes.
_MADE_BY = "comment made by colmap-av1 --gaussians"
_HEADER_START = 200


@dataclass(frozen=True)
class Gaussians:
    """3D Gaussians with view-independent colours.

    Attributes:
        xyz: float64 [n, 3] centres.
        normal: float64 [n, 3] unit normals of their surfaces, which are their third axes.
        scale: float64 [n, 3] standard deviations along the axes.
        rotation: float64 [n, 4] unit quaternions (w, x, y, z) of the axes in the world.
        opacity: float64 [n] from 0 to 1.
        rgb: uint8 [n, 3] colours.
    """

    xyz: Floats
    normal: Floats
    scale: Floats
    rotation: Floats
    opacity: Floats
    rgb: NDArray[np.uint8]


def initial_gaussians(points: ModelPoints, images: Sequence[PosedCamera]) -> Gaussians:
    """A Gaussian for each point, sized by the spacing of points in the images.

    Trainers that get only points use the distance between points in space as the size, which depth
    noise and other nearby surfaces falsify. Here a Gaussian is a disc on its surface, and its
    thickness is the uncertainty of the depth.

    Args:
        points: the points, with colours.
        images: the images, which the points' observations refer to.
    """
    across = _ACROSS * _spacing(points.xyz, images)
    rotation, normal = _on_surfaces(points.xyz)
    thickness = np.clip(_depth_error(points, images) / across, *_THICKNESS) * across
    return Gaussians(
        points.xyz,
        normal,
        np.column_stack([across, across, thickness]),
        rotation,
        np.full(len(points.xyz), _OPACITY),
        points.rgb,
    )


def _spacing(xyz: Floats, images: Sequence[PosedCamera]) -> Floats:
    """Distance of each point to its neighbours on the same surface, measured in the images."""
    from scipy.spatial import KDTree  # noqa: PLC0415 - slow to import

    total, count = np.zeros(len(xyz)), np.zeros(len(xyz))
    for view in (images[i] for i in evenly_spread(len(images), _IMAGES)):
        index, xy, depth = view.project(xyz)
        nearest = min(_NEAREST, len(index) - 1)
        if nearest < 1:
            continue
        place = np.column_stack([xy, _PER_DEPTH * np.log(depth)])
        away, _ = KDTree(place).query(place, k=np.arange(nearest) + 2)
        pixels = np.maximum(np.sqrt(np.mean(away**2, axis=1)), _LEAST_SPACING)
        total[index] += np.log(pixels * depth / view.camera.mean_focal_length())
        count[index] += 1
    known = count > 0
    total[known] /= count[known]
    total[~known] = np.median(total[known]) if known.any() else 0.0
    return np.asarray(np.exp(total))


def _on_surfaces(xyz: Floats) -> tuple[Floats, Floats]:
    """Quaternions [n, 4] of local axes, and normals [n, 3], which are the third axes."""
    from scipy.spatial import KDTree  # noqa: PLC0415 - slow to import
    from scipy.spatial.transform import Rotation  # noqa: PLC0415

    rotation, normal = np.empty((len(xyz), 4)), np.empty((len(xyz), 3))
    if len(xyz) == 0:
        return rotation, normal
    tree = KDTree(xyz)
    for first in range(0, len(xyz), _CHUNK):
        own = slice(first, first + _CHUNK)
        _, around = tree.query(xyz[own], k=np.arange(min(_AROUND + 1, len(xyz))) + 1)
        offset = xyz[around] - xyz[around].mean(axis=1, keepdims=True)
        _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", offset, offset))
        # Eigenvalues ascend: the normal comes first.
        axes = axes[:, :, ::-1]
        axes[:, :, 2] = np.cross(axes[:, :, 0], axes[:, :, 1])
        rotation[own] = Rotation.from_matrix(axes).as_quat()[:, [3, 0, 1, 2]]
        normal[own] = axes[:, :, 2]
    return rotation, normal


def _depth_error(points: ModelPoints, images: Sequence[PosedCamera]) -> Floats:
    """Expected error of each point's distance; inf if its observations do not determine one."""
    lengths = np.diff(points.offsets)
    error = np.full(len(lengths), np.inf)
    rows = np.flatnonzero((lengths >= 2) & (points.error >= 0))
    if len(rows) == 0:
        return error
    centres = camera_centres(np.stack([image.cam_from_world for image in images]))
    focal = np.array([image.camera.mean_focal_length() for image in images])
    offsets, seen = take_rows(points.offsets, rows)
    xyz, image = points.xyz[rows], points.image[seen]
    share = distance_uncertainty(
        xyz, points.error[rows], offsets, centres=centres, view=image, focal=focal
    )
    error[rows] = share * np.linalg.norm(xyz - centres[image[offsets[:-1]]], axis=1)
    return error


def check_gaussians_path(
    given: str | os.PathLike[str] | None,
    inputs: Iterable[str | os.PathLike[str] | None],
    *,
    overwrite: bool = False,
) -> None:
    """Check before any work that `write_gaussians` can write a file.

    Args:
        given: the file; None: nothing to check.
        inputs: input files, which must not be overwritten; None entries are ignored.
        overwrite: replace an existing file.

    Raises:
        OptionError: its name does not end in .ply, it is an input or exists, or it cannot be
            written.
    """
    if given is None:
        return
    path = Path(given)
    if path.suffix.lower() != ".ply":
        raise OptionError(f"{path}: Gaussians are written as .ply: give a name that ends in .ply")
    check_new_file(path, inputs, overwrite=overwrite)
    check_creatable(path)


def write_gaussians(path: Path, gaussians: Gaussians) -> None:
    """Write Gaussians in the format of point_cloud.ply of the reference implementation.

    Scales are stored as logarithms, opacities as logits and colours as coefficients of spherical
    harmonics, where those of degrees 1 to 3 are 0.

    Args:
        path: the file; it appears when it is complete, and replaces an existing one.
        gaussians: the Gaussians.

    Raises:
        WriteError: the file cannot be written.
    """
    names = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3))]
    names += [f"f_rest_{i}" for i in range(_REST)]
    names += ["opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    header = ["ply", "format binary_little_endian 1.0", _MADE_BY]
    header += [f"element vertex {len(gaussians.xyz)}"]
    header += [*(f"property float {name}" for name in names), "end_header"]
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(path) as partial, partial.open("wb") as file:
            file.write(("\n".join(header) + "\n").encode())
            for first in range(0, len(gaussians.xyz), _CHUNK):
                file.write(_records(gaussians, slice(first, first + _CHUNK)).tobytes())


def remove_gaussians_in(folder: Path) -> None:
    """Remove the files of `write_gaussians` in a folder.

    Raises:
        WriteError: a file cannot be removed.
    """
    for path in filter(_is_own, sorted(folder.glob("*.ply"))):
        with writing(path):
            path.unlink()


def _is_own(path: Path) -> bool:
    """Whether `write_gaussians` wrote a file."""
    try:
        with path.open("rb") as file:
            return f"\n{_MADE_BY}\n".encode() in file.read(_HEADER_START)
    except OSError:  # a folder, or unreadable
        return False


def write_model_gaussians(path: Path, model: Path) -> None:
    """Write initial Gaussians for the points of a COLMAP model.

    Args:
        path: the file, see `write_gaussians`.
        model: folder of the model.

    Raises:
        ModelError: the model cannot be read.
        WriteError: the file cannot be written.
    """
    reconstruction = read_model(model)
    posed = sorted(posed_images(reconstruction).values(), key=lambda image: image.name)
    cameras = reconstruction.cameras
    views = views_of(posed, dict(cameras))
    write_gaussians(path, initial_gaussians(model_points(reconstruction, posed), views))


def _records(gaussians: Gaussians, own: slice) -> NDArray[np.float32]:
    opacity = gaussians.opacity[own]
    columns = [
        gaussians.xyz[own],
        gaussians.normal[own],
        (gaussians.rgb[own] / 255.0 - 0.5) / _SH0,
        np.zeros((len(opacity), _REST)),
        np.log(opacity / (1.0 - opacity))[:, None],
        np.log(gaussians.scale[own]),
        gaussians.rotation[own],
    ]
    return np.concatenate(columns, axis=1).astype("<f4")

"""Initial 3D Gaussians for trainers that take more than points: sizes, directions, opacity."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_av1.errors import ModelError, OptionError, cannot_write
from colmap_av1.geometry.colmap_model import (
    ModelPoints,
    camera_centres,
    model_points,
    posed_images,
    read_model,
    take_rows,
)
from colmap_av1.geometry.coverage import PosedCamera
from colmap_av1.geometry.distant_points import distance_uncertainty
from colmap_av1.util.files import check_new_file, whole_file
from colmap_av1.util.spread import evenly_spread

_Floats = NDArray[np.float64]

# Images, evenly spread, that tell how far points are from each other.
_IMAGES = 32
# Neighbours in an image whose distances are a point's spacing, and how many pixels apart points
# count whose depths differ by a factor of e: those of other surfaces are no neighbours.
_NEAREST = 4
_PER_DEPTH = 100.0
# Standard deviation across the surface as a share of the spacing: what lies between points is
# covered, and detail is not blurred.
_ACROSS = 0.5
# That along the normal is the error of the depth, within these shares of the one across: training
# starts better from discs than from balls, even where depth is not known.
_THICKNESS = (0.2, 0.5)
# Spacings of points that nearly coincide, in pixels, are not below this.
_LEAST_SPACING = 0.25
# Nearest points in space whose plane gives the normal.
_AROUND = 8
# Trainers find what is hidden only through what does not hide it all.
_OPACITY = 0.5
# First coefficient of spherical harmonics.
_SH0 = 0.28209479177387814
# Further coefficients, of degrees 1 to 3: readers of the reference implementation insist on them.
_REST = 45
# Points worked on at a time; bounds memory.
_CHUNK = 100_000


@dataclass(frozen=True)
class Gaussians:
    """3D Gaussians of one colour from all sides.

    Attributes:
        xyz: float64 [n, 3] centres.
        normal: float64 [n, 3] unit normals of the surfaces that they lie on, their third axes.
        scale: float64 [n, 3] standard deviations along their axes.
        rotation: float64 [n, 4] unit quaternions (w, x, y, z) of the axes in the world.
        opacity: float64 [n] from 0 to 1.
        rgb: uint8 [n, 3] colours.
    """

    xyz: _Floats
    normal: _Floats
    scale: _Floats
    rotation: _Floats
    opacity: _Floats
    rgb: NDArray[np.uint8]


def initial_gaussians(points: ModelPoints, images: Sequence[PosedCamera]) -> Gaussians:
    """A Gaussian for each point, as wide as its neighbours in the images leave room for.

    Trainers that get points alone take the distance to others in space for the size, which noise
    of the depth and other surfaces nearby make wrong. Here a Gaussian is a disc on its surface, the
    thicker the less its depth is known.

    Args:
        points: the points, with colours.
        images: the images, by the index that the points' observations have.
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


def _spacing(xyz: _Floats, images: Sequence[PosedCamera]) -> _Floats:
    """Distance of each point to its neighbours of the same surface, as images show it."""
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


def _on_surfaces(xyz: _Floats) -> tuple[_Floats, _Floats]:
    """Quaternions [n, 4] of axes whose third is normal to the points around, and normals [n, 3]."""
    from scipy.spatial import KDTree  # noqa: PLC0415 - slow to import
    from scipy.spatial.transform import Rotation  # noqa: PLC0415

    rotation, normal = np.empty((len(xyz), 4)), np.empty((len(xyz), 3))
    tree = KDTree(xyz) if len(xyz) else None
    for first in range(0, len(xyz), _CHUNK):
        assert tree is not None
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


def _depth_error(points: ModelPoints, images: Sequence[PosedCamera]) -> _Floats:
    """Expected error of each point's distance; inf where its observations tell none."""
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
    """Refuse a file, where one is given, that `write_gaussians` must not or could not write.

    Args:
        given: the file.
        inputs: files that are read; None: not given.
        overwrite: replace a file that exists.

    Raises:
        OptionError: its name does not end in .ply, it is an input or exists, or nothing can be made
            there.
    """
    if given is None:
        return
    path = Path(given)
    if path.suffix.lower() != ".ply":
        raise OptionError(f"{path}: trainers know Gaussians by .ply: give a name that ends so")
    check_new_file(path, inputs, overwrite=overwrite)
    above = next(p for p in path.absolute().parents if p.exists())
    if not above.is_dir() or not os.access(above, os.W_OK | os.X_OK):
        raise OptionError(f"{path}: cannot be written: give another file")


def write_gaussians(path: Path, gaussians: Gaussians) -> None:
    """Write Gaussians in the layout of the reference implementation's point_cloud.ply.

    That is, scales as logarithms, opacity as logit, colours as coefficients of spherical harmonics;
    of degrees 1 to 3 all are 0.

    Args:
        path: the file; it appears when it is complete, and replaces one that is there.
        gaussians: the Gaussians.

    Raises:
        ModelError: it cannot be written.
    """
    names = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3))]
    names += [f"f_rest_{i}" for i in range(_REST)]
    names += ["opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    header = ["ply", "format binary_little_endian 1.0", "comment made by colmap-av1 --gaussians"]
    header += [f"element vertex {len(gaussians.xyz)}"]
    header += [*(f"property float {name}" for name in names), "end_header"]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(path) as partial, partial.open("wb") as file:
            file.write(("\n".join(header) + "\n").encode())
            for first in range(0, len(gaussians.xyz), _CHUNK):
                file.write(_records(gaussians, slice(first, first + _CHUNK)).tobytes())
    except OSError as error:
        raise ModelError(cannot_write(path, error)) from error


def write_model_gaussians(path: Path, model: Path) -> None:
    """Write initial Gaussians of the points of a COLMAP model.

    Args:
        path: the file, see `write_gaussians`.
        model: folder of the model.

    Raises:
        ModelError: the model cannot be read, or the file not written.
    """
    reconstruction = read_model(model)
    posed = sorted(posed_images(reconstruction).values(), key=lambda image: image.name)
    cameras = reconstruction.cameras
    views = [PosedCamera(cameras[i.camera_id], i.cam_from_world) for i in posed]
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

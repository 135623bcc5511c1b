"""Placement of a model by GPS positions, by its up direction and by a known distance."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap

from colmap_av1.database.reading import PosePrior
from colmap_av1.geometry.alignment import PathFit, Up, east_north_up, fit_path
from colmap_av1.geometry.colmap_model import ModelImage, camera_centres
from colmap_av1.options.place import PlaceOptions, parse_distance
from colmap_av1.poses.placing.distance import model_distance
from colmap_av1.poses.placing.up import (
    rotation_to_up,
    up_of_cameras,
    up_of_gravity,
    up_of_lines,
)
from colmap_av1.util.arrays import Floats

# Returns the planes of lines that may be vertical, given an approximate up direction, see
# `vertical_lines`.
Lines = Callable[[Floats], Sequence[Floats]]

PLACE_FILE = "place.json"
# Standard errors in radians of the up direction from gravity, and from how the camera was held.
_GRAVITY_ERROR, _CAMERA_ERROR = np.deg2rad(2.0), np.deg2rad(6.0)


@dataclass(frozen=True)
class Origin:
    """A position on the Earth (WGS 84): degrees, degrees and metres."""

    latitude: float
    longitude: float
    altitude: float


@dataclass(frozen=True)
class Place:
    """Coordinate system of a model, the content of `place.json`.

    Attributes:
        units: "metres" or "arbitrary".
        axes: description of the axes.
        origin: position of the origin on the Earth; None if it is unknown.
        how: descriptions of the data that determined the placement.
        scale: scale of the similarity from the mapper's coordinates to the model's.
        rotation: its rotation matrix, [3][3].
        translation: its translation, [3].
    """

    units: str
    axes: str
    origin: Origin | None
    how: tuple[str, ...]
    scale: float
    rotation: tuple[tuple[float, ...], ...]
    translation: tuple[float, ...]


@dataclass(frozen=True)
class Placement:
    """Transform of a model to world coordinates.

    Attributes:
        similarity: from the mapper's coordinates to those of the model.
        units: "metres" or "arbitrary".
        axes: description of the axes.
        origin: position of the origin on the Earth; None if it is unknown.
        how: descriptions of the data that determined the placement.
        warnings: warnings about the placement.
    """

    similarity: pycolmap.Sim3d = field(default_factory=pycolmap.Sim3d)
    units: str = "arbitrary"
    axes: str = "of the mapper"
    origin: Origin | None = None
    how: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def is_moved(self) -> bool:
        """Whether the model is transformed."""
        return not np.array_equal(self.similarity.matrix(), np.eye(3, 4))

    @property
    def place(self) -> Place:
        """The content of `place.json`."""
        return Place(
            units=self.units,
            axes=self.axes,
            origin=self.origin,
            how=self.how,
            scale=float(self.similarity.scale),
            rotation=tuple(tuple(row) for row in self.similarity.rotation.matrix().tolist()),
            translation=tuple(self.similarity.translation.tolist()),
        )


@dataclass(frozen=True)
class Surroundings:
    """Data that can place a model.

    Attributes:
        priors: pose priors of images, by name.
        gravity: float64 [n, 3] direction of gravity for each image, see `up_of_gravity`; None
            if unknown.
        lines: finds lines in the pictures; None without pictures.
        place: latitude, longitude and altitude of a single position for all images; None if
            there is none.
    """

    priors: Mapping[str, PosePrior]
    gravity: Floats | None = None
    lines: Lines | None = None
    place: tuple[float, float, float] | None = None


def find_placement(
    images: Sequence[ModelImage],
    cameras: Mapping[int, pycolmap.Camera],
    known: Surroundings,
    options: PlaceOptions,
    seed: int,
) -> Placement:
    """Determine the placement of a model.

    Args:
        images: the registered images.
        cameras: cameras of their pictures, by id.
        known: positions, gravity and lines.
        options: the options.
        seed: random seed of the samples.

    Raises:
        OptionError: the known distance cannot be measured in the model, see `model_distance`.
    """
    poses = np.array([image.cam_from_world for image in images])
    found = Placement()
    if options.align == "gps":
        found = _by_positions(images, poses, known, seed)
    if options.upright and not found.is_moved:
        up, how = _up(poses, known)
        turned = pycolmap.Sim3d(1.0, pycolmap.Rotation3d(rotation_to_up(up)), np.zeros(3))
        found = replace(found, similarity=turned, axes="z up", how=(*found.how, f"z up by {how}"))
    if options.scale is not None:
        found = _with_distance(found, images, cameras, options.scale)
    return found


def _by_positions(
    images: Sequence[ModelImage], poses: Floats, known: Surroundings, seed: int
) -> Placement:
    at = [i for i, image in enumerate(images) if image.name in known.priors]
    priors = [known.priors[images[i].name] for i in at]
    if not priors:
        if known.place is None:
            return Placement()
        latitude, longitude, altitude = known.place
        where = f"{latitude:.5f}, {longitude:.5f}, {altitude:.1f} m"
        return Placement(how=(f"a single position, {where}, which gives no scale or direction",))
    cartesian = sum(prior.is_cartesian for prior in priors)
    kind = cartesian * 2 > len(priors)
    at = [i for i, prior in zip(at, priors, strict=True) if prior.is_cartesian == kind]
    positions = np.array([prior.position for prior in priors if prior.is_cartesian == kind])
    origin: Origin | None = None
    if not kind:
        positions[:, 1] = np.unwrap(positions[:, 1], period=360.0)
        latitude, longitude, altitude = np.median(positions, axis=0).tolist()
        origin = Origin(latitude, (longitude + 180.0) % 360.0 - 180.0, altitude)
        positions = east_north_up(positions, (latitude, longitude, altitude))
    path = camera_centres(poses[at])
    gravity = known.gravity[at] if known.gravity is not None else None
    fits = [fit_path(path, positions, up, seed) for up in _rough_ups(poses[at], gravity)]
    fit = max(fits, key=lambda f: f.num_used if isinstance(f, PathFit) else -1)
    if isinstance(fit, str):
        return Placement(
            warnings=(
                f"the positions do not place the model: {fit}; its scale and "
                "axes are arbitrary: give --scale and --upright",
            )
        )
    how = (
        f"{fit.num_used} of {len(at)} positions with a residual of {fit.error:.2f} m, scale "
        f"accurate to {fit.scale_error:.1%}"
    )
    axes = "of the pose priors" if origin is None else "x east, y north, z up"
    return Placement(fit.similarity, "metres", axes, origin, (how,))


def _rough_ups(poses: Floats, gravity: Floats | None) -> list[Up]:
    """Candidates for up: by gravity, else for cameras held upright and cameras looking down."""
    measured = up_of_gravity(poses, gravity) if gravity is not None else None
    if measured is not None:
        return [Up(measured[0], _GRAVITY_ERROR)]
    back = -poses[:, 2, :3].mean(axis=0)
    back /= max(float(np.linalg.norm(back)), 1e-12)
    return [Up(up_of_cameras(poses), _CAMERA_ERROR), Up(back, _CAMERA_ERROR)]


def _up(poses: Floats, known: Surroundings) -> tuple[Floats, str]:
    """The up direction, and a description of the data that determined it."""
    measured = up_of_gravity(poses, known.gravity) if known.gravity is not None else None
    if measured is not None:
        return measured[0], f"gravity, which scatters by {measured[1]:.1f} degrees"
    held = up_of_cameras(poses)
    straight = up_of_lines(known.lines(held), held) if known.lines is not None else None
    if straight is not None:
        return straight, "vertical lines"
    return held, "how the camera was held, without vertical lines"


def _with_distance(
    found: Placement,
    images: Sequence[ModelImage],
    cameras: Mapping[int, pycolmap.Camera],
    text: str,
) -> Placement:
    """The placement with the scale of a known distance."""
    known = parse_distance(text)
    distance = model_distance(known, {image.name: image for image in images}, cameras)
    before = found.similarity
    scale = known.metres / distance
    centre = camera_centres(np.array([image.cam_from_world for image in images])).mean(axis=0)
    # Scaling about the mean camera centre keeps the model at its GPS positions.
    fixed = before * centre if found.units == "metres" else np.zeros(3)
    factor = scale / before.scale
    moved = pycolmap.Sim3d(scale, before.rotation, fixed + factor * (before.translation - fixed))
    how = f"scale by {known}"
    if found.units == "metres":
        how += f", the scale of the positions differs by {before.scale / scale - 1:+.1%}"
    return replace(found, similarity=moved, units="metres", how=(*found.how, how))


def write_place(folder: Path, placement: Placement) -> None:
    """Write `place.json`.

    Raises:
        OSError: the file cannot be written.
    """
    (folder / PLACE_FILE).write_text(json.dumps(asdict(placement.place), indent=1) + "\n")

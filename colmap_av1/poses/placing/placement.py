"""Placement of a model by GPS positions, by its up direction and by a known distance."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap

from colmap_av1.database.reading import PosePrior
from colmap_av1.geometry.alignment import PathFit, Up, east_north_up, fit_path
from colmap_av1.geometry.colmap_model import ModelImage, camera_centres
from colmap_av1.options.place import PlaceOptions, parse_distance
from colmap_av1.poses.placing.distance import model_distance
from colmap_av1.poses.placing.up import rotation_to_up, up_of_cameras, up_of_gravity, up_of_lines
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

    units: str = "arbitrary"
    axes: str = "of the mapper"
    origin: Origin | None = None
    how: tuple[str, ...] = ()
    scale: float = 1.0
    rotation: tuple[tuple[float, ...], ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    translation: tuple[float, ...] = (0.0, 0.0, 0.0)

    @property
    def similarity(self) -> pycolmap.Sim3d:
        """The similarity from the mapper's coordinates to the model's."""
        rotation = pycolmap.Rotation3d(np.array(self.rotation))
        return pycolmap.Sim3d(self.scale, rotation, np.array(self.translation))

    @property
    def is_moved(self) -> bool:
        """Whether the model has other coordinates than those of the mapper."""
        return not np.array_equal(self.similarity.matrix(), np.eye(3, 4))

    def moved_to(self, similarity: pycolmap.Sim3d, how: str, **changes: Any) -> Place:
        """The place with another similarity, and a description of the data that determined it."""
        return replace(
            self,
            how=(*self.how, how),
            scale=float(similarity.scale),
            rotation=tuple(tuple(row) for row in similarity.rotation.matrix().tolist()),
            translation=tuple(similarity.translation.tolist()),
            **changes,
        )


@dataclass(frozen=True)
class PlacementData:
    """Data that can place a model.

    Attributes:
        priors: pose priors of images, by name.
        gravity: float64 [n, 3] direction of gravity for each image, see `up_of_gravity`; None
            if unknown.
        lines: finds lines in the pictures; None without pictures.
        position: latitude, longitude and altitude of a single position for all images; None if
            there is none.
    """

    priors: Mapping[str, PosePrior]
    gravity: Floats | None = None
    lines: Lines | None = None
    position: tuple[float, float, float] | None = None


def find_placement(
    images: Sequence[ModelImage],
    cameras: Mapping[int, pycolmap.Camera],
    known: PlacementData,
    options: PlaceOptions,
    seed: int,
) -> tuple[Place, tuple[str, ...]]:
    """Determine the placement of a model.

    Args:
        images: the registered images.
        cameras: cameras of their pictures, by id.
        known: positions, gravity and lines.
        options: the options.
        seed: random seed of the samples.

    Returns:
        The placement, and warnings about it.

    Raises:
        OptionError: the known distance cannot be measured in the model, see `model_distance`.
    """
    poses = np.array([image.cam_from_world for image in images])
    found = Place()
    reason = None
    if options.align == "gps":
        by_positions = _by_positions(images, poses, known, seed)
        if isinstance(by_positions, str):
            reason = by_positions
        else:
            found = by_positions
    if options.upright and not found.is_moved:
        up, how = _up(poses, known)
        turned = pycolmap.Sim3d(1.0, pycolmap.Rotation3d(rotation_to_up(up)), np.zeros(3))
        found = found.moved_to(turned, f"z up by {how}", axes="z up")
    if options.scale is not None:
        found = _with_distance(found, images, cameras, options.scale)
    if reason is None:
        return found, ()
    missing = [] if options.upright else ["its axes are arbitrary: give --upright"]
    missing += [] if options.scale is not None else ["its scale is arbitrary: give --scale"]
    return found, ("; ".join([f"the positions do not place the model: {reason}", *missing]),)


def _by_positions(
    images: Sequence[ModelImage], poses: Floats, known: PlacementData, seed: int
) -> Place | str:
    """The placement by the positions of images, or the reason why they do not place the model."""
    at = [i for i, image in enumerate(images) if image.name in known.priors]
    priors = [known.priors[images[i].name] for i in at]
    if not priors:
        if known.position is None:
            return Place()
        latitude, longitude, altitude = known.position
        where = f"{latitude:.5f}, {longitude:.5f}, {altitude:.1f} m"
        return Place(how=(f"a single position, {where}, which gives no scale or direction",))
    is_cartesian = 2 * sum(prior.is_cartesian for prior in priors) > len(priors)
    at = [i for i, prior in zip(at, priors, strict=True) if prior.is_cartesian == is_cartesian]
    positions = np.array([prior.position for prior in priors if prior.is_cartesian == is_cartesian])
    origin: Origin | None = None
    if not is_cartesian:
        positions[:, 1] = np.unwrap(positions[:, 1], period=360.0)
        latitude, longitude, altitude = np.median(positions, axis=0).tolist()
        origin = Origin(latitude, (longitude + 180.0) % 360.0 - 180.0, altitude)
        positions = east_north_up(positions, (latitude, longitude, altitude))
    path = camera_centres(poses[at])
    gravity = known.gravity[at] if known.gravity is not None else None
    fits = [fit_path(path, positions, up, seed) for up in _rough_ups(poses[at], gravity)]
    fit = max(fits, key=lambda f: f.num_used if isinstance(f, PathFit) else -1)
    if isinstance(fit, str):
        return fit
    how = (
        f"{fit.num_used} of {len(at)} positions with a residual of {fit.error:.2f} m, scale "
        f"accurate to {fit.scale_error:.1%}"
    )
    axes = "of the pose priors" if origin is None else "x east, y north, z up"
    return Place("metres", axes, origin).moved_to(fit.similarity, how)


def _rough_ups(poses: Floats, gravity: Floats | None) -> list[Up]:
    """Candidates for up: by gravity, else for cameras held upright and cameras looking down."""
    measured = up_of_gravity(poses, gravity) if gravity is not None else None
    if measured is not None:
        return [Up(measured[0], _GRAVITY_ERROR)]
    back = -poses[:, 2, :3].mean(axis=0)
    back /= max(float(np.linalg.norm(back)), 1e-12)
    return [Up(up_of_cameras(poses), _CAMERA_ERROR), Up(back, _CAMERA_ERROR)]


def _up(poses: Floats, known: PlacementData) -> tuple[Floats, str]:
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
    found: Place,
    images: Sequence[ModelImage],
    cameras: Mapping[int, pycolmap.Camera],
    text: str,
) -> Place:
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
    return found.moved_to(moved, how, units="metres")


def write_place(folder: Path, place: Place) -> None:
    """Write `place.json`.

    Raises:
        OSError: the file cannot be written.
    """
    (folder / PLACE_FILE).write_text(json.dumps(asdict(place), indent=1) + "\n")

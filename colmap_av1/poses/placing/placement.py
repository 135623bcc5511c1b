"""Where a model is placed: by positions, by what is up, by a known distance."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_av1.database.reading import PosePrior
from colmap_av1.geometry.alignment import PathFit, Similarity, Up, east_north_up, fit_path
from colmap_av1.geometry.colmap_model import ModelImage, camera_centres
from colmap_av1.options.place import PlaceOptions, parse_distance
from colmap_av1.poses.placing.distance import model_distance
from colmap_av1.poses.placing.up import (
    rotation_to_up,
    up_of_cameras,
    up_of_gravity,
    up_of_lines,
)

_Floats = NDArray[np.float64]
# Gives, for what is roughly up, planes of lines that may be vertical, see `vertical_lines`.
Lines = Callable[[_Floats], Sequence[_Floats]]

PLACE_FILE = "place.json"
# How far what is up may be off by gravity, and by how cameras are held, in radians.
_ERROR_OF_GRAVITY, _ERROR_OF_HELD = np.deg2rad(2.0), np.deg2rad(6.0)
_NOWHERE = Similarity(1.0, np.eye(3), np.zeros(3))


@dataclass(frozen=True)
class Origin:
    """A position on the Earth (WGS 84): degrees, degrees and metres."""

    latitude: float
    longitude: float
    altitude: float


@dataclass(frozen=True)
class Place:
    """Where a model lies in the world, as `place.json` holds it.

    Attributes:
        units: "metres" or "arbitrary".
        axes: directions of the axes, in words.
        origin: position of the origin on the Earth; None if it is unknown.
        how: sources of the placement, in words.
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
    """Where a model lies in the world.

    Attributes:
        similarity: from the mapper's coordinates to those of the model.
        units: "metres", or "arbitrary".
        axes: what the axes are, in words.
        origin: position of the origin on the Earth; None if it is unknown.
        how: sources of the placement, in words.
        warnings: what the user should know.
    """

    similarity: Similarity = _NOWHERE
    units: str = "arbitrary"
    axes: str = "as the mapper chose them"
    origin: Origin | None = None
    how: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def is_moved(self) -> bool:
        """Whether the model lies elsewhere than the mapper left it."""
        return self.similarity is not _NOWHERE

    @property
    def place(self) -> Place:
        """Where the model lies, in plain numbers."""
        return Place(
            units=self.units,
            axes=self.axes,
            origin=self.origin,
            how=self.how,
            scale=float(self.similarity.scale),
            rotation=tuple(tuple(row) for row in self.similarity.rotation.tolist()),
            translation=tuple(self.similarity.translation.tolist()),
        )


@dataclass(frozen=True)
class Surroundings:
    """What is known of where images were taken.

    Attributes:
        priors: where images were taken, by name.
        gravity: float64 [n, 3] direction of gravity for each image, see `up_of_gravity`; None
            where nothing says it.
        lines: finds lines in the pictures; None where there are no pictures.
        place: the one position of all that there is.
    """

    priors: Mapping[str, PosePrior]
    gravity: _Floats | None = None
    lines: Lines | None = None
    place: tuple[float, float, float] | None = None


def find_placement(
    images: Sequence[ModelImage],
    cameras: Mapping[int, pycolmap.Camera],
    known: Surroundings,
    options: PlaceOptions,
    seed: int,
) -> Placement:
    """Find where a model is to be placed.

    Args:
        images: the images that have a pose.
        cameras: cameras of their pictures, by id.
        known: what is known of where they were taken.
        options: what is wanted.
        seed: of the random samples.

    Raises:
        OptionError: the known distance is none of this model.
    """
    poses = np.array([image.cam_from_world for image in images])
    found = Placement()
    if options.align == "gps":
        found = _by_positions(images, poses, known, seed)
    if options.upright and not found.is_moved:
        up, how = _up(poses, known)
        turned = Similarity(1.0, rotation_to_up(up), np.zeros(3))
        found = replace(found, similarity=turned, axes="z up", how=(f"z up by {how}",))
    if options.scale is not None:
        found = _with_distance(found, images, cameras, options.scale)
    return found


def _by_positions(
    images: Sequence[ModelImage], poses: _Floats, known: Surroundings, seed: int
) -> Placement:
    at = [i for i, image in enumerate(images) if image.name in known.priors]
    priors = [known.priors[images[i].name] for i in at]
    if not priors:
        if known.place is None:
            return Placement()
        latitude, longitude, altitude = known.place
        where = f"{latitude:.5f}, {longitude:.5f}, {altitude:.1f} m"
        return Placement(how=(f"taken at {where}, one position that gives no scale or direction",))
    cartesian = sum(prior.is_cartesian for prior in priors)
    kind = cartesian * 2 > len(priors)
    at = [i for i, prior in zip(at, priors, strict=True) if prior.is_cartesian == kind]
    positions = np.array([prior.position for prior in priors if prior.is_cartesian == kind])
    origin: Origin | None = None
    if not kind:
        latitude, longitude, altitude = np.median(positions, axis=0).tolist()
        origin = Origin(latitude, longitude, altitude)
        positions = east_north_up(positions, (latitude, longitude, altitude))
    path = camera_centres(poses[at])
    gravity = known.gravity[at] if known.gravity is not None else None
    fits = [fit_path(path, positions, up, seed) for up in _rough_ups(poses[at], gravity)]
    fit = max(fits, key=lambda f: f.num_used if isinstance(f, PathFit) else -1)
    if isinstance(fit, str):
        return Placement(
            warnings=(
                f"the positions do not place the model: {fit}; it keeps the mapper's scale: "
                "--scale gives it another, --upright turns it",
            )
        )
    how = (
        f"{fit.num_used} of {len(at)} positions agree to {fit.error:.2f} m, scale to "
        f"{fit.scale_error:.1%}"
    )
    axes = "of the pose priors" if origin is None else "x east, y north, z up"
    return Placement(fit.similarity, "metres", axes, origin, (how,))


def _rough_ups(poses: _Floats, gravity: _Floats | None) -> list[Up]:
    """What may be up: by gravity, or as cameras are held, upright or looking straight down."""
    felt = up_of_gravity(poses, gravity) if gravity is not None else None
    if felt is not None:
        return [Up(felt[0], _ERROR_OF_GRAVITY)]
    back = -poses[:, 2, :3].mean(axis=0)
    back /= max(float(np.linalg.norm(back)), 1e-12)
    return [Up(up_of_cameras(poses), _ERROR_OF_HELD), Up(back, _ERROR_OF_HELD)]


def _up(poses: _Floats, known: Surroundings) -> tuple[_Floats, str]:
    """What is up, and what said so."""
    felt = up_of_gravity(poses, known.gravity) if known.gravity is not None else None
    if felt is not None:
        return felt[0], f"gravity, which images agree on to {felt[1]:.1f} degrees"
    held = up_of_cameras(poses)
    straight = up_of_lines(known.lines(held), held) if known.lines is not None else None
    if straight is not None:
        return straight, "vertical lines"
    return held, "how the camera was held, as no lines say it"


def _with_distance(
    found: Placement,
    images: Sequence[ModelImage],
    cameras: Mapping[int, pycolmap.Camera],
    text: str,
) -> Placement:
    """The placement with a scale by which a distance is as it is known to be."""
    known = parse_distance(text)
    distance = model_distance(known, {image.name: image for image in images}, cameras)
    before = found.similarity
    scale = known.metres / distance
    centre = camera_centres(np.array([image.cam_from_world for image in images])).mean(axis=0)
    # Positions keep the middle of the path where they say it is.
    fixed = before.apply(centre[None])[0] if found.units == "metres" else np.zeros(3)
    factor = scale / before.scale
    moved = replace(before, scale=scale, translation=fixed + factor * (before.translation - fixed))
    how = f"scale by {known}"
    if found.units == "metres":
        how += f", {before.scale / scale - 1:+.1%} by the positions"
    return replace(found, similarity=moved, units="metres", how=(*found.how, how))


def write_place(folder: Path, placement: Placement) -> None:
    """Write where a model lies, as JSON.

    Raises:
        OSError: the file cannot be written.
    """
    (folder / PLACE_FILE).write_text(json.dumps(asdict(placement.place), indent=1) + "\n")

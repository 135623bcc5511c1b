"""Mapping a database with one of COLMAP's mappers."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from colmap_av1.check.database import DatabaseCheck, check_database
from colmap_av1.check.model import check_model
from colmap_av1.check.model_figures import ModelFigures
from colmap_av1.database.file import copy_database
from colmap_av1.database.reading import read_images, read_pose_priors
from colmap_av1.errors import DatabaseError, ImageError, ModelError, OptionError, writing
from colmap_av1.geometry.cameras import focal_length_warning
from colmap_av1.geometry.colmap_model import MODEL_FILES, posed_images, read_model
from colmap_av1.geometry.posed_model import posed_model
from colmap_av1.geometry.uncertainty import MAX_CERTAIN_ERROR, expected_error, uncertainty_warning
from colmap_av1.images.files import image_size, read_image
from colmap_av1.images.names import image_file
from colmap_av1.options import MapOptions, PlaceOptions
from colmap_av1.options.place import parse_distance
from colmap_av1.poses.long_range import LongRangeErrors
from colmap_av1.poses.mapper import map_poses
from colmap_av1.poses.placing.placement import Place, PlacementData, find_placement, write_place
from colmap_av1.poses.placing.up import pictures_for_lines, vertical_lines
from colmap_av1.util.arrays import Floats
from colmap_av1.util.files import check_new_folder, whole_folder
from colmap_av1.util.progress import Clock, Progress, no_progress
from colmap_av1.util.texts import some_names


@dataclass(frozen=True)
class MapReport:
    """Result of `map_database`.

    Attributes:
        output: folder of the models, one numbered folder each; 0 has the most images.
        database: the database.
        mapper: the mapper that was used.
        forward_motion: whether it could begin with a pair that moves along the optical axis.
        num_images: number of images of the database.
        num_registered: number of registered images of each model, in descending order.
        place: coordinates of the model in folder 0: units, axes, origin and their source, as in
            `place.json`.
        figures: figures of the model in folder 0.
        expected_error: expected error of its camera centres as a share of their extent, by the
            covariance of the observations; None if it is not known.
        long_range: result of the long-range check of this model; None if its images cannot be read.
        seconds: wall time of each stage.
        warnings: warnings for the user.
    """

    output: Path
    database: Path
    mapper: str
    forward_motion: bool
    num_images: int
    num_registered: tuple[int, ...]
    place: Place
    figures: ModelFigures
    expected_error: float | None
    long_range: LongRangeErrors | None
    seconds: dict[str, float]
    warnings: tuple[str, ...]

    @property
    def model(self) -> Path:
        """Folder of the model with the most images."""
        return self.output / "0"


def map_database(
    database: str | os.PathLike[str],
    image_path: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    options: MapOptions = MapOptions(),
    place: PlaceOptions = PlaceOptions(),
    progress: Progress = no_progress,
    overwrite: bool = False,
) -> MapReport:
    """Map a COLMAP database of any origin, which is not changed.

    Args:
        database: a COLMAP database with verified matches.
        image_path: folder of its images, for the colours of the points and the long-range check.
        output: new or empty folder. It gets a folder for each model, numbered in descending order
            of the number of images, `mapper.log`, and `place.json`, which describes the coordinates
            of the model in folder 0.
        options: the mapper and its options.
        place: how to place the model in folder 0 in the world. Positions are the pose priors of
            the database. A model that cannot be placed keeps the mapper's coordinates, with a
            warning.
        progress: called with a stage's name, the amount of work done, and the total if known.
        overwrite: replace an output that has models and nothing else.

    Raises:
        DatabaseError: the database is missing, unreadable, or has no matches that a mapper can use,
            or the matches do not determine depth.
        ImageError: an image of the database is missing from the folder, or the one that is examined
            of each camera has another size.
        ModelError: the mapper fails or finds no model; the message names its log.
        WriteError: the output cannot be written.
        OptionError: the output is not empty and must not be replaced, or the database lacks an
            image of the known distance.

    Examples:
        >>> from colmap_av1 import map_database
        >>> report = map_database("my.db", "my_frames", "my_model")
        >>> report.num_images, report.num_registered
        (10, (10,))
        >>> report.model.as_posix()
        'my_model/0'
    """
    database, image_path, output = Path(database), Path(image_path), Path(output)
    clock = Clock()
    check_new_folder(output, MODEL_FILES, [database, image_path], overwrite=overwrite)
    checked = _check_input(database, image_path, place)

    own = MODEL_FILES if overwrite else None
    with writing(output), _log() as log, whole_folder(output, own) as partial:
        with clock.measure("poses"):
            num_registered, forward = _map(
                checked, image_path, partial, options, log=log, progress=progress
            )
        if not num_registered:
            raise ModelError(
                f"{database}: COLMAP's {options.mapper} mapper finds no model, probably because "
                "the images share too few matches or have too little parallax: see 'colmap-av1 "
                f"check' and {log}, try the other --mapper, or give --camera_params when matching"
            )
        with clock.measure("place"):
            try:
                world, place_warnings = _place(partial, database, image_path, place, options.seed)
            except (ImageError, OptionError) as error:  # The model is valid without a place.
                world = Place()
                place_warnings = (f"the model keeps the mapper's coordinates: {error}",)
            write_place(partial, world)
    model = read_model(output / "0")
    unreadable = None
    with clock.measure("long range"):
        try:
            found = check_model(model, image_path=image_path, database=database, progress=progress)
        except ImageError as error:  # The model itself is valid without the check.
            unreadable = f"skipped the long-range check: {error}"
            found = check_model(model, database=database)
    warnings = (
        *place_warnings,
        _missing(database, posed_images(model), num_registered),
        checked.depth.warning,
        focal_length_warning(posed_model(model).cameras.values()),
        *found.seam_warnings,
        found.long_range.warning() if found.long_range else unreadable,
        uncertainty_warning(found.expected_error),
        *_uncertain_models(output, len(num_registered)),
    )
    return MapReport(
        output=output,
        database=database,
        mapper=options.mapper,
        forward_motion=forward,
        num_images=checked.num_images,
        num_registered=num_registered,
        place=world,
        figures=found.figures,
        expected_error=found.expected_error,
        long_range=found.long_range,
        seconds=clock.seconds,
        warnings=tuple(warning for warning in warnings if warning is not None),
    )


def _map(
    checked: DatabaseCheck,
    image_path: Path,
    output: Path,
    options: MapOptions,
    *,
    log: Path,
    progress: Progress,
) -> tuple[tuple[int, ...], bool]:
    """Map, and choose whether the mapper may begin with forward motion unless it is given.

    Returns:
        Number of registered images of each model, in descending order. Whether the mapper could
        begin with forward motion.
    """
    if options.mapper == "incremental" and options.forward_motion is None:
        first = checked.parallax is not None and checked.parallax.is_forward
        choices = [first, not first]
    else:
        choices = [bool(options.forward_motion)]
    attempts = list[tuple[tuple[int, ...], bool, Path]]()
    # The copy is migrated to the schema of the installed COLMAP.
    with tempfile.TemporaryDirectory(dir=output) as folder:
        copy = Path(folder) / "mapped.db"
        copy_database(checked.database, copy)
        for forward in choices:
            models = Path(folder) / f"forward_{forward:d}"
            try:
                num_registered = map_poses(
                    copy,
                    models,
                    replace(options, forward_motion=forward),
                    image_path=image_path,
                    log=log,
                    num_images=checked.num_images,
                    progress=progress,
                    effort="video",
                )
            except ModelError:  # the other attempt may succeed
                if forward == choices[-1] and not attempts:
                    raise
                continue
            shutil.copyfile(log, models / "mapper.log")
            attempts.append((num_registered, forward, models))
            if num_registered and 2 * num_registered[0] >= checked.num_connected_images:
                break
        # The first of two models of the same size is kept.
        num_registered, forward, models = max(attempts, key=lambda attempt: attempt[0][:1])
        for made in list(models.iterdir()):
            shutil.move(made, output)
    return num_registered, forward


@contextmanager
def _log() -> Iterator[Path]:
    """A file for the mapper's log, which is kept if the mapper fails."""
    descriptor, name = tempfile.mkstemp(prefix="colmap-av1-map-", suffix=".log")
    os.close(descriptor)
    try:
        yield Path(name)
    except ModelError:
        raise
    except BaseException:
        os.unlink(name)
        raise
    os.unlink(name)


def _uncertain_models(output: Path, num_models: int) -> list[str]:
    """A warning about further models whose camera positions are uncertain, if there are any."""
    uncertain = []
    for number in range(1, num_models):
        error = expected_error(posed_model(read_model(output / str(number)), with_points=True))
        if error is not None and error > MAX_CERTAIN_ERROR:
            uncertain.append(f"'{number}'")
    if not uncertain:
        return []
    return [f"few points with parallax determine the camera positions of {', '.join(uncertain)}"]


def _missing(
    database: Path, registered: Collection[str], num_registered: Sequence[int]
) -> str | None:
    """A warning about images that the largest model lacks, or about further models."""
    largest, *others = num_registered
    names = [image.name for image in read_images(database)]
    num_images = len(names)
    if not others:
        missing = [name for name in names if name not in registered]
        if not missing:
            return None
        return f"{len(missing)} of {num_images} images are not registered: {some_names(missing)}"
    further = ", ".join(f"'{number}' has {size}" for number, size in enumerate(others, start=1))
    if largest == num_images:
        return (
            f"model '0' has all {num_images} images; {further} of them again: ignore the other "
            "models"
        )
    return (
        f"no model has all {num_images} images: '0' has {largest}, {further}; each model has its "
        "own coordinates"
    )


def _place(
    output: Path, database: Path, image_path: Path, options: PlaceOptions, seed: int
) -> tuple[Place, tuple[str, ...]]:
    """Place the model in folder 0 of the output in the world."""
    folder = output / "0"
    model = read_model(folder)
    images = [*posed_images(model).values()]

    def lines(up: Floats) -> list[Floats]:
        return [
            vertical_lines(
                read_image(image_file(image_path, image.name)),
                model.cameras[image.camera_id],
                image.cam_from_world,
                up,
            )
            for image in pictures_for_lines(images)
        ]

    known = PlacementData(read_pose_priors(database), lines=lines)
    found, place_warnings = find_placement(images, dict(model.cameras), known, options, seed)
    if found.is_moved:
        model.transform(found.similarity)
        model.write_binary(folder)
    return found, place_warnings


def _check_input(database: Path, image_path: Path, place: PlaceOptions) -> DatabaseCheck:
    """Refuse inputs that make a mapper fail, and a known distance of other images."""
    checked = check_database(database)
    if not checked.depth.is_observable:
        raise DatabaseError(f"{database}: {checked.depth.warning}")
    stops = [f.text for f in checked.findings if f.severity == "error"]
    if stops:
        raise DatabaseError(
            f"{database}: {stops[0]}: see 'colmap-av1 check', and match the images again"
        )
    if not image_path.is_dir():
        raise ImageError(f"{image_path}: no such folder: give the folder of the database's images")
    images = read_images(database)
    files = [image_file(image_path, image.name) for image in images]
    missing = next((file for file in files if not file.is_file()), None)
    if missing is not None:
        raise ImageError(
            f"{missing}: is missing, but in the database: give the folder of its images"
        )
    if place.scale is not None:
        names = {image.name for image in images}
        marks = [mark for end in parse_distance(place.scale).ends for mark in end.marks]
        other = next((mark.image for mark in marks if mark.image not in names), None)
        if other is not None:
            raise OptionError(
                f"scale: the database has no image '{other}': name images of it, such as "
                f"{images[0].name}"
            )
    of_cameras = {image.camera_id: (image, file) for image, file in zip(images, files, strict=True)}
    for image, file in of_cameras.values():
        size, wanted = image_size(file), (image.width, image.height)
        if size != wanted:
            raise ImageError(
                f"{file}: is {'x'.join(map(str, size))}, but its camera in the database is "
                f"{'x'.join(map(str, wanted))}: give the folder of the database's images"
            )
    return checked

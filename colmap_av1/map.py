"""From a database to a model, with one of COLMAP's mappers."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from colmap_av1.database.check import check
from colmap_av1.database.file import copy_database
from colmap_av1.database.reading import read_images
from colmap_av1.errors import DatabaseError, ImageError, ModelError, cannot_write
from colmap_av1.images.files import image_size
from colmap_av1.images.names import image_file
from colmap_av1.model.colmap_model import MODEL_FILES, read_model
from colmap_av1.model.far_views import FarViews, model_far_views
from colmap_av1.model.figures import ModelFigures, model_figures
from colmap_av1.model.joints import model_joints
from colmap_av1.model.mapper import is_mapper_log, map_poses
from colmap_av1.options import MapOptions
from colmap_av1.util.arguments import checks_arguments
from colmap_av1.util.files import check_new_folder, whole_folder
from colmap_av1.util.outputs import check_files, check_folder
from colmap_av1.util.progress import Clock, Progress, no_progress


@dataclass(frozen=True)
class MapReport:
    """What `map_database` made.

    Attributes:
        output: folder of the models, one folder each; 0 is the one with the most images.
        database: the database.
        mapper: which of COLMAP's mappers made them.
        num_images: images of the database.
        num_registered: images with a pose in each model, the most first.
        figures: figures of the model in folder 0.
        far_views: how far views from far apart in time disagree, by the pictures of that model;
            None where these cannot be read.
        seconds: wall time of each stage.
        warnings: what the user should know.
    """

    output: Path
    database: Path
    mapper: str
    num_images: int
    num_registered: tuple[int, ...]
    figures: ModelFigures
    far_views: FarViews | None
    seconds: dict[str, float]
    warnings: tuple[str, ...]

    @property
    def model(self) -> Path:
        """Folder of the model with the most images."""
        return self.output / "0"


@checks_arguments
def map_database(
    database: str | os.PathLike[str],
    image_path: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    options: MapOptions | None = None,
    progress: Progress | None = None,
    overwrite: bool = False,
) -> MapReport:
    """Map a COLMAP database of any origin; the database stays as it is.

    Args:
        database: a COLMAP database with verified matches.
        image_path: folder of its images, for the points' colours.
        output: new or empty folder; gets a folder for each model, numbered from the one with the
            most images, and `mapper.log`.
        options: which mapper, and how.
        progress: called with a stage's name, what is done, and of how much where known.
        overwrite: replace an output that holds models and nothing else.

    Raises:
        DatabaseError: the database is missing, unreadable, or nothing that mappers can use.
        ImageError: an image of the database is not in the folder, or of another size.
        ModelError: the mapper fails or finds no model; `OUTPUT.log` is what it printed.
        OptionError: the output is not empty, or must not be replaced.
    """
    options = options if options is not None else MapOptions()
    progress = progress if progress is not None else no_progress
    database, image_path, output = Path(database), Path(image_path), Path(output)
    clock = Clock()
    check_new_folder(output, MODEL_FILES, overwrite=overwrite)
    check_folder(output, [database, image_path])
    log = output.resolve().with_name(f"{output.resolve().name}.log")
    check_files([log], [database, image_path], is_own=is_mapper_log, overwrite=overwrite)
    num_images = _check_input(database, image_path)

    try:
        with whole_folder(output, overwrite=overwrite) as partial:
            with clock.measure("poses"):
                copy = partial / "mapped.db"
                copy_database(database, copy)
                num_registered = map_poses(
                    copy,
                    partial,
                    options,
                    image_path=image_path,
                    log=log,
                    num_images=num_images,
                    progress=progress,
                )
                copy.unlink()
            if not num_registered:
                raise ModelError(
                    f"{database}: COLMAP's {options.mapper} mapper finds no model, its images "
                    "share too few matches, or too little parallax: see 'colmap-av1 check', "
                    "try the other --mapper, or give --camera_params when matching"
                )
            log.replace(partial / "mapper.log")
    except OSError as error:
        raise ModelError(cannot_write(output, error)) from error
    model = read_model(output / "0")
    warnings = [model_joints(model).warning]
    far_views: FarViews | None = None
    try:
        with clock.measure("far views"):
            far_views = model_far_views(model, image_path, progress)
        warnings.append(far_views.warning)
    except ImageError as error:  # the model stands all the same
        warnings.append(f"far views are not compared: {error}")
    return MapReport(
        output=output,
        database=database,
        mapper=options.mapper,
        num_images=num_images,
        num_registered=num_registered,
        figures=model_figures(model),
        far_views=far_views,
        seconds=clock.seconds,
        warnings=tuple(warning for warning in warnings if warning is not None),
    )


def _check_input(database: Path, image_path: Path) -> int:
    """Refuse what a mapper would stop at; returns the number of images."""
    stops = [f.text for f in check(database).findings if f.severity == "error"]
    if stops:
        raise DatabaseError(
            f"{database}: {stops[0]}: see 'colmap-av1 check', and match the images anew"
        )
    if not image_path.is_dir():
        raise ImageError(f"{image_path}: no such folder: give that of the database's images")
    images = read_images(database)
    files = [image_file(image_path, image.name) for image in images]
    missing = next((file for file in files if not file.is_file()), None)
    if missing is not None:
        raise ImageError(
            f"{missing}: is missing, but the database lists it: give the folder of its images"
        )
    size, wanted = image_size(files[0]), (images[0].width, images[0].height)
    if size != wanted:
        raise ImageError(
            f"{files[0]}: is {'x'.join(map(str, size))}, but its camera in the database "
            f"{'x'.join(map(str, wanted))}: give the folder of the database's images"
        )
    return len(images)

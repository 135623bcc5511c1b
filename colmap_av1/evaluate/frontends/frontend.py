"""The interface of a front-end, which fills a COLMAP database, and a measured run of one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pycolmap

from colmap_av1.evaluate.frontends.footage import Footage
from colmap_av1.evaluate.frontends.measure import Measured, run_measured
from colmap_av1.geometry.cameras import make_camera
from colmap_av1.util.digests import digest_of, file_digest
from colmap_av1.util.stages import WHOLE_PACKAGE, run_stage_in

# Only changes of this code affect the results of other programs. Changes elsewhere in the package
# do not repeat their runs.
OF_OTHERS = ("evaluate/frontends",)


@dataclass(frozen=True)
class Filled:
    """What a front-end reports when it has filled a database.

    Attributes:
        seconds: wall time of each stage.
        warnings: warnings for the user.
    """

    seconds: dict[str, float]
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class FrontendRun:
    """A database and the cost of filling it.

    Attributes:
        database: the COLMAP database.
        seconds: wall time of each stage.
        warnings: warnings for the user.
        cpu_seconds: total CPU time of all stages.
        peak_memory: largest resident memory in bytes; None if the system does not report it.
    """

    database: Path
    seconds: dict[str, float]
    warnings: tuple[str, ...]
    cpu_seconds: float
    peak_memory: int | None


@dataclass(frozen=True)
class Frontend:
    """One way to fill a database.

    Attributes:
        run: creates the given database from the footage. Called in a separate process.
        depends_on: what the result depends on in addition to name, video, frames and camera, see
            `digest_of`.
        made_by: folders of this package whose code changes the result.
        check: raises an error if a requirement is missing; called before any long work.
        files: further input files of the user.
    """

    run: Callable[[Footage, Path], Filled]
    depends_on: Callable[[Footage], tuple[Any, ...]]
    made_by: tuple[str, ...] = WHOLE_PACKAGE
    check: Callable[[], None] = lambda: None
    files: tuple[Path, ...] = ()


def run_frontend(name: str, footage: Footage, folder: Path, frontend: Frontend) -> FrontendRun:
    """Fill a database and measure the cost; a finished run is not repeated.

    Args:
        name: name of the front-end.
        footage: video and images.
        folder: gets `database.db`, `log.txt` and the figures.
        frontend: the front-end.

    Raises:
        ColmapAv1Error: the front-end refuses the footage.
        EvaluationError: the front-end failed.
    """
    database = folder / "database.db"

    def make() -> Measured[Filled]:
        return run_measured(frontend.run, footage, database, log=folder / "log.txt")

    camera = replace(footage.camera, camera_model=camera_model(footage))
    given = (name, file_digest(footage.video), footage.frames, camera)
    made = run_stage_in(
        folder,
        [*given, *frontend.depends_on(footage)],
        Measured[Filled],
        make,
        products=[database],
        made_by=frontend.made_by,
        timed=True,
    ).result
    return FrontendRun(
        database,
        seconds=made.result.seconds,
        warnings=made.result.warnings,
        cpu_seconds=made.cpu_seconds,
        peak_memory=made.peak_memory,
    )


def camera_model(footage: Footage) -> str:
    """COLMAP's name of the camera model, for front-ends that do not estimate the focal length."""
    return str(make_camera(footage.camera, *footage.size, footage.pixel_aspect).model_name)


def images_digest(footage: Footage) -> str:
    """Digest of the images' content."""
    return digest_of(file_digest(footage.image_path / name) for name in footage.names)


def list_images(footage: Footage, database: Path) -> None:
    """Create a database with the images and one camera, without features."""
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = camera_model(footage)
    reader.camera_params = footage.camera.camera_params or ""
    pycolmap.Database.open(database).close()
    # Import first, so that ids are deterministic: the extraction inserts images in the order in
    # which its threads finish.
    mode = pycolmap.CameraMode.SINGLE
    pycolmap.import_images(
        database, footage.image_path, mode, image_names=footage.names, options=reader
    )

"""A front-end: images or a video in, rows of a COLMAP database out; and a run of one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pycolmap

from colmap_av1.evaluate.frontends.footage import Footage
from colmap_av1.evaluate.frontends.measure import run_measured
from colmap_av1.geometry.cameras import make_camera
from colmap_av1.util.digests import digest_of, file_digest
from colmap_av1.util.stages import WHOLE_PACKAGE, run_stage_in

# Whose code changes what other programs give: an upgrade of the rest does not repeat them.
OF_OTHERS = ("evaluate/frontends",)


@dataclass(frozen=True)
class FrontendRun:
    """A database and what it took to fill it.

    Attributes:
        name: the front-end.
        database: the COLMAP database.
        seconds: wall time of each stage.
        cpu_seconds: CPU time of all stages together.
        peak_memory: largest resident memory in bytes; None where the system does not report it.
    """

    name: str
    database: Path
    seconds: dict[str, float]
    cpu_seconds: float
    peak_memory: int | None


@dataclass(frozen=True)
class Frontend:
    """One way to fill a database.

    Attributes:
        run: fills the given database, which does not exist yet, from the footage, and returns
            the wall time of each stage. Called in a process of its own.
        depends_on: what a result depends on beside name, video, frames and camera, see
            `digest_of`.
        made_by: folders of this package whose code changes the result.
        check: refuses what the front-end cannot run without, before any long work.
        files: files of the user that it reads beside the footage.
    """

    run: Callable[[Footage, Path], dict[str, float]]
    depends_on: Callable[[Footage], tuple[Any, ...]]
    made_by: tuple[str, ...] = WHOLE_PACKAGE
    check: Callable[[], None] = lambda: None
    files: tuple[Path, ...] = ()


def run_measured_frontend(
    name: str, footage: Footage, folder: Path, frontend: Frontend
) -> FrontendRun:
    """Fill a database and measure what it takes; a finished run is not repeated.

    Args:
        name: of the front-end.
        footage: video and images.
        folder: gets `database.db`, `log.txt` and the figures.
        frontend: the front-end.

    Raises:
        ColmapAv1Error: the front-end refuses the footage.
        EvaluationError: it failed.
    """
    database = folder / "database.db"

    def make() -> dict[str, Any]:
        measured = run_measured(frontend.run, footage, database, log=folder / "log.txt")
        return {
            "seconds": measured.result,
            "cpu_seconds": measured.cpu_seconds,
            "peak_memory": measured.peak_memory,
        }

    camera = replace(footage.camera, camera_model=camera_model(footage))
    given = (name, file_digest(footage.video), footage.frames, camera)
    finished = run_stage_in(
        folder,
        [*given, *frontend.depends_on(footage)],
        make,
        products=[database],
        made_by=frontend.made_by,
        timed=True,
    )
    return FrontendRun(name, database, **finished.result)


def camera_model(footage: Footage) -> str:
    """COLMAP's name of the camera model of images whose focal length no front-end estimates."""
    return str(make_camera(footage.camera, *footage.size, footage.pixel_aspect).model_name)


def images_digest(footage: Footage) -> str:
    """Digest of the images' content."""
    return digest_of(file_digest(footage.image_path / name) for name in footage.names)


def list_images(footage: Footage, database: Path) -> None:
    """Make a database of the images, as COLMAP does."""
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = camera_model(footage)
    reader.camera_params = footage.camera.camera_params or ""
    pycolmap.Database.open(database).close()
    # Threads of the extraction would number the images in the order in which they finish.
    mode = pycolmap.CameraMode.SINGLE
    pycolmap.import_images(
        database, footage.image_path, mode, image_names=footage.names, options=reader
    )

"""Front-ends that fill a COLMAP database, behind one interface: images or video in, rows out."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np  # noqa: F401 - before pycolmap: the other order breaks writing PNG files later
import pycolmap

from colmap_av1.errors import EvaluationError, OptionError
from colmap_av1.evaluate.measure import run_measured
from colmap_av1.evaluate.resume import content_of, kept, own_code
from colmap_av1.images import image_names, write_images
from colmap_av1.match import match
from colmap_av1.options import (
    CameraOptions,
    DensityOptions,
    ImageOptions,
    MatchOptions,
    RefineOptions,
)
from colmap_av1.progress import Clock

Preset = Literal["sparse", "default", "dense"]


@dataclass(frozen=True)
class Footage:
    """What every front-end is given.

    Attributes:
        video: an AV1 video.
        image_path: folder that holds the images, decoded from the video or what it was made of.
        frames: the video's frames that are images, every `image_step`-th.
        image_step: distance between the frames that are images.
        camera: the camera of all images.
    """

    video: Path
    image_path: Path
    frames: tuple[int, ...]
    image_step: int
    camera: CameraOptions

    @property
    def names(self) -> list[str]:
        """The images' file names, in display order."""
        return image_names(ImageOptions().image_name, self.frames)


@dataclass(frozen=True)
class FrontendRun:
    """A database and what it took to fill it.

    Attributes:
        name: the front-end.
        database: the COLMAP database.
        seconds: wall time of each stage.
        cpu_seconds: CPU time of all stages together.
        peak_memory: largest resident memory in bytes; None where the system does not tell.
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
        depends_on: what a result depends on beside name, video, frames and camera.
    """

    run: Callable[[Footage, Path], dict[str, float]]
    depends_on: Callable[[Footage], tuple[str, ...]]


def prepare_footage(
    video: Path, folder: Path, *, num_frames: int, image_step: int, camera: CameraOptions
) -> Footage:
    """Write the video's frames as the images that every front-end gets.

    Args:
        video: an AV1 video.
        folder: gets `images/`; what is there of the same video is kept.
        num_frames: number of frames of the video.
        image_step: distance between the frames that are images.
        camera: the camera of all images.

    Raises:
        VideoError: the video cannot be read.
        ImageError: the video has fewer frames.
    """
    frames = tuple(range(0, num_frames, image_step))
    footage = Footage(video, folder / "images", frames, image_step, camera)

    def work() -> dict[str, Any]:
        footage.image_path.mkdir()
        write_images(video, footage.image_path, footage.names, frames)
        return {}

    kept(folder, (content_of(video), frames), work)
    return footage


def run_frontend(name: str, footage: Footage, folder: Path) -> FrontendRun:
    """Fill a database and measure what it takes; a finished run is not repeated.

    Args:
        name: one of FRONTENDS.
        footage: video and images.
        folder: gets `database.db`, `log.txt` and the figures.

    Raises:
        OptionError: there is no such front-end.
        ColmapAv1Error: the front-end refuses the footage.
        EvaluationError: it failed.
    """
    if name not in FRONTENDS:
        raise OptionError(f"front-end '{name}': give one of {', '.join(FRONTENDS)}")
    frontend = FRONTENDS[name]
    database = folder / "database.db"

    def work() -> dict[str, Any]:
        measured = run_measured(frontend.run, footage, database, log=folder / "log.txt")
        return {
            "seconds": measured.result,
            "cpu_seconds": measured.cpu_seconds,
            "peak_memory": measured.peak_memory,
        }

    given = (content_of(footage.video), footage.frames, footage.camera)
    result = kept(folder, (name, *given, *frontend.depends_on(footage)), work)
    if not database.is_file():
        raise EvaluationError(f"{folder}: its database is gone: remove the folder, run again")
    return FrontendRun(name, database, **result)


def _match(options: MatchOptions, footage: Footage, database: Path) -> dict[str, float]:
    options = replace(options, camera=footage.camera, images=ImageOptions(every=footage.image_step))
    return match(database, footage.video, options=options).seconds


def _sift(pairing: Callable[[Path], None], footage: Footage, database: Path) -> dict[str, float]:
    clock = Clock()
    pycolmap.set_random_seed(0)
    reader = pycolmap.ImageReaderOptions()
    if footage.camera.camera_model is not None:
        reader.camera_model = footage.camera.camera_model
    reader.camera_params = footage.camera.camera_params or ""
    pycolmap.Database.open(database).close()
    # Threads of the extraction would number the images in the order in which they finish.
    mode = pycolmap.CameraMode.SINGLE
    pycolmap.import_images(
        database, footage.image_path, mode, image_names=footage.names, options=reader
    )
    with clock.measure("extraction"):
        pycolmap.extract_features(database, footage.image_path, footage.names)
    with clock.measure("matching"):
        pairing(database)
    return clock.seconds


def _own_frontend(refine: Literal["none", "lk"], preset: Preset) -> Frontend:
    options = MatchOptions(
        refine=RefineOptions(refine=refine), density=DensityOptions(preset=preset)
    )
    return Frontend(partial(_match, options), lambda _: (repr(options), own_code()))


def _sift_frontend(pairing: Callable[[Path], None]) -> Frontend:
    return Frontend(
        partial(_sift, pairing), lambda footage: (pycolmap.__version__, _content_of_images(footage))
    )


def _content_of_images(footage: Footage) -> str:
    digests = [content_of(footage.image_path / name) for name in footage.names]
    return hashlib.sha256("".join(digests).encode()).hexdigest()


def _pair_sequentially(database: Path) -> None:
    pycolmap.match_sequential(database)


def _pair_exhaustively(database: Path) -> None:
    pycolmap.match_exhaustive(database)


FRONTENDS: dict[str, Frontend] = {
    # What a mapper gets from the bitstream alone; with `-refined` after a look at the pictures.
    "av1": _own_frontend("none", "default"),
    "av1-sparse": _own_frontend("none", "sparse"),
    "av1-dense": _own_frontend("none", "dense"),
    "av1-refined": _own_frontend("lk", "default"),
    "av1-refined-sparse": _own_frontend("lk", "sparse"),
    "av1-refined-dense": _own_frontend("lk", "dense"),
    "sift-sequential": _sift_frontend(_pair_sequentially),
    "sift-exhaustive": _sift_frontend(_pair_exhaustively),
}

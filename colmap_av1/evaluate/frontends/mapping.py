"""COLMAP's incremental mapper on a database, dense points on its poses, figures of models."""

from __future__ import annotations

import shutil
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap

from colmap_av1.densify import densify
from colmap_av1.evaluate.frontends.footage import Footage, frame_list
from colmap_av1.evaluate.frontends.measure import run_measured
from colmap_av1.evaluate.resume import content_of, kept, own_code
from colmap_av1.model.colmap_model import posed_images, read_model
from colmap_av1.options import DensifyOptions, ImageOptions


@dataclass(frozen=True)
class MapperSettings:
    """How a database is mapped.

    Attributes:
        fixed_intrinsics: keep the intrinsics of the database.
        forward_motion: start with images that lie behind each other if need be.
        seed: the mapper's random seed.
    """

    fixed_intrinsics: bool = False
    forward_motion: bool = False
    seed: int = 0


@dataclass(frozen=True)
class MapperRun:
    """A mapped database and what it took.

    Attributes:
        model: folder of the model with the most images; None where no model came out.
        num_models: models that came out.
        seconds: wall time of the mapper.
        cpu_seconds: its CPU time.
        peak_memory: largest resident memory in bytes; None where the system does not tell.
    """

    model: Path | None
    num_models: int
    seconds: float
    cpu_seconds: float
    peak_memory: int | None


@dataclass(frozen=True)
class ModelFigures:
    """Figures of a model.

    Attributes:
        num_registered: images with a pose.
        num_points: 3D points.
        mean_track_length: images that see a point, on average.
        mean_error: mean of the points' reprojection errors in pixels, as COLMAP states it.
        median_error: their median.
        focal_length: in pixels, on average over the cameras.
    """

    num_registered: int
    num_points: int
    mean_track_length: float
    mean_error: float
    median_error: float
    focal_length: float


def map_database(
    database: Path, image_path: Path, folder: Path, settings: MapperSettings | None = None
) -> MapperRun:
    """Map a database with pycolmap's incremental mapper; a finished run is not repeated.

    Args:
        database: COLMAP database with verified matches; a copy of it is mapped.
        image_path: folder of its images, for the points' colours.
        folder: gets the model, `log.txt` and the figures.
        settings: how to map; the defaults of MapperSettings if None.

    Raises:
        EvaluationError: the mapper failed.
    """
    settings = settings if settings is not None else MapperSettings()
    model = folder / "model"

    def work() -> dict[str, Any]:
        # pycolmap brings a database to its own layout.
        copy = folder / "mapped.db"
        shutil.copyfile(database, copy)
        measured = run_measured(_map, copy, image_path, model, settings, log=folder / "log.txt")
        copy.unlink()
        return {
            "num_models": measured.result,
            "seconds": measured.seconds,
            "cpu_seconds": measured.cpu_seconds,
            "peak_memory": measured.peak_memory,
        }

    key = (content_of(database), asdict(settings), pycolmap.__version__)
    result = kept(folder, key, work)
    return MapperRun(model if result["num_models"] else None, **result)


def densify_model(
    model: Path, footage: Footage, folder: Path, options: DensifyOptions | None = None
) -> MapperRun:
    """Triangulate every track of the video on the poses of a model, as `densify` does.

    A finished run is not repeated.

    Args:
        model: folder of the model.
        footage: video and images.
        folder: gets the model, `log.txt` and the figures.
        options: as of `densify`; the images are those of the footage.

    Raises:
        ColmapAv1Error: as `densify` says.
    """
    options = options if options is not None else DensifyOptions()
    output = folder / "model"

    def work() -> dict[str, Any]:
        registered = set(posed_images(read_model(model)))
        images = ImageOptions(frame_list=frame_list(footage, folder / "frames.txt", registered))
        given = replace(options, match=replace(options.match, images=images))
        measured = run_measured(
            _densify, model, footage.video, output, given, log=folder / "log.txt"
        )
        return {
            "num_models": 1,
            "seconds": measured.seconds,
            "cpu_seconds": measured.cpu_seconds,
            "peak_memory": measured.peak_memory,
        }

    inputs = [content_of(path) for path in (footage.video, *sorted(model.glob("*.bin")))]
    key = (inputs, footage.names, footage.frames, repr(options), own_code())
    return MapperRun(output, **kept(folder, key, work))


def model_figures(model: Any) -> ModelFigures:
    """Figures of a pycolmap.Reconstruction, or of the model in a folder.

    Raises:
        ModelError: the folder holds no readable model with poses.
    """
    if isinstance(model, Path):
        model = read_model(model)
    errors = np.array([p.error for p in model.points3D.values()], dtype=np.float64)
    focal_lengths = [camera.mean_focal_length() for camera in model.cameras.values()]
    return ModelFigures(
        num_registered=model.num_reg_images(),
        num_points=len(errors),
        mean_track_length=model.compute_mean_track_length(),
        mean_error=float(errors.mean()) if len(errors) else float("nan"),
        median_error=float(np.median(errors)) if len(errors) else float("nan"),
        focal_length=float(np.mean(focal_lengths)),
    )


def _map(database: Path, image_path: Path, output: Path, settings: MapperSettings) -> int:
    pycolmap.set_random_seed(settings.seed)
    options = pycolmap.IncrementalPipelineOptions(random_seed=settings.seed)
    if settings.fixed_intrinsics:
        options.ba_refine_focal_length = False
        options.ba_refine_extra_params = False
    if settings.forward_motion:
        options.mapper.init_max_forward_motion = 1.0
    output.mkdir()
    models = pycolmap.incremental_mapping(database, image_path, output, options=options)
    if models:
        # The mapper may leave a bogus model of two images beside the real one.
        max(models.values(), key=lambda m: m.num_reg_images()).write(output)
    return len(models)


def _densify(model: Path, video: Path, output: Path, options: DensifyOptions) -> None:
    densify(model, video, output, options=options)

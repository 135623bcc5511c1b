"""Measured runs of COLMAP's mappers on a front-end's database, and of `densify` on its poses."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import pycolmap

from colmap_av1.densify import densify
from colmap_av1.evaluate.frontends.footage import Footage, frame_list
from colmap_av1.evaluate.frontends.frontend import OF_OTHERS
from colmap_av1.evaluate.frontends.measure import Measured, run_measured
from colmap_av1.options import DensifyOptions, ImageOptions, MapOptions
from colmap_av1.poses.mapper import run_mapper
from colmap_av1.util.digests import file_digest
from colmap_av1.util.stages import run_stage_in


@dataclass(frozen=True)
class MapperRun:
    """A mapped database and the cost of mapping it.

    Attributes:
        model: folder of the model with the most images; None if there is no model.
        num_models: number of models.
        warnings: warnings for the user.
        seconds: wall time of the mapper.
        cpu_seconds: CPU time of the mapper.
        peak_memory: largest resident memory in bytes; None if the system does not report it.
    """

    model: Path | None
    num_models: int
    warnings: tuple[str, ...]
    seconds: float
    cpu_seconds: float
    peak_memory: int | None


def measure_mapper(
    database: Path, image_path: Path, folder: Path, options: MapOptions = MapOptions()
) -> MapperRun:
    """Map a database in a separate process, and measure its time and memory.

    A finished run is not repeated.

    Args:
        database: COLMAP database with verified matches; a copy of it is mapped.
        image_path: folder of its images, for the points' colours.
        folder: gets the models, `log.txt` and the figures.
        options: the mapper and its options.

    Raises:
        EvaluationError: the mapper failed.
    """
    model = folder / "model"

    def make() -> Measured[int]:
        # Map a copy: pycolmap migrates a database to its own layout.
        copy = folder / "mapped.db"
        shutil.copyfile(database, copy)
        measured = run_measured(_map, copy, image_path, model, options, log=folder / "log.txt")
        copy.unlink()
        return measured

    made = run_stage_in(
        folder,
        [file_digest(database), options, pycolmap.__version__],
        Measured[int],
        make,
        products=[model],
        made_by=(*OF_OTHERS, "geometry", "poses"),
        timed=True,
    ).result
    return MapperRun(
        model / "0" if made.result else None,
        num_models=made.result,
        warnings=(),
        seconds=made.seconds,
        cpu_seconds=made.cpu_seconds,
        peak_memory=made.peak_memory,
    )


def densify_model(
    model: Path, footage: Footage, folder: Path, options: DensifyOptions = DensifyOptions()
) -> MapperRun:
    """Triangulate every track of the video on the poses of a model, as `densify` does.

    A finished run is not repeated.

    Args:
        model: folder of the model.
        footage: video and images.
        folder: gets the model, `log.txt` and the figures.
        options: options of `densify`; the images are taken from the footage.

    Raises:
        ColmapAv1Error: see `densify`.
    """
    output = folder / "model"

    def make() -> Measured[tuple[str, ...]]:
        images = ImageOptions(frame_list=frame_list(footage, folder / "frames.txt"))
        given = replace(options, match=replace(options.match, images=images))
        log = folder / "log.txt"
        return run_measured(_densify, model, footage.video, output, given, log=log)

    inputs = [file_digest(path) for path in (footage.video, *sorted(model.glob("*.bin")))]
    # The location of the stream does not change the result.
    anywhere = replace(options, match=replace(options.match, keep_stream=None))
    given = (inputs, footage.names, footage.frames, anywhere)
    kind = Measured[tuple[str, ...]]
    made = run_stage_in(folder, given, kind, make, products=[output], timed=True).result
    return MapperRun(
        output,
        num_models=1,
        warnings=made.result,
        seconds=made.seconds,
        cpu_seconds=made.cpu_seconds,
        peak_memory=made.peak_memory,
    )


def _map(database: Path, image_path: Path, output: Path, options: MapOptions) -> int:
    output.mkdir()
    return len(run_mapper(database, output, options, image_path=image_path))


def _densify(model: Path, video: Path, output: Path, options: DensifyOptions) -> tuple[str, ...]:
    return densify(model, video, output, options=options).warnings

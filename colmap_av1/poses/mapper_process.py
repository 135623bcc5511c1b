"""The child process that maps or adjusts.

It imports nothing else of the package, which would take twice as long as importing pycolmap alone.
Settings and results are therefore JSON values.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, TypedDict

# Initial radius of Ceres' trust region in adjustments after the first, a hundred times its default.
# Near the minimum, the default slows down changes that are poorly determined, as that of the scale
# in a turn. Far from it, the default is needed.
_LATE_TRUST_RADIUS = 1e6
# An adjustment before the last may stop earlier: the next one reaches the same minimum.
_FIRST_TOLERANCE = 1e-3
# Largest number of images for which the reduced camera matrix is solved as a dense one: long tracks
# fill it, and analysing its sparsity takes as long as solving it.
_MAX_DENSE_IMAGES = 400


class MapperSettings(TypedDict):
    """Settings of a mapper.

    Attributes:
        database: the database.
        output: an existing folder for the models.
        mapper: the mapper.
        refine_intrinsics: refine focal length and distortion.
        initial_pair: limits for the initial pair, by the names of the mapper's options.
        seed: the random seed.
        num_threads: number of threads.
    """

    database: str
    output: str
    mapper: Literal["incremental", "global"]
    refine_intrinsics: bool
    initial_pair: dict[str, float]
    seed: int
    num_threads: int


class MappingSettings(MapperSettings):
    """Settings of `run_mapping`.

    Attributes:
        task: what `run_child` does with the settings.
        image_path: folder of the images, for the colours of points; None leaves them black.
        growth: all images are adjusted whenever their number or that of points has grown by this
            factor; None: COLMAP's default.
        tolerance: function tolerance of the global bundle adjustment; None: COLMAP's default.
    """

    task: Literal["mapping"]
    image_path: str | None
    growth: float | None
    tolerance: float | None


class StartSettings(MapperSettings):
    """Settings of a start of the incremental mapper, see `start_mapper`.

    Attributes:
        task: what `run_child` does with the settings.
        num_images: number of images at which the mapper is stopped.
    """

    task: Literal["start"]
    num_images: int


class AdjustmentSettings(TypedDict):
    """Settings of a bundle adjustment, see the arguments of `adjust_model`.

    Attributes:
        task: what `run_child` does with the settings.
    """

    task: Literal["adjustment"]
    model: str
    refine_intrinsics: bool
    loss_scales: list[float]
    seed: int
    num_threads: int
    max_steps: int
    tolerance: float
    iterative: bool


Settings = MappingSettings | StartSettings | AdjustmentSettings


def run_child(settings: Settings) -> None:
    """Map or adjust in this process, and print progress to standard output."""
    # Ctrl-C also reaches the parent, which ends this process.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    channel = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)

    import numpy as np  # noqa: F401, PLC0415 - before pycolmap
    import pycolmap  # noqa: PLC0415

    # Log to standard error, and not to files in the temporary folder. pycolmap's adjustment resets
    # the first setting.
    pycolmap.logging.logtostderr = True
    for level in pycolmap.logging.Level.__members__.values():
        pycolmap.logging.set_log_destination(level, "")
    pycolmap.set_random_seed(settings["seed"])
    try:
        if settings["task"] == "adjustment":
            _adjust(settings)
        elif settings["task"] == "start":
            print("names", json.dumps(_start(settings)), file=channel)
        else:
            found = run_mapping(settings, lambda: print("registered", file=channel))
            print("models", json.dumps(found), file=channel)
    except Exception as error:
        channel.write(f"failed {' '.join(str(error).split())}\n")
        raise
    channel.write("done\n")
    channel.close()


def run_mapping(settings: MappingSettings, on_image: Callable[[], None] | None = None) -> list[int]:
    """Map a database, see `run_mapper`; `on_image` is called whenever an image is registered."""
    import numpy as np  # noqa: F401, PLC0415 - before pycolmap
    import pycolmap  # noqa: PLC0415 - after the redirection in run_child

    database, output = Path(settings["database"]), Path(settings["output"])
    refine = settings["refine_intrinsics"]
    pycolmap.set_random_seed(settings["seed"])
    # pycolmap writes each model as soon as it is finished, but the largest is to come first.
    each = output / "each"
    each.mkdir()
    if settings["mapper"] == "incremental":
        how = _incremental_options(settings)
        if settings["tolerance"] is not None:
            how.ba_global_function_tolerance = settings["tolerance"]
        if settings["growth"] is not None:
            how.ba_global_frames_ratio = how.ba_global_points_ratio = settings["growth"]
        # pycolmap accepts None for a callback, although its stub does not declare it.
        callbacks: Any = {
            "initial_image_pair_callback": on_image,
            "next_image_callback": on_image,
        }
        models = pycolmap.incremental_mapping(database, each, each, options=how, **callbacks)
    else:
        global_options = pycolmap.GlobalPipelineOptions(
            random_seed=settings["seed"], num_threads=settings["num_threads"]
        )
        adjustment = global_options.mapper.bundle_adjustment
        adjustment.refine_focal_length = refine
        adjustment.refine_extra_params = refine
        if settings["tolerance"] is not None:
            adjustment.ceres.solver_options.function_tolerance = settings["tolerance"]
        models = pycolmap.global_mapping(database, each, each, options=global_options)
    shutil.rmtree(each)
    # The mapper keeps the images of a model even if it removes all of its points.
    useful = [model for model in models.values() if model.num_points3D() > 0]
    found = sorted(useful, key=lambda m: -m.num_reg_images())
    for number, model in enumerate(found):
        if settings["image_path"] is not None:
            model.extract_colors_for_all_images(settings["image_path"])
        folder = output / str(number)
        folder.mkdir()
        model.write_binary(folder)
    return [model.num_reg_images() for model in found]


def _incremental_options(settings: MapperSettings) -> Any:
    """Options of the incremental mapper."""
    import pycolmap  # noqa: PLC0415 - after the redirection in run_child

    how = pycolmap.IncrementalPipelineOptions(
        random_seed=settings["seed"], num_threads=settings["num_threads"]
    )
    how.extract_colors = False
    how.ba_refine_focal_length = settings["refine_intrinsics"]
    how.ba_refine_extra_params = settings["refine_intrinsics"]
    for name, value in settings["initial_pair"].items():
        setattr(how.mapper, name, value)
    return how


class _EnoughImagesError(Exception):
    """The first model has enough images."""


def _start(settings: StartSettings) -> list[str] | None:
    """Begin to map, see `start_mapper`."""
    import pycolmap  # noqa: PLC0415 - after the redirection in run_child

    num_images = 0

    def start() -> None:
        nonlocal num_images
        num_images = 2

    def count_image() -> None:
        nonlocal num_images
        num_images += 1
        if num_images >= settings["num_images"]:
            raise _EnoughImagesError

    how = _incremental_options(settings)
    how.multiple_models = False
    output = Path(settings["output"]) / "start"
    output.mkdir(exist_ok=True)
    callbacks: Any = {"initial_image_pair_callback": start, "next_image_callback": count_image}
    try:
        models = pycolmap.incremental_mapping(
            settings["database"], output, output, options=how, **callbacks
        )
    except _EnoughImagesError:
        return None
    if not models:
        return []
    return [image.name for image in models[0].images.values() if image.has_pose]


def _adjust(settings: AdjustmentSettings) -> None:
    import pycolmap  # noqa: PLC0415 - after the redirection in run_child

    model = pycolmap.Reconstruction(settings["model"])
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = settings["refine_intrinsics"]
    options.refine_extra_params = settings["refine_intrinsics"]
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.max_num_images_direct_dense_cpu_solver = _MAX_DENSE_IMAGES
    if settings["iterative"]:  # the solver is iterative beyond both limits
        options.ceres.max_num_images_direct_dense_cpu_solver = 1
        options.ceres.max_num_images_direct_sparse_cpu_solver = 2
    solver = options.ceres.solver_options
    solver.num_threads = settings["num_threads"]
    solver.max_num_iterations = settings["max_steps"]
    scales = settings["loss_scales"]
    for number, scale in enumerate(scales, start=1):
        if number > 1:
            solver.initial_trust_region_radius = _LATE_TRUST_RADIUS
        options.ceres.loss_function_scale = scale
        is_last = number == len(scales)
        solver.function_tolerance = settings["tolerance"] if is_last else _FIRST_TOLERANCE
        pycolmap.bundle_adjustment(model, options)
    model.write_binary(settings["model"])

"""COLMAP's mappers and bundle adjustment in separate processes, which can be stopped and logged."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

from colmap_av1.errors import ModelError, WriteError
from colmap_av1.geometry.colmap_model import read_model
from colmap_av1.matching.mapper_limits import FORWARD_MOTION
from colmap_av1.options import MapOptions
from colmap_av1.poses import mapper_process as child
from colmap_av1.poses.mapper_process import (
    AdjustmentSettings,
    MapperSettings,
    MappingSettings,
    Settings,
    StartSettings,
    run_mapping,
)
from colmap_av1.util.cpus import BLAS_THREADS, threads_or_cpus
from colmap_av1.util.memory import give_back_free_memory
from colmap_av1.util.processes import bound
from colmap_av1.util.progress import Progress

# A mapper that finds no initial pair may leave a spurious model of two images.
LEAST_IMAGES = 3
# Convergence is slow with a robust loss: steps that lower the cost by less than 0.1 % still reduce
# the long-range epipolar error.
ADJUSTMENT_STEPS = 20
ADJUSTMENT_TOLERANCE = 1e-4
# Function tolerance of the mapper's global bundle adjustment where another adjustment follows. The
# poses are the same after it, in half the time.
_EARLY_TOLERANCE = 1e-4
# COLMAP's settings for videos adjust all images whenever the number of images or points has grown
# by this factor, instead of 1.1 (OptionManager::ModifyForVideoData). With this and a tolerance of
# 1e-6 instead of 0, the mapper takes two thirds of the time, and models are the same.
_VIDEO_GROWTH = 1.4
_VIDEO_TOLERANCE = 1e-6
MapperEffort = Literal["full", "video", "early"]
# The module is loaded from its file, since importing the whole package takes twice as long as
# pycolmap. The path must not contain '': files in the working folder would shadow libraries.
_CHILD = """
import importlib.util, json, sys
sys.path[:] = filter(None, sys.path)
spec = importlib.util.spec_from_file_location("child", sys.argv[1])
child = importlib.util.module_from_spec(spec)
spec.loader.exec_module(child)
child.run_child(json.loads(sys.argv[2]))
"""


def map_poses(
    database: Path,
    output: Path,
    options: MapOptions,
    *,
    image_path: Path | None,
    log: Path,
    num_images: int,
    progress: Progress,
    effort: MapperEffort = "full",
) -> tuple[int, ...]:
    """Map a database in a separate process, see `run_mapper`.

    Args:
        database: COLMAP database with verified matches; pycolmap migrates it to its schema.
        output: folder for the models; created if missing.
        options: mapper and its options.
        image_path: folder of the images, for the colours of points; None leaves them black.
        log: file for the output of the mapper.
        num_images: number of images, for the progress.
        progress: called in the stage "poses" with the number of images registered so far.
        effort: how often and how exactly all images are adjusted. full: as by COLMAP's defaults;
            video: by the incremental mapper, as often as in COLMAP's settings for videos, and only
            as exactly as makes a difference; early: adjustment ends early, because the poses are
            adjusted later.

    Returns:
        Number of registered images of each model, in descending order; empty if there is no model.

    Raises:
        ModelError: the mapper failed; the log holds the details.
        WriteError: the models are incomplete.
    """
    output.mkdir(parents=True, exist_ok=True)
    settings = _mapping_settings(database, output, options, image_path)
    if effort == "video" and options.mapper == "incremental":
        settings["growth"], settings["tolerance"] = _VIDEO_GROWTH, _VIDEO_TOLERANCE
    elif effort == "early":
        settings["tolerance"] = _EARLY_TOLERANCE
    progress("poses", 0, num_images)
    sizes: list[int] = []
    registered = 0

    def on_message(word: str, value: str) -> None:
        nonlocal registered, sizes
        if word == "registered":
            registered += 1
            progress("poses", min(registered, num_images), num_images)
        elif word == "models":
            sizes = json.loads(value)

    failed = f"COLMAP's {options.mapper} mapper"
    _run_in_process(settings, on_message, log, failed=failed, hint="try the other --mapper")
    if sizes:
        _check_whole(output / "0")
    progress("poses", num_images, num_images)
    return tuple(sizes)


def run_mapper(
    database: Path,
    output: Path,
    options: MapOptions,
    *,
    image_path: Path | None = None,
) -> list[int]:
    """Map a database in this process, with COLMAP's defaults.

    Args:
        database: COLMAP database with verified matches; pycolmap migrates it to its schema.
        output: an existing folder for the models, each in a folder numbered from 0. The largest
            comes first, since a mapper may also create spurious models of two images.
        options: mapper and its options.
        image_path: folder of the images, for the colours of points; None leaves them black.

    Returns:
        Number of registered images of each model.
    """
    return run_mapping(_mapping_settings(database, output, options, image_path))


def _mapping_settings(
    database: Path,
    output: Path,
    options: MapOptions,
    image_path: Path | None,
) -> MappingSettings:
    initial_pair = FORWARD_MOTION.options if options.forward_motion else {}
    if options.init_min_tri_angle is not None:
        initial_pair = {**initial_pair, "init_min_tri_angle": options.init_min_tri_angle}
    return {
        **_mapper_settings(database, output, options, initial_pair),
        "task": "mapping",
        "image_path": str(image_path) if image_path is not None else None,
        "growth": None,
        "tolerance": None,
    }


def _mapper_settings(
    database: Path, output: Path, options: MapOptions, initial_pair: dict[str, float]
) -> MapperSettings:
    return {
        "database": str(database),
        "output": str(output),
        "mapper": options.mapper,
        "refine_intrinsics": options.refine_intrinsics,
        "initial_pair": initial_pair,
        "seed": options.seed,
        "num_threads": threads_or_cpus(options.num_threads),
    }


def start_mapper(
    database: Path,
    options: MapOptions,
    num_images: int,
    *,
    log: Path,
    initial_pair: dict[str, float],
) -> list[str] | None:
    """Run the incremental mapper on a database until its first model has a number of images.

    Args:
        database: COLMAP database with verified matches; pycolmap migrates it to its schema.
        options: options of the mapper.
        num_images: number of images at which the mapper is stopped.
        log: file for the output of the mapper.
        initial_pair: limits for the initial pair, by the names of the mapper's options.

    Returns:
        None if the first model reaches `num_images`. If it stays smaller, the names of its images,
        an empty list if the mapper starts no model.

    Raises:
        ModelError: the mapper failed; the log holds the details.
    """
    settings: StartSettings = {
        **_mapper_settings(database, database.parent, options, initial_pair),
        "task": "start",
        "num_images": num_images,
    }
    names: list[str] | None = None

    def on_message(word: str, value: str) -> None:
        nonlocal names
        if word == "names":
            names = json.loads(value)

    hint = "'colmap mapper' shows more"
    _run_in_process(settings, on_message, log, failed="COLMAP's incremental mapper", hint=hint)
    return names


def adjust_model(
    model: Path,
    *,
    refine_intrinsics: bool,
    loss_scales: Sequence[float],
    seed: int,
    num_threads: int,
    log: Path,
    max_steps: int = ADJUSTMENT_STEPS,
    tolerance: float = ADJUSTMENT_TOLERANCE,
    iterative: bool = False,
) -> None:
    """Bundle-adjust poses, points and, optionally, intrinsics of a model, which is overwritten.

    Args:
        model: folder of a COLMAP model.
        refine_intrinsics: refine focal length and distortion.
        loss_scales: scale in pixels of the Cauchy loss of each of several consecutive adjustments.
            A small scale alone would hardly move images with much larger errors.
        seed: the random seed.
        num_threads: number of threads; only one thread makes the result reproducible.
        log: file for the output of COLMAP.
        max_steps: largest number of iterations of each adjustment.
        tolerance: function tolerance of the last adjustment: smallest relative decrease of the cost
            per iteration.
        iterative: solve the linear systems by conjugate gradients. They are faster for many images,
            and slower if the scale is poorly determined.

    Raises:
        ModelError: the adjustment failed; the log holds the details.
        WriteError: the model is incomplete.
    """
    settings: AdjustmentSettings = {
        "task": "adjustment",
        "model": str(model),
        "refine_intrinsics": refine_intrinsics,
        "loss_scales": list(loss_scales),
        "seed": seed,
        "num_threads": num_threads,
        "max_steps": max_steps,
        "tolerance": tolerance,
        "iterative": iterative,
    }
    _run_in_process(settings, None, log, failed="COLMAP's adjustment", hint="--adjust 0 skips it")
    _check_whole(model)


def _check_whole(model: Path) -> None:
    """Check that a model is complete: COLMAP reports no error when the disk is full."""
    try:
        read_model(model)
    except ModelError as error:
        raise WriteError(
            f"{model}: is incomplete: make sure that the disk has space, and run the same command "
            "again"
        ) from error


def _run_in_process(
    settings: Settings,
    on_message: Callable[[str, str], None] | None,
    log: Path,
    *,
    failed: str,
    hint: str,
) -> None:
    """Run `run_child` in a process; `on_message` gets the names and values that it prints."""
    # The child finds libraries where this process does. Idle BLAS threads would spin.
    path, num_threads = os.pathsep.join(sys.path), str(settings["num_threads"])
    environment = {**os.environ, "PYTHONPATH": path, BLAS_THREADS: num_threads}
    done, reason = False, ""
    give_back_free_memory()  # for the child
    with (
        log.open("wb") as file,
        subprocess.Popen(
            bound([sys.executable, "-c", _CHILD, child.__file__, json.dumps(settings)]),
            stdout=subprocess.PIPE,
            stderr=file,
            env=environment,
            text=True,
        ) as process,
    ):
        try:
            assert process.stdout is not None
            for line in process.stdout:
                word, _, value = line.strip().partition(" ")
                done = word == "done"
                if word == "failed":
                    reason = f" ({value})"
                elif on_message is not None:
                    on_message(word, value)
        except BaseException:
            process.kill()
            raise
    if not done:
        raise ModelError(
            f"{failed} stopped with status {process.returncode}{reason}: see {log}; {hint}"
        )

"""COLMAP's mappers and adjustment, in processes of their own: to be stopped, logs kept apart."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TextIO

from colmap_av1.errors import ModelError
from colmap_av1.model.colmap_model import read_model
from colmap_av1.util.processes import bound
from colmap_av1.util.progress import Progress

# Poses that are nearly right need no more steps; COLMAP's own limits take five times as long.
_ADJUSTMENT_STEPS = 20
_ADJUSTMENT_TOLERANCE = 1e-5

# Not `-m`, nor with '' on the path: a checkout in the working folder would hide the package.
_CHILD = """
import json, sys
sys.path[:] = filter(None, sys.path)
from colmap_av1.model.mapper import run_child
run_child(json.loads(sys.argv[1]))
"""


@dataclass(frozen=True)
class MapperRun:
    """The models that a mapper made.

    Attributes:
        num_images: images with a pose in each model, the most first; empty where none came out.
    """

    num_images: tuple[int, ...]


def map_poses(
    database: Path,
    output: Path,
    *,
    mapper: Literal["incremental", "global"],
    refine_intrinsics: bool,
    forward_motion: bool,
    seed: int,
    num_threads: int,
    log: Path,
    num_images: int,
    progress: Progress,
) -> MapperRun:
    """Map a database; the model with the most images is written.

    Args:
        database: COLMAP database with verified matches; pycolmap brings it to its own layout.
        output: folder that gets the model; made here.
        mapper: which of COLMAP's mappers.
        refine_intrinsics: refine focal length and distortion.
        forward_motion: let the incremental mapper start with images behind each other.
        seed: the random seed.
        num_threads: threads; the result is the same from run to run with one only.
        log: file that gets what the mapper prints.
        num_images: number of images, for the progress.
        progress: told about the stage "poses" with the number of images placed so far.

    Raises:
        ModelError: the mapper failed; the log says more.
    """
    output.mkdir(parents=True, exist_ok=True)
    settings = {
        "task": mapper,
        "database": str(database),
        "model": str(output),
        "refine_intrinsics": refine_intrinsics,
        "forward_motion": forward_motion,
        "seed": seed,
        "num_threads": num_threads,
    }
    progress("poses", 0, num_images)
    sizes: list[int] = []
    placed = 0

    def told(word: str, value: str) -> None:
        nonlocal placed, sizes
        if word == "placed":
            placed += 1
            progress("poses", min(placed, num_images), num_images)
        elif word == "models":
            sizes = json.loads(value)

    _run_apart(
        settings, told, log, failed=f"COLMAP's {mapper} mapper", hint="try the other --mapper"
    )
    if sizes:
        _check_whole(output)
    progress("poses", num_images, num_images)
    return MapperRun(tuple(sizes))


def adjust_model(
    model: Path,
    *,
    refine_intrinsics: bool,
    loss_scale: float,
    seed: int,
    num_threads: int,
    log: Path,
) -> None:
    """Adjust poses, points and, if asked to, intrinsics of a model together; it is overwritten.

    Args:
        model: folder of a COLMAP model.
        refine_intrinsics: refine focal length and distortion.
        loss_scale: reprojection error in pixels from which on an observation counts less
            (Cauchy's loss).
        seed: the random seed.
        num_threads: threads; the result is the same from run to run with one only.
        log: file that gets what COLMAP prints.

    Raises:
        ModelError: the adjustment failed; the log says more.
    """
    settings = {
        "task": "adjustment",
        "model": str(model),
        "refine_intrinsics": refine_intrinsics,
        "loss_scale": loss_scale,
        "seed": seed,
        "num_threads": num_threads,
    }
    _run_apart(settings, None, log, failed="COLMAP's adjustment", hint="--adjust 0 leaves it out")
    _check_whole(model)


def _check_whole(model: Path) -> None:
    """Refuse a model that was cut short, as on a full disk: COLMAP does not say so."""
    try:
        read_model(model)
    except ModelError as error:
        raise ModelError(
            f"{model}: was not written to its end: see that the disk has space, and run the same "
            "command again"
        ) from error


def _run_apart(
    settings: dict[str, Any],
    told: Callable[[str, str], None] | None,
    log: Path,
    *,
    failed: str,
    hint: str,
) -> None:
    """Do what the settings say in a process; `told` gets the words and values it prints."""
    # The package is found where this one was.
    path = os.pathsep.join([str(Path(__file__).resolve().parents[2]), *sys.path])
    done, reason = False, ""
    with (
        log.open("wb") as file,
        subprocess.Popen(
            bound([sys.executable, "-c", _CHILD, json.dumps(settings)]),
            stdout=subprocess.PIPE,
            stderr=file,
            env={**os.environ, "PYTHONPATH": path},
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
                elif told is not None:
                    told(word, value)
        except BaseException:
            process.kill()
            raise
    if not done:
        raise ModelError(
            f"{failed} stopped with status {process.returncode}{reason}: {log} tells where; {hint}"
        )


def run_child(settings: dict[str, Any]) -> None:
    """Map or adjust in this process; what happens is told on standard output."""
    # The interrupt of a terminal reaches the parent, too, which ends this process.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    channel = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)

    import numpy as np  # noqa: F401, PLC0415 - before pycolmap
    import pycolmap  # noqa: PLC0415

    pycolmap.set_random_seed(settings["seed"])
    try:
        if settings["task"] == "adjustment":
            _adjust(settings)
        else:
            _map(settings, channel)
    except Exception as error:
        channel.write(f"failed {' '.join(str(error).split())}\n")
        raise
    channel.write("done\n")
    channel.close()


def _map(settings: dict[str, Any], channel: TextIO) -> None:
    import pycolmap  # noqa: PLC0415 - after what run_child does first

    def placed() -> None:
        channel.write("placed\n")

    database, output = settings["database"], settings["model"]
    each = Path(output) / "each"
    each.mkdir()
    refine = settings["refine_intrinsics"]
    common = {"random_seed": settings["seed"], "num_threads": settings["num_threads"]}
    if settings["task"] == "incremental":
        options = pycolmap.IncrementalPipelineOptions(**common)
        options.extract_colors = False
        options.ba_refine_focal_length = refine
        options.ba_refine_extra_params = refine
        options.mapper.abs_pose_refine_focal_length = refine
        options.mapper.abs_pose_refine_extra_params = refine
        if settings["forward_motion"]:
            options.mapper.init_max_forward_motion = 1.0
        models = pycolmap.incremental_mapping(
            database,
            each,
            each,
            options=options,
            initial_image_pair_callback=placed,
            next_image_callback=placed,
        )
    else:
        options = pycolmap.GlobalPipelineOptions(**common)
        options.mapper.bundle_adjustment.refine_focal_length = refine
        options.mapper.bundle_adjustment.refine_extra_params = refine
        models = pycolmap.global_mapping(database, each, each, options=options)
    found = sorted(models.values(), key=lambda m: -m.num_reg_images())
    if found:
        found[0].write_binary(output)
    shutil.rmtree(each)
    channel.write(f"models {json.dumps([m.num_reg_images() for m in found])}\n")


def _adjust(settings: dict[str, Any]) -> None:
    import pycolmap  # noqa: PLC0415 - after what run_child does first

    model = pycolmap.Reconstruction(settings["model"])
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = settings["refine_intrinsics"]
    options.refine_extra_params = settings["refine_intrinsics"]
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = settings["loss_scale"]
    solver = options.ceres.solver_options
    solver.num_threads = settings["num_threads"]
    solver.max_num_iterations = _ADJUSTMENT_STEPS
    solver.function_tolerance = _ADJUSTMENT_TOLERANCE
    pycolmap.bundle_adjustment(model, options)
    model.write_binary(settings["model"])

"""COLMAP's mappers, each in a process of its own: it can be stopped, and its log kept apart."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from colmap_av1.errors import ModelError
from colmap_av1.progress import Progress

# Not `-m`, nor with '' on the path: a checkout in the working folder would hide the package.
_CHILD = """
import json, sys
sys.path[:] = filter(None, sys.path)
from colmap_av1.mapper import run_child
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
    num_threads: int | None,
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
        num_threads: threads; None: one per CPU.
        log: file that gets what the mapper prints.
        num_images: number of images, for the progress.
        progress: told about the stage "poses" with the number of images placed so far.

    Raises:
        ModelError: the mapper failed; the log says more.
    """
    output.mkdir(parents=True, exist_ok=True)
    settings = {
        "database": str(database),
        "output": str(output),
        "mapper": mapper,
        "refine_intrinsics": refine_intrinsics,
        "forward_motion": forward_motion,
        "seed": seed,
        "num_threads": num_threads or -1,
    }
    progress("poses", 0, num_images)
    sizes: list[int] | None = None
    placed = 0
    # The package is found where this one was.
    path = os.pathsep.join([str(Path(__file__).resolve().parents[1]), *sys.path])
    with (
        log.open("wb") as file,
        subprocess.Popen(
            [sys.executable, "-c", _CHILD, json.dumps(settings)],
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
                if word == "placed":
                    placed += 1
                    progress("poses", min(placed, num_images), num_images)
                elif word == "models":
                    sizes = json.loads(value)
        except BaseException:
            process.kill()
            raise
    if sizes is None:
        raise ModelError(
            f"COLMAP's {mapper} mapper stopped with status {process.returncode}: {log} tells "
            "where; try the other --mapper"
        )
    progress("poses", num_images, num_images)
    return MapperRun(tuple(sizes))


def run_child(settings: dict[str, Any]) -> None:
    """Map in this process; what happens is told on standard output."""
    # The interrupt of a terminal reaches the parent, too, which ends this process.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    channel = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)

    import numpy as np  # noqa: F401, PLC0415 - before pycolmap
    import pycolmap  # noqa: PLC0415

    def placed() -> None:
        channel.write("placed\n")

    pycolmap.set_random_seed(settings["seed"])
    database, output = settings["database"], settings["output"]
    refine = settings["refine_intrinsics"]
    common = {"random_seed": settings["seed"], "num_threads": settings["num_threads"]}
    if settings["mapper"] == "incremental":
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
            output,
            output,
            options=options,
            initial_image_pair_callback=placed,
            next_image_callback=placed,
        )
    else:
        options = pycolmap.GlobalPipelineOptions(**common)
        options.mapper.bundle_adjustment.refine_focal_length = refine
        options.mapper.bundle_adjustment.refine_extra_params = refine
        models = pycolmap.global_mapping(database, output, output, options=options)
    found = sorted(models.values(), key=lambda m: -m.num_reg_images())
    if found:
        found[0].write_binary(output)
    channel.write(f"models {json.dumps([m.num_reg_images() for m in found])}\n")
    channel.close()

"""COLMAP's mappers and bundle adjustment in separate processes, to stop them and keep logs."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from colmap_av1.errors import ModelError
from colmap_av1.geometry.colmap_model import read_model
from colmap_av1.matching.mapper_limits import ANY_FORWARD_MOTION
from colmap_av1.options import MapOptions
from colmap_av1.poses import mapper_process as child
from colmap_av1.poses.mapper_process import run_mapping
from colmap_av1.util.cpus import BLAS_THREADS, threads_or_cpus
from colmap_av1.util.memory import give_back_free_memory
from colmap_av1.util.processes import bound
from colmap_av1.util.progress import Progress

if TYPE_CHECKING:
    import pycolmap

# The robust loss makes progress slow: steps that each lower the error by less than a thousandth
# still bring far views of one place together.
_ADJUSTMENT_STEPS = 20
_ADJUSTMENT_TOLERANCE = 1e-4
# Where an adjustment with a smaller loss follows, which goes on from there to the same end.
_FIRST_TOLERANCE = 1e-3
# Images up to which the matrix of all cameras is taken as dense: tracks of many images fill it, and
# looking for its structure takes as long as solving it.
_MOST_DENSE_IMAGES = 400
# Points that an image must see to be held by them, as COLMAP's mapper asks of one before it gets a
# pose, unless all see few: then this share of what is usual. An image that a pillar fills saw 8
# where others saw 300 and more, and was off by 300 times as much as they.
FEW_SEEN = (30, 0.1)

# The file by itself: the whole package takes twice as long to import as pycolmap. Without '' on the
# path: what lies in the working folder would be imported in place of libraries.
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
    start_tracks: int | None = None,
    tolerance: float | None = None,
) -> tuple[int, ...]:
    """Map a database in a process of its own, see `run_mapper`.

    Args:
        database: COLMAP database with verified matches; pycolmap brings it to its own layout.
        output: folder that gets the models; made where it is missing.
        options: which mapper, and how.
        image_path: folder of the images; None: the points stay black.
        log: file that gets what the mapper prints.
        num_images: number of images, for the progress.
        progress: called in the stage "poses" with the number of images placed so far.
        start_tracks: tracks of each image that the global mapper starts from, the longest ones; the
            others are triangulated and adjusted on what it finds. None: all.
        tolerance: share of the error that a step of adjusting all images must lower it by, or be
            the last. None: what COLMAP sets.

    Returns:
        Images with a pose in each model, the most first; empty where none came out.

    Raises:
        ModelError: the mapper failed; the log says more.
    """
    output.mkdir(parents=True, exist_ok=True)
    settings = _mapping_settings(database, output, options, image_path)
    settings |= {"start_tracks": start_tracks, "tolerance": tolerance}
    progress("poses", 0, num_images)
    sizes: list[int] = []
    placed = 0

    def hear(word: str, value: str) -> None:
        nonlocal placed, sizes
        if word == "placed":
            placed += 1
            progress("poses", min(placed, num_images), num_images)
        elif word == "models":
            sizes = json.loads(value)

    failed = f"COLMAP's {options.mapper} mapper"
    _run_apart(settings, hear, log, failed=failed, hint="try the other --mapper")
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
    """Map a database in this process.

    Args:
        database: COLMAP database with verified matches; pycolmap brings it to its own layout.
        output: an existing folder; gets a folder for each model, numbered from 0, the model with
            the most images first: a mapper may make one of two images beside the real one.
        options: which mapper, and how.
        image_path: folder of the images; None: the points stay black.

    Returns:
        Images with a pose in each model.
    """
    return run_mapping(_mapping_settings(database, output, options, image_path))


def _mapping_settings(
    database: Path, output: Path, options: MapOptions, image_path: Path | None
) -> dict[str, Any]:
    refine = options.refine_intrinsics
    return {
        "task": "mapping",
        "database": str(database),
        "model": str(output),
        "image_path": str(image_path) if image_path is not None else None,
        "mapper": options.mapper,
        "refine_intrinsics": refine if refine is not None else not options.forward_motion,
        "init_max_forward_motion": ANY_FORWARD_MOTION if options.forward_motion else None,
        "seed": options.seed,
        "num_threads": threads_or_cpus(options.num_threads),
        "start_tracks": None,
        "tolerance": None,
    }


def adjust_model(
    model: Path,
    *,
    refine_intrinsics: bool,
    loss_scales: Sequence[float],
    seed: int,
    num_threads: int,
    log: Path,
    max_steps: int = _ADJUSTMENT_STEPS,
    tolerance: float = _ADJUSTMENT_TOLERANCE,
) -> None:
    """Bundle-adjust poses, points and, if asked to, intrinsics of a model; it is overwritten.

    Args:
        model: folder of a COLMAP model.
        refine_intrinsics: refine focal length and distortion.
        loss_scales: reprojection errors in pixels from which on an observation counts less
            (Cauchy's loss), of one adjustment after another: with a small one alone, images that
            are off by much more hardly move.
        seed: the random seed.
        num_threads: threads; the result is the same from run to run with one only.
        log: file that gets what COLMAP prints.
        max_steps: steps of each adjustment at most.
        tolerance: share of the cost that a step of the last adjustment must lower it by, or be the
            last.

    Raises:
        ModelError: the adjustment failed; the log says more.
    """
    tolerances = [_FIRST_TOLERANCE] * (len(loss_scales) - 1) + [tolerance]
    settings = {
        "task": "adjustment",
        "model": str(model),
        "refine_intrinsics": refine_intrinsics,
        "loss_scales": list(loss_scales),
        "seed": seed,
        "num_threads": num_threads,
        "max_num_iterations": max_steps,
        "function_tolerances": tolerances,
        "most_dense_images": _MOST_DENSE_IMAGES,
    }
    _run_apart(settings, None, log, failed="COLMAP's adjustment", hint="--adjust 0 leaves it out")
    _check_whole(model)


def without_unseen_images(model: Path) -> pycolmap.Reconstruction:
    """Leave out of a model the images that hardly any of its points are seen in; read it.

    Args:
        model: folder of a COLMAP model; it is overwritten where an image is left out.
    """
    found = read_model(model)
    counts = {number: image.num_points3D for number, image in found.images.items()}
    most, share = FEW_SEEN
    few = min(most, share * statistics.median(counts.values()))
    unseen = [number for number, count in counts.items() if count < few]
    for number in unseen:
        found.deregister_frame(found.images[number].frame_id)
    if unseen:
        found.write_binary(model)
    return found


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
    hear: Callable[[str, str], None] | None,
    log: Path,
    *,
    failed: str,
    hint: str,
) -> None:
    """Run the settings in a process; `hear` gets the names and values that it prints."""
    # Libraries are found where this process has them. Idle threads of BLAS would wait in a loop.
    path, num_threads = os.pathsep.join(sys.path), str(settings["num_threads"])
    environment = {**os.environ, "PYTHONPATH": path, BLAS_THREADS: num_threads}
    done, reason = False, ""
    give_back_free_memory()  # the process needs its own beside this one's
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
                elif hear is not None:
                    hear(word, value)
        except BaseException:
            process.kill()
            raise
    if not done:
        raise ModelError(
            f"{failed} stopped with status {process.returncode}{reason}: {log} says where; {hint}"
        )

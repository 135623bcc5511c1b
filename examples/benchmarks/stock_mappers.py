"""Measure the models of COLMAP's mappers, with default options, on the database of `match`.

python examples/benchmarks/stock_mappers.py --cache benchmark_mappers

`match` gets the original video of each clip and runs with its defaults; known intrinsics are given.
Its database is mapped by the command that it prints, `colmap mapper` of the installed COLMAP, and
by the incremental and the global mapper of pycolmap, with default options except those that the
command sets for forward motion. Folder 0 is measured, because that is what users open, even if it
is not the largest model. Camera centres are compared with the ground truth, or with pycolmap's
model of the same frames from sequentially matched SIFT.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import clips as ruler
import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap
import render
from numpy.typing import NDArray
from results import add_results, read_rows, save
from rich.console import Console

from colmap_av1 import CameraOptions, ColmapAv1Error, ImageOptions, MatchOptions, match
from colmap_av1.evaluate import (
    model_figures,
    model_poses,
    pose_errors,
    prepare_footage,
    read_sequence,
    run_frontend,
    run_measured,
)
from colmap_av1.geometry.colmap_model import read_model

SIFT = "SIFT, pycolmap's incremental mapper"
PRINTED = "match, the command that it prints"
SEQUENCES = [*(case.name for case in ruler.CASES if case.name != "scene"), "drone_park"]
SEED = 0


@dataclass(frozen=True)
class Row:
    """Result of a mapper on a database.

    Attributes:
        sequence: name of the clip.
        way: features and mapper.
        images: number of images of the database.
        models: number of models that the mapper wrote.
        registered: number of registered images in folder 0.
        points: number of points in folder 0.
        error_px: its mean reprojection error in pixels.
        ate_of_extent: error of its camera centres, as a share of the extent of the true ones.
        database_cpu_s: CPU seconds of features and matches, including conversion.
        mapper_cpu_s: CPU seconds of the mapper.
    """

    sequence: str
    way: str
    images: int
    models: int
    registered: int
    points: int | None
    error_px: float | None
    ate_of_extent: float | None
    database_cpu_s: float
    mapper_cpu_s: float


def main() -> int:
    """Map each clip in every way, and save and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cache", type=Path, required=True, help="folder for databases and models")
    parser.add_argument("--sequences", nargs="+", choices=SEQUENCES, default=SEQUENCES)
    add_results(parser, "stock_mappers")
    arguments = parser.parse_args()
    console = Console(stderr=True)
    for name in arguments.sequences:
        try:
            rows = measure(name, arguments.cache.resolve() / name, console)
        except ColmapAv1Error as error:
            console.print(f"error: {name}: {error}", markup=False)
            continue
        save(arguments.results, [asdict(row) for row in rows], ("sequence", "way"))
    print(render.stock_mappers(read_rows(arguments.results)), end="")
    return 0


def measure(name: str, folder: Path, console: Console) -> list[Row]:
    """The rows of a sequence: SIFT, and each mapper on the database of `match`."""
    case = next((case for case in ruler.CASES if case.name == name), ruler.Case(name))
    sequence = read_sequence(ruler.SEQUENCES / name)
    camera = CameraOptions() if sequence.camera is None else ruler.camera_options(sequence.camera)
    video = ruler.as_shot(sequence, folder / "source")
    footage = prepare_footage(
        video,
        folder / "footage",
        num_frames=sequence.num_frames,
        image_step=case.image_step,
        camera=camera,
    )
    console.print(f"{name}: SIFT", markup=False)
    sift = run_frontend("sift-sequential", footage, folder / "sift")
    made = folder / "models"
    shutil.rmtree(made, ignore_errors=True)
    made.mkdir()
    log = folder / "log.txt"
    given = (sift.database, footage.image_path, made / "sift", case.forward_motion)
    mapped = run_measured(map_incrementally, *given, log=log)
    poses = sequence.cam_from_world
    if poses is None:
        poses = model_poses(read_model(made / "sift" / "0"), sequence.num_frames)
    images = len(footage.names)
    cpu = (sift.cpu_seconds or 0.0, mapped.cpu_seconds)
    rows = [row_of((name, SIFT), images, made / "sift", poses, cpu)]

    console.print(f"{name}: match", markup=False)
    database, pictures = folder / "ours" / "a.db", folder / "ours" / "images"
    shutil.rmtree(database.parent, ignore_errors=True)
    database.parent.mkdir()
    options = MatchOptions(camera=camera, images=ImageOptions(every=case.image_step))
    matched = run_measured(run_match, video, database, pictures, options, log=log)
    images, command = matched.result
    # The printed command runs on the database itself; pycolmap's mappers get migrated copies.
    console.print(f"{name}: {PRINTED}", markup=False)
    mapped = run_measured(run_command, command, log=log)
    cpu = (matched.cpu_seconds, mapped.cpu_seconds)
    rows.append(row_of((name, PRINTED), images, database.with_name("a_model"), poses, cpu))
    for way, mapper in MAPPERS.items():
        console.print(f"{name}: {way}", markup=False)
        copy, output = folder / "mapped.db", made / mapper.__name__
        shutil.copyfile(database, copy)
        given = (copy, pictures, output, "--Mapper.init_max_forward_motion" in command)
        mapped = run_measured(mapper, *given, log=log)
        cpu = (matched.cpu_seconds, mapped.cpu_seconds)
        rows.append(row_of((name, way), images, output, poses, cpu))
    return rows


def run_match(
    video: Path, database: Path, pictures: Path, options: MatchOptions
) -> tuple[int, str]:
    """Number of images of a new database, and the command for COLMAP that `match` prints."""
    report = match(database, video, image_path=pictures, options=options)
    return report.num_images, report.next_commands[0]


def run_command(words: str) -> None:
    """Run a command line in a shell."""
    subprocess.run(words, shell=True, check=True)


def map_incrementally(database: Path, pictures: Path, output: Path, forward: bool) -> None:
    """Run pycolmap's incremental mapper with the options that `match` prints."""
    output.mkdir()
    pycolmap.set_random_seed(SEED)
    how = pycolmap.IncrementalPipelineOptions(random_seed=SEED)
    if forward:
        how.mapper.init_max_forward_motion = 1.0
        how.ba_refine_focal_length = False
        how.ba_refine_extra_params = False
    pycolmap.incremental_mapping(database, pictures, output, options=how)


def map_globally(database: Path, pictures: Path, output: Path, forward: bool) -> None:
    """Run pycolmap's global mapper."""
    output.mkdir()
    pycolmap.set_random_seed(SEED)
    how = pycolmap.GlobalPipelineOptions(random_seed=SEED)
    if forward:
        how.mapper.bundle_adjustment.refine_focal_length = False
        how.mapper.bundle_adjustment.refine_extra_params = False
    pycolmap.global_mapping(database, pictures, output, options=how)


MAPPERS = {
    "match, pycolmap's incremental mapper": map_incrementally,
    "match, pycolmap's global mapper": map_globally,
}


def row_of(
    key: tuple[str, str],
    images: int,
    output: Path,
    poses: NDArray[np.float64],
    cpu: tuple[float, float],
) -> Row:
    """The row of the models in a folder."""
    models = [folder for folder in output.iterdir() if (folder / "images.bin").is_file()]
    row = Row(*key, images, len(models), 0, None, None, None, *cpu)
    if output / "0" not in models:
        return row
    model = read_model(output / "0")
    about = model_figures(model)
    errors = pose_errors(model_poses(model, len(poses)), poses)
    return replace(
        row,
        registered=about.num_registered,
        points=about.num_points,
        error_px=about.mean_error,
        ate_of_extent=None if errors is None else errors.ate / errors.extent,
    )


if __name__ == "__main__":
    sys.exit(main())

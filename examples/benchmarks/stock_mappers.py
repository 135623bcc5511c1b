"""Measure what COLMAP's mappers, as they are, make of the database of `match`.

python examples/benchmarks/stock_mappers.py --cache benchmark_mappers

`match` gets each clip as it was shot and runs with its defaults; intrinsics are given where they
are known. Its database is mapped by the command that it prints, which is `colmap mapper` of the
COLMAP that is installed, and by the incremental and the global mapper of pycolmap, with their
defaults but for what that command says of forward motion. Folder 0 is what users open, whether it
is the largest model or not. Camera centres are compared with the true ones, or with those of the
model that pycolmap makes of the same frames from SIFT, matched sequentially.
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
    """What a mapper made of a database.

    Attributes:
        sequence: name of the clip.
        way: features and mapper.
        images: of the database.
        models: that the mapper wrote.
        registered: images with a pose in folder 0.
        points: of folder 0.
        error_px: its mean reprojection error in pixels.
        ate_of_extent: error of its camera centres, as a share of the extent of the true ones.
        database_cpu_s: CPU seconds of the features and matches, conversion included.
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
    """Map each clip every way, and keep and print the table."""
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
    """The rows of a sequence: SIFT's, and one for each mapper on the database of `match`."""
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
    # As it is printed, on the database itself: that of pycolmap's mappers is brought to its layout.
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
    """The number of images of a new database, and the command for COLMAP that `match` prints."""
    report = match(database, video, image_path=pictures, options=options)
    return report.num_images, report.next_commands[0]


def run_command(words: str) -> None:
    """A command line, in a shell."""
    subprocess.run(words, shell=True, check=True)


def map_incrementally(database: Path, pictures: Path, output: Path, forward: bool) -> None:
    """The incremental mapper of pycolmap; where motion is forward as `match` prints for it."""
    output.mkdir()
    pycolmap.set_random_seed(SEED)
    how = pycolmap.IncrementalPipelineOptions(random_seed=SEED)
    if forward:
        how.mapper.init_max_forward_motion = 1.0
        how.ba_refine_focal_length = False
        how.ba_refine_extra_params = False
    pycolmap.incremental_mapping(database, pictures, output, options=how)


def map_globally(database: Path, pictures: Path, output: Path, forward: bool) -> None:
    """The global mapper of pycolmap."""
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

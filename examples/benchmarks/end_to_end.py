"""Measure the ways from an AV1 video to a database and to a dense model, compared with SIFT.

python examples/benchmarks/end_to_end.py --cache benchmark_end_to_end

For each sequence and round: `reconstruct` creates the folder for trainers from the AV1 stream;
pycolmap extracts SIFT features, matches sequentially and maps the same frames; `match` fills a
database with the default preset, which the same mapper maps; `densify` triangulates tracks on the
poses of SIFT's model. Every step runs in a separate process. The table has medians over the rounds,
and their ratios to SIFT. Poses are compared with the ground truth if known, else with the model
from SIFT with exhaustive matching.
"""

from __future__ import annotations

import argparse
import shutil
import statistics
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np  # noqa: F401 - before pycolmap: the other order breaks writing PNG files later
import render
from clips import (
    CASES,
    Case,
    Material,
    Truth,
    footage_of,
    known_truth,
    mapper_options,
    material_of,
    reference_model,
    with_reference,
)
from results import Value, add_results, read_rows, save
from rich.console import Console
from sequences import measure_frontend, model_poses

from colmap_av1 import (
    ColmapAv1Error,
    DensifyOptions,
    ImageOptions,
    MatchOptions,
    ReconstructOptions,
    densify,
    reconstruct,
)
from colmap_av1.evaluate import (
    Footage,
    FrontendRun,
    MapperRun,
    Measured,
    measure_mapper,
    model_figures,
    pose_errors,
    run_measured,
)
from colmap_av1.geometry.colmap_model import read_model
from colmap_av1.options import TriangulateOptions

# Only points with accurate depth, for a fair comparison of numbers of points.
SURVEY = TriangulateOptions(points="survey")
# The steps, in the order of the table.
WAYS = (
    render.SIFT_DATABASE,
    render.SIFT_MAPPER,
    render.SIFT_MODEL,
    *render.COMPARED_WITH,
)


@dataclass(frozen=True)
class Step:
    """Cost of a step: wall and CPU seconds, peak memory in bytes."""

    seconds: float
    cpu_seconds: float
    peak_memory: int

    def __add__(self, other: Step) -> Step:
        """The cost of both steps, one after the other."""
        return Step(
            self.seconds + other.seconds,
            self.cpu_seconds + other.cpu_seconds,
            max(self.peak_memory, other.peak_memory),
        )


@dataclass(frozen=True)
class Figures:
    """Cost of one way in one round and, if it gives a model, figures of the model."""

    seconds: float
    cpu_seconds: float
    peak_memory: int
    num_images: int | None = None
    num_points: int | None = None
    error: float | None = None
    ate: float | None = None


def main() -> int:
    """Measure all ways on every sequence and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cache", type=Path, required=True, help="folder for videos and results")
    parser.add_argument(
        "--sequences",
        nargs="+",
        choices=[case.name for case in CASES],
        default=[case.name for case in CASES if case.name != "scene"],
    )
    parser.add_argument("--rounds", type=int, default=3)
    add_results(parser, "end_to_end")
    arguments = parser.parse_args()
    console = Console(stderr=True)
    for case in CASES:
        if case.name not in arguments.sequences:
            continue
        folder = arguments.cache.resolve() / case.name
        try:
            measured = measure_case(case, folder, arguments.rounds, console)
        except ColmapAv1Error as error:
            console.print(f"error: {case.name}: {error}", markup=False)
            continue
        save(arguments.results, medians(case.name, measured), ("sequence", "way"))
    rows = read_rows(arguments.results)
    print(render.end_to_end([r for r in rows if r["sequence"] in arguments.sequences]), end="")
    return 0


def measure_case(
    case: Case, folder: Path, rounds: int, console: Console
) -> dict[str, list[Figures]]:
    """Figures of each way in each round."""
    material = material_of(case, folder, console)
    footage = footage_of(case, material, folder)
    settings = mapper_options(case, material)
    truth = known_truth(material)
    if truth.poses is None:
        model = reference_model(footage, folder, settings, console)
        truth = with_reference(truth, model, material.num_frames)
    measured: dict[str, list[Figures]] = {way: [] for way in WAYS}
    for number in range(rounds):
        console.print(f"{case.name}: round {number + 1} of {rounds}", markup=False)
        where = folder / "round"
        shutil.rmtree(where, ignore_errors=True)
        where.mkdir()
        log = where / "log.txt"

        def add(way: str, step: Step, model: Path | None = None) -> None:
            measured[way].append(figures(step, model, material, truth))

        made = step_of(run_measured(run_reconstruct, footage, case, where / "dense", log=log))
        add("reconstruct: dense model", made, where / "dense" / "sparse" / "0")
        sift = step_of_frontend(measure_frontend("sift-sequential", footage, where / "sift"))
        mapped = measure_mapper(
            where / "sift" / "database.db", footage.image_path, where / "sift-model", settings
        )
        ours = step_of_frontend(measure_frontend("av1", footage, where / "match"))
        our_model = measure_mapper(
            where / "match" / "database.db", footage.image_path, where / "match-model", settings
        )
        add(render.SIFT_DATABASE, sift)
        add("match: database", ours)
        add("match: mapper", step_of(our_model), our_model.model)
        add(render.SIFT_MAPPER, step_of(mapped), mapped.model)
        add(render.SIFT_MODEL, sift + step_of(mapped), mapped.model)
        if mapped.model is not None:
            onto = run_measured(run_densify, mapped.model, footage, case, where / "onto", log=log)
            add("densify on SIFT's model", step_of(onto), where / "onto")
    return measured


def step_of(run: Measured[Any] | MapperRun) -> Step:
    """Cost of a measured process."""
    return Step(run.seconds, run.cpu_seconds, run.peak_memory or 0)


def step_of_frontend(run: FrontendRun) -> Step:
    """Cost of a front-end, whose process runs only its stages."""
    return Step(sum(run.seconds.values()), run.cpu_seconds, run.peak_memory or 0)


def run_reconstruct(footage: Footage, case: Case, output: Path) -> None:
    """Reconstruct a dense model from the stream, like the command."""
    options = MatchOptions(camera=footage.camera, images=ImageOptions(every=case.image_step))
    reconstruct(
        footage.video, output, options=ReconstructOptions(match=options, triangulate=SURVEY)
    )


def run_densify(model: Path, footage: Footage, case: Case, output: Path) -> None:
    """Triangulate all tracks on the poses of a model."""
    options = MatchOptions(images=ImageOptions(first_number=0))
    densify(model, footage.video, output, options=DensifyOptions(match=options, triangulate=SURVEY))


def figures(step: Step, model: Path | None, material: Material, truth: Truth) -> Figures:
    """Cost of a way and figures of its model."""
    taken = (step.seconds, step.cpu_seconds, step.peak_memory)
    if model is None:
        return Figures(*taken)
    reconstruction = read_model(model)
    about = model_figures(reconstruction)
    errors = None
    if truth.poses is not None:
        errors = pose_errors(model_poses(reconstruction, material.num_frames), truth.poses)
    return Figures(
        *taken,
        num_images=about.num_registered,
        num_points=about.num_points,
        error=about.mean_error,
        ate=errors.ate if errors is not None else None,
    )


def medians(name: str, measured: dict[str, list[Figures]]) -> list[dict[str, Value]]:
    """Medians over the rounds, one row for each way."""

    def median(values: list[float | None]) -> float | None:
        known = [value for value in values if value is not None]
        return statistics.median(known) if known and len(known) == len(values) else None

    columns = {
        "images": "num_images",
        "points": "num_points",
        "error_px": "error",
        "ate": "ate",
        "seconds": "seconds",
        "cpu_s": "cpu_seconds",
    }
    rows = []
    for way, runs in measured.items():
        if runs:
            row: dict[str, Value] = {"sequence": name, "way": way}
            for column, field in columns.items():
                row[column] = median([getattr(run, field) for run in runs])
            row["peak_memory_mb"] = statistics.median(run.peak_memory for run in runs) / 1e6
            rows.append(row)
    return rows


if __name__ == "__main__":
    sys.exit(main())

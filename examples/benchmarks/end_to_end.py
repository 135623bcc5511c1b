"""Time the ways from a video to a database and to a dense model beside SIFT's.

python examples/benchmarks/end_to_end.py --cache benchmark_end_to_end

In turn, for each sequence and round: `reconstruct` makes the folder that trainers open from the
AV1 stream; pycolmap extracts SIFT, matches sequentially and maps the same frames; `match` fills a
database with the default preset and the same mapper maps that; `densify` puts the tracks on the
poses of SIFT's model. Every step has a process of its own; medians over the rounds, and what they
are of SIFT's. Poses are judged against the truth, where none is known against SIFT's exhaustive
model.
"""

from __future__ import annotations

import argparse
import shutil
import statistics
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np  # noqa: F401 - before pycolmap: the other order breaks writing PNG files later
from rich.console import Console
from tracks import (
    CASES,
    Case,
    Material,
    Truth,
    known_truth,
    markdown,
    real_sequence,
    reference_model,
    rendered_clip,
    with_reference,
)

from colmap_av1 import (
    CameraOptions,
    ColmapAv1Error,
    DensifyOptions,
    ImageOptions,
    MapOptions,
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
    model_poses,
    pose_errors,
    prepare_footage,
    run_frontend,
    run_measured,
)
from colmap_av1.model.colmap_model import read_model

# The ways, and the one that each is compared with.
SIFT_DATABASE, SIFT_MAPPER = "SIFT sequential: database", "SIFT sequential: mapper"
SIFT_MODEL = "SIFT sequential: model"
WAYS = {
    SIFT_DATABASE: None,
    SIFT_MAPPER: None,
    SIFT_MODEL: None,
    "match: database": SIFT_DATABASE,
    "match: mapper": SIFT_MAPPER,
    "reconstruct: dense model": SIFT_MODEL,
    "densify on SIFT's model": SIFT_MODEL,
}


@dataclass(frozen=True)
class Step:
    """What a step took: wall and CPU seconds, peak memory in bytes."""

    seconds: float
    cpu_seconds: float
    peak_memory: int

    def __add__(self, other: Step) -> Step:
        """This step and then another one."""
        return Step(
            self.seconds + other.seconds,
            self.cpu_seconds + other.cpu_seconds,
            max(self.peak_memory, other.peak_memory),
        )


@dataclass(frozen=True)
class Figures:
    """What one way took in one round and, where it ends with a model, what came out."""

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
        default=["street", "shelfbox", "log_building", "kitchen"],
    )
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    console = Console(stderr=True)
    rows = []
    for case in CASES:
        if case.name not in arguments.sequences:
            continue
        folder = arguments.cache.resolve() / case.name
        folder.mkdir(parents=True, exist_ok=True)
        try:
            measured = measure_case(case, folder, arguments.rounds, console)
        except ColmapAv1Error as error:
            console.print(f"error: {case.name}: {error}", markup=False)
            continue
        rows += table_rows(case.name, measured)
    header = ["sequence, way", "images", "points", "error px", "ATE", "seconds", "CPU seconds"]
    print(markdown([*header, "peak memory"], rows), end="")
    return 0


def measure_case(
    case: Case, folder: Path, rounds: int, console: Console
) -> dict[str, list[Figures]]:
    """Figures of each way in each round."""
    material = rendered_clip() if case.name == "scene" else real_sequence(case, folder, console)
    camera = CameraOptions()
    if material.camera is not None:
        params = ",".join(map(str, material.camera.params))
        camera = CameraOptions(camera_model=material.camera.model.name, camera_params=params)
    footage = prepare_footage(
        material.video,
        folder / "footage",
        num_frames=material.num_frames,
        image_step=case.image_step,
        camera=camera,
    )
    settings = MapOptions(
        refine_intrinsics=material.camera is None, forward_motion=case.forward_motion
    )
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
        sift = step_of_frontend(run_frontend("sift-sequential", footage, where / "sift"))
        mapped = measure_mapper(
            where / "sift" / "database.db", footage.image_path, where / "sift-model", settings
        )
        ours = step_of_frontend(run_frontend("av1", footage, where / "match"))
        our_model = measure_mapper(
            where / "match" / "database.db", footage.image_path, where / "match-model", settings
        )
        add(SIFT_DATABASE, sift)
        add("match: database", ours)
        add("match: mapper", step_of(our_model), our_model.model)
        add(SIFT_MAPPER, step_of(mapped), mapped.model)
        add(SIFT_MODEL, sift + step_of(mapped), mapped.model)
        if mapped.model is not None:
            onto = run_measured(run_densify, mapped.model, footage, case, where / "onto", log=log)
            add("densify on SIFT's model", step_of(onto), where / "onto")
    return measured


def step_of(run: Measured | MapperRun) -> Step:
    """What a process took."""
    return Step(run.seconds, run.cpu_seconds, run.peak_memory or 0)


def step_of_frontend(run: FrontendRun) -> Step:
    """What a front-end took; its process does nothing but its stages."""
    return Step(sum(run.seconds.values()), run.cpu_seconds, run.peak_memory or 0)


def run_reconstruct(footage: Footage, case: Case, output: Path) -> None:
    """The whole way from the stream, as the command line goes it."""
    options = MatchOptions(camera=footage.camera, images=ImageOptions(every=case.image_step))
    reconstruct(footage.video, output, options=ReconstructOptions(match=options))


def run_densify(model: Path, footage: Footage, case: Case, output: Path) -> None:
    """Tracks on the poses of a model."""
    options = MatchOptions(images=ImageOptions(first_number=0))
    densify(model, footage.video, output, options=DensifyOptions(match=options))


def figures(step: Step, model: Path | None, material: Material, truth: Truth) -> Figures:
    """What a way took, and what its model is worth."""
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


def table_rows(name: str, measured: dict[str, list[Figures]]) -> list[list[str]]:
    """Medians over the rounds, and their ratio to SIFT's."""

    def median(way: str, field: str) -> float | None:
        values = [getattr(figures, field) for figures in measured[way]]
        return None if not values or None in values else statistics.median(values)

    def cell(way: str, field: str, spell: str) -> str:
        value, other = median(way, field), WAYS[way]
        if value is None:
            return "-"
        base = median(other, field) if other is not None else None
        return f"{value:{spell}} ({value / base:.2f}x)" if base else f"{value:{spell}}"

    columns = (
        *(("num_images", ".0f"), ("num_points", ",.0f"), ("error", ".3f")),
        *(("ate", ".4f"), ("seconds", ".1f"), ("cpu_seconds", ".1f")),
    )
    rows = []
    for way, values in measured.items():
        if values:
            row = [f"{name}, {way}", *(cell(way, *column) for column in columns)]
            rows.append([*row, f"{median(way, 'peak_memory') / 1e6:.0f} MB"])
    return rows


if __name__ == "__main__":
    sys.exit(main())

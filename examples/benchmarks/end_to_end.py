"""Time the way from a video to a dense model beside SIFT's way to its sparse one.

python examples/benchmarks/end_to_end.py --cache benchmark_end_to_end

In turn, for each sequence and round: `reconstruct` makes the folder that trainers open from the
AV1 stream; pycolmap extracts SIFT, matches sequentially and maps the same frames; `densify` puts
the tracks on the poses of that model. Every step has a process of its own; medians over the rounds.
Poses are judged against the truth, where none is known against SIFT's exhaustive model.
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
    MatchOptions,
    ReconstructOptions,
    densify,
    reconstruct,
)
from colmap_av1.evaluate import (
    Footage,
    MapperSettings,
    map_database,
    model_figures,
    model_poses,
    pose_errors,
    prepare_footage,
    run_frontend,
)
from colmap_av1.evaluate.measure import run_measured
from colmap_av1.model import read_model


@dataclass(frozen=True)
class Figures:
    """What one way took in one round and what came out."""

    seconds: float
    cpu_seconds: float
    peak_memory: int
    num_images: int
    num_points: int
    error: float
    ate: float | None


def main() -> int:
    """Measure both ways on every sequence and print the table."""
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
    settings = MapperSettings(
        fixed_intrinsics=material.camera is not None, forward_motion=case.forward_motion
    )
    truth = known_truth(material)
    if truth.poses is None:
        model = reference_model(footage, folder, settings, console)
        truth = with_reference(truth, model, material.num_frames)
    measured: dict[str, list[Figures]] = {"reconstruct": [], "SIFT sequential": [], "densify": []}
    for number in range(rounds):
        console.print(f"{case.name}: round {number + 1} of {rounds}", markup=False)
        where = folder / "round"
        shutil.rmtree(where, ignore_errors=True)
        where.mkdir()
        made = run_measured(
            run_reconstruct, footage, case, where / "dense", log=where / "reconstruct.log"
        )
        model = where / "dense" / "sparse" / "0"
        measured["reconstruct"].append(figures([made], model, material, truth))
        sift = run_frontend("sift-sequential", footage, where / "sift")
        mapper = map_database(sift.database, footage.image_path, where / "sift-model", settings)
        if mapper.model is None:
            console.print(f"{case.name}: SIFT gives no model", markup=False)
            continue
        # What the front-end tells is of its stages; its process does nothing else.
        both = [(sum(sift.seconds.values()), sift.cpu_seconds, sift.peak_memory)]
        both.append((mapper.seconds, mapper.cpu_seconds, mapper.peak_memory))
        measured["SIFT sequential"].append(figures(both, mapper.model, material, truth))
        onto = run_measured(
            run_densify, mapper.model, footage, case, where / "onto", log=where / "densify.log"
        )
        measured["densify"].append(figures([onto], where / "onto", material, truth))
    return measured


def run_reconstruct(footage: Footage, case: Case, output: Path) -> None:
    """The whole way from the stream, as the command line goes it."""
    options = MatchOptions(camera=footage.camera, images=ImageOptions(every=case.image_step))
    reconstruct(footage.video, output, options=ReconstructOptions(match=options))


def run_densify(model: Path, footage: Footage, case: Case, output: Path) -> None:
    """Tracks on the poses of a model."""
    options = MatchOptions(images=ImageOptions(first_number=0))
    densify(model, footage.video, output, options=DensifyOptions(match=options))


def figures(steps: list, model: Path, material: Material, truth: Truth) -> Figures:
    """Sums over the steps of (seconds, CPU seconds, peak memory), and what the model is worth."""
    taken = [
        s if isinstance(s, tuple) else (s.seconds, s.cpu_seconds, s.peak_memory) for s in steps
    ]
    reconstruction = read_model(model)
    about = model_figures(reconstruction)
    errors = None
    if truth.poses is not None:
        errors = pose_errors(model_poses(reconstruction, material.num_frames), truth.poses)
    return Figures(
        seconds=sum(step[0] for step in taken),
        cpu_seconds=sum(step[1] for step in taken),
        peak_memory=max(step[2] or 0 for step in taken),
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

    def cell(way: str, field: str, spell: str, scale: float = 1.0) -> str:
        value, base = median(way, field), median("SIFT sequential", field)
        if value is None:
            return "-"
        ratio = f" ({value / base:.2f}x)" if base and way != "SIFT sequential" else ""
        return f"{value * scale:{spell}}{ratio}"

    columns = (
        *(("num_images", ".0f", 1.0), ("num_points", ",.0f", 1.0), ("error", ".3f", 1.0)),
        *(("ate", ".4f", 1.0), ("seconds", ".1f", 1.0), ("cpu_seconds", ".1f", 1.0)),
    )
    rows = []
    for way, values in measured.items():
        if values:
            row = [f"{name}, {way}", *(cell(way, *column) for column in columns)]
            rows.append([*row, f"{median(way, 'peak_memory') / 1e6:.0f} MB"])
    return rows


if __name__ == "__main__":
    sys.exit(main())

"""Measure whether `reconstruct` joins videos of the same scene in one model, and only these.

python examples/benchmarks/one_model.py --cache benchmark_one_model

Cases: `cut video`, log_building's frames 60 to 84 and then 0 to 29 and 46 to 59; `two halves`, its
frames 0 to 42 and 43 to 84 as two videos; `two scenes`, ditch and log_building; `fast drone`, all
of drone_park; `long walk`, all of kitchen_long, which returns to its start. Camera centres of each
model are compared with those of SIFT's model of the whole sequence, and the long-range epipolar
error is measured by an external tool.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import clips as ruler
import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import render
from jerks import Whole, whole_sequence, write_clip
from numpy.typing import NDArray
from results import add_results, read_rows, save
from rich.console import Console
from sequences import read_sequence

from colmap_av1 import ColmapAv1Error, ReconstructOptions, ReconstructReport, reconstruct
from colmap_av1.evaluate import pose_errors, run_measured
from colmap_av1.evaluate.metrics.poses import frame_number
from colmap_av1.geometry.colmap_model import posed_images, read_model


@dataclass(frozen=True)
class Clip:
    """Frames of a sequence as a video; None: the complete video of the sequence."""

    sequence: str
    frames: tuple[int, ...] | None = None


# The videos of each case.
CASES = {
    "cut video": [Clip("log_building", (*range(60, 85), *range(30), *range(46, 60)))],
    "two halves": [
        Clip("log_building", tuple(range(43))),
        Clip("log_building", tuple(range(43, 85))),
    ],
    "two scenes": [Clip("ditch"), Clip("log_building")],
    "fast drone": [Clip("drone_park")],
    "long walk": [Clip("kitchen_long")],
}
# Smallest number of images between compared images. In the long walk, no track is that long.
APART = {"long walk": 74}


@dataclass(frozen=True)
class Row:
    """Result of a case.

    Attributes:
        case: name of the case.
        images: number of chosen images.
        registered: number of registered images of each model.
        centres_off: largest error of a model's camera centres, as a share of their extent in SIFT's
            model; None if a model has images of two scenes, or without SIFT's model.
        long_range: median long-range epipolar error in pixels.
        long_range_90: its 90th percentile.
        revisits: number of loop closures.
        between: number of SIFT links between videos.
        links_cpu_s: CPU seconds of SIFT links and loop closures.
        cpu_s: total CPU seconds.
        warnings: warnings about disconnected images.
    """

    case: str
    images: int
    registered: str
    centres_off: float | None
    long_range: float | None
    long_range_90: float | None
    revisits: int
    between: int
    links_cpu_s: float
    cpu_s: float
    warnings: str


def main() -> int:
    """Measure the cases, and save and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cache", type=Path, required=True, help="folder for videos and models")
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    add_results(parser, "one_model")
    arguments = parser.parse_args()
    console = Console(stderr=True)
    cache = arguments.cache.resolve()
    for case in arguments.cases:
        try:
            row = measure(case, cache, console)
        except ColmapAv1Error as error:
            console.print(f"error: {case}: {error}", markup=False)
            continue
        save(arguments.results, [asdict(row)], ("case",))
    print(render.one_model(read_rows(arguments.results)), end="")
    return 0


def measure(case: str, cache: Path, console: Console) -> Row:
    """The row of a case."""
    folder = cache / case.replace(" ", "_")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    names = dict.fromkeys(clip.sequence for clip in CASES[case])
    held_to_sift = case not in APART
    wholes = {n: whole_sequence(n, cache / n, console) for n in names} if held_to_sift else {}
    videos = [
        video_of(clip, wholes.get(clip.sequence), folder / f"{clip.sequence}_{number}.mp4")
        for number, clip in enumerate(CASES[case])
    ]
    console.print(f"{case}: reconstruct", markup=False)
    run = run_measured(run_reconstruct, videos, folder / "made", log=folder / "log")
    report: ReconstructReport = run.result
    outputs = [folder / "made", *(model.output for model in report.other_models)]
    models = [read_model(output / "sparse" / "0") for output in outputs]
    off = [centres_off(model, CASES[case], wholes) for model in models] if wholes else [None]
    return Row(
        case=case,
        images=report.num_images,
        registered=" and ".join(str(model.num_reg_images()) for model in models),
        centres_off=None if None in off else max(value for value in off if value is not None),
        **long_range(outputs[0], APART.get(case, ruler.FAR)),
        revisits=report.links.num_loop_closures,
        between=report.links.num_between,
        links_cpu_s=report.cpu_seconds.get("links", 0.0),
        cpu_s=run.cpu_seconds,
        warnings="; ".join(report.warnings),
    )


def video_of(clip: Clip, whole: Whole | None, path: Path) -> Path:
    """The video of a clip, under a unique name."""
    if clip.frames is None:
        return Path(shutil.copyfile(read_sequence(ruler.SEQUENCES / clip.sequence).source, path))
    assert whole is not None
    write_clip(path, [whole.pictures[frame] for frame in clip.frames])
    return path


def run_reconstruct(videos: Sequence[Path], output: Path) -> ReconstructReport:
    """Reconstruct with default options, like the command."""
    return reconstruct(list(videos), output, options=ReconstructOptions())


def centres_off(model: Any, clips: Sequence[Clip], wholes: dict[str, Whole]) -> float | None:
    """Error of a model's centres against SIFT's, relative to their extent; None for two scenes."""
    found: list[NDArray[np.float64]] = []
    wanted: list[NDArray[np.float64]] = []
    scenes = set()
    for name, image in posed_images(model).items():
        # Images of several videos are in folders named like the videos, here by their numbers.
        number = int(Path(name).parent.name.rpartition("_")[2]) if len(clips) > 1 else 0
        clip, frame = clips[number], frame_number(name)
        scenes.add(clip.sequence)
        found.append(image.cam_from_world)
        kept = frame if clip.frames is None else clip.frames[frame]
        wanted.append(wholes[clip.sequence].poses[kept])
    errors = pose_errors(np.array(found), np.array(wanted)) if len(scenes) == 1 else None
    return None if errors is None else errors.ate / errors.extent


def long_range(output: Path, apart: int) -> dict[str, float | None]:
    """Long-range epipolar error of images at least `apart` images apart: columns of the row."""
    found = ruler.long_range(output / "sparse" / "0", output / "images", apart)
    return {name: found.get(name) for name in ("long_range", "long_range_90")}


if __name__ == "__main__":
    sys.exit(main())

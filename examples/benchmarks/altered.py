"""Measure models of clips that were scaled, cropped, darkened, compressed or shortened.

python examples/benchmarks/altered.py --cache benchmark_altered

ffmpeg alters each clip in several ways that are common in clips of users. From each altered clip,
`reconstruct` makes a model of up to 50 images, and `match` fills a database with the same number,
which pycolmap's incremental mapper maps with the options of the printed command. Intrinsics are not
given. Model 0 is measured, because it is the one that users open.
"""

from __future__ import annotations

import shutil
import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import clips as ruler
import numpy as np  # noqa: F401 - before pycolmap: the other order breaks writing PNG files later
import render
from mapping import map_incrementally
from phone_to_folder import Clip, clip_of, figures_of
from results import add_results, clips_parser, read_rows, save
from rich.console import Console

from colmap_av1 import (
    ColmapAv1Error,
    ImageOptions,
    MatchOptions,
    ReconstructOptions,
    match,
    reconstruct,
)
from colmap_av1.evaluate import run_measured
from colmap_av1.util.digests import file_digest
from colmap_av1.util.stages import run_stage_in

IMAGES = ImageOptions(num_images=50)


@dataclass(frozen=True)
class Alteration:
    """How ffmpeg alters a clip.

    Attributes:
        filters: ffmpeg's video filters.
        crf: constant rate factor of the H.264 encoder.
        first: number of the first frame that is kept.
        stop: number of the frame after the last one; None: up to the end.
        step: number of frames of which one is kept.
    """

    filters: str = "null"
    crf: int = 18
    first: int = 0
    stop: int | None = None
    step: int = 1


# Dark pictures have 30 % of the brightness and noise with a standard deviation of 3.6 grey levels.
ALTERATIONS = {
    "none": None,
    "half size": Alteration("scale=trunc(iw/4)*2:-2"),
    "crop": Alteration("crop=0.8*iw:0.8*ih:0:0"),
    "dark, noise": Alteration(
        "lutyuv=y=16+0.3*(val-16):u=128+0.3*(val-128):v=128+0.3*(val-128),noise=alls=6:allf=t"
    ),
    "every second frame": Alteration(step=2),
    "20 frames": Alteration(first=20, stop=40),
    "crf 36": Alteration(crf=36),
}


@dataclass(frozen=True)
class Row:
    """Model 0 of an altered clip by one way; fields of the model are None without one.

    Attributes:
        clip: name of the clip.
        alteration: one of `ALTERATIONS`.
        way: one of `RUNS`.
        cpu_s: CPU time from the file to the model.
        images: number of images.
        registered: number of registered images.
        points: number of 3D points.
        error_px: mean reprojection error.
        ate: error of camera centres, if true poses are known.
        ate_of_extent: the same as a share of their extent.
        warnings: warnings of the command, or its error.
    """

    clip: str
    alteration: str
    way: str
    cpu_s: float | None = None
    images: int | None = None
    registered: int | None = None
    points: int | None = None
    error_px: float | None = None
    ate: float | None = None
    ate_of_extent: float | None = None
    warnings: str = ""


def main() -> int:
    """Measure every clip with every alteration, and save and print the table."""
    clips = ["log_building", "ditch", "holiday_display", "shelfbox", "kitchen"]
    parser = clips_parser(__doc__, clips, "sequences of ../shared")
    parser.add_argument("--alterations", nargs="+", choices=ALTERATIONS, default=[*ALTERATIONS])
    add_results(parser, "altered")
    arguments = parser.parse_args()
    console = Console(stderr=True)
    for name in arguments.clips:
        folder = arguments.cache.resolve() / name
        original = clip_of(name, folder)
        for alteration in arguments.alterations:
            console.print(f"{name}: {alteration}", markup=False)
            own = folder / alteration.replace(", ", " ").replace(" ", "_")
            clip = altered(original, ALTERATIONS[alteration], own / "video")
            for way in RUNS:
                row = measure(clip, alteration, way, own)
                save(arguments.results, [asdict(row)], ("clip", "alteration", "way"))
    print(render.altered(read_rows(arguments.results)), end="")
    return 0


def altered(clip: Clip, alteration: Alteration | None, folder: Path) -> Clip:
    """The altered clip as H.264 in a folder, or the clip itself without an alteration."""
    if alteration is None:
        return clip
    video = folder / "video.mp4"
    first, stop, step = alteration.first, alteration.stop, alteration.step
    end = "" if stop is None else f":end_frame={stop}"
    trim = f"trim=start_frame={first}{end},setpts=PTS-STARTPTS"
    filters = f"{trim},framestep={step},{alteration.filters}"
    words = ("-vf", filters, "-c:v", "libx264", "-crf", str(alteration.crf))

    def make() -> None:
        ruler.ffmpeg("-i", str(clip.video), *words, "-pix_fmt", "yuv420p", str(video))

    given = [file_digest(clip.video), words]
    run_stage_in(folder, given, None, make, products=[video], made_by=())
    poses = None if clip.poses is None else clip.poses[first:stop:step]
    return replace(clip, video=video, poses=poses)


def measure(clip: Clip, alteration: str, way: str, folder: Path) -> Row:
    """Make the models of a clip in a folder by one way, and measure the first."""
    row = Row(clip.name, alteration, way)
    run, model = RUNS[way]
    output = folder / run.__name__
    shutil.rmtree(output, ignore_errors=True)
    folder.mkdir(parents=True, exist_ok=True)
    try:
        done = run_measured(run, clip.video, output, log=folder / "log")
    except ColmapAv1Error as error:
        return replace(row, warnings=str(error).replace(f"{folder}/", ""))
    num_images, warnings = done.result
    words = "; ".join(warnings).replace(f"{folder}/", "")
    row = replace(row, cpu_s=done.cpu_seconds, images=num_images, warnings=words)
    if not (output / model).is_dir():
        return row
    return replace(row, **figures_of(clip, output / model, None, num_images))


def run_reconstruct(video: Path, output: Path) -> tuple[int, tuple[str, ...]]:
    """Reconstruct: the number of images, and the warnings."""
    options = ReconstructOptions(match=MatchOptions(images=IMAGES))
    report = reconstruct(video, output, options=options)
    return report.num_images, report.warnings


def run_match(video: Path, output: Path) -> tuple[int, tuple[str, ...]]:
    """Fill a database and map it by the printed command: number of images, and warnings."""
    output.mkdir()
    database, images = output / "a.db", output / "images"
    options = MatchOptions(images=IMAGES)
    report = match(database, video, image_path=images, options=options)
    map_incrementally(database, images, output / "models", report.next_commands[0])
    return report.num_images, report.warnings


# How each way makes models, and where it writes the first.
RUNS = {
    render.FROM_FILE: (run_reconstruct, "sparse/0"),
    render.MATCH_PYCOLMAP: (run_match, "models/0"),
}

if __name__ == "__main__":
    sys.exit(main())

"""Measure the ways from the original video to a model, compared with SIFT.

python examples/benchmarks/phone_to_folder.py --cache benchmark_phone

For each clip, `reconstruct` creates a folder for trainers from the original file; the conversion is
measured separately. `match` fills a database from the same file with its defaults, which is mapped
by the printed `colmap mapper` command, with the installed COLMAP, and by pycolmap's incremental
mapper with the same options. Model 0 is measured even if it is not the largest, because it is the
one that users open. For comparison, ffmpeg writes the same images, and pycolmap extracts SIFT
features, matches them sequentially and maps them, with its defaults. Intrinsics are given if known.
Every step runs in a separate process. Results stay in the cache: an interrupted run resumes.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import clips as ruler
import numpy as np  # noqa: F401 - before pycolmap: the other order breaks writing PNG files later
import phone_clip
import pycolmap
import render
from mapping import map_incrementally
from results import add_results, clips_parser, read_rows, save
from rich.console import Console
from sequences import model_poses, read_sequence

from colmap_av1 import (
    CameraOptions,
    ColmapAv1Error,
    EncodeOptions,
    ImageOptions,
    MapOptions,
    MatchOptions,
    ReconstructOptions,
    map_database,
    match,
    reconstruct,
)
from colmap_av1.evaluate import (
    Footage,
    MapperRun,
    Measured,
    measure_mapper,
    model_figures,
    pose_errors,
    run_measured,
)
from colmap_av1.evaluate.frontends.frontend import list_images
from colmap_av1.geometry.colmap_model import read_model
from colmap_av1.util.digests import file_digest
from colmap_av1.util.stages import run_stage_in
from colmap_av1.video.coded_size import with_downscale
from colmap_av1.video.encode import stream_of
from colmap_av1.video.facts import read_video

RENDERED = re.compile(r"phone_(\d+)s")


@dataclass(frozen=True)
class Clip:
    """A video and its ground truth.

    Attributes:
        name: name of the clip.
        video: the original video.
        images: options for the frames that become images.
        camera: options for the true intrinsics if known, else default options.
        poses: [num_frames, 3, 4] true poses; None if unknown.
        forward_motion: whether the camera moves along its optical axis.
    """

    name: str
    video: Path
    images: ImageOptions
    camera: CameraOptions
    poses: ruler.Poses | None
    forward_motion: bool = False


@dataclass(frozen=True)
class Row:
    """Cost of one step, or of all steps of one way, on one clip, and figures of the model."""

    clip: str
    way: str
    cpu_s: float
    seconds: float
    memory_mb: float | None
    images: int | None = None
    registered: int | None = None
    points: int | None = None
    error_px: float | None = None
    ate: float | None = None
    ate_of_extent: float | None = None
    long_range: float | None = None
    long_range_90: float | None = None


# Options of images, for clips whose images `reconstruct` does not choose itself.
IMAGES = {"kitchen": ImageOptions(every=2), "kitchen_long": ImageOptions(num_images=322)}


def main() -> int:
    """Measure all ways on every clip, and save and print the table."""
    clips = ["log_building", "ditch", "holiday_display", "street", "phone_10s"]
    accepted = "sequences of ../shared, or phone_10s for a rendered clip of 10 seconds"
    parser = clips_parser(__doc__, clips, accepted)
    parser.add_argument(
        "--ours", action="store_true", help="measure only this package, and keep the rows of SIFT"
    )
    parser.add_argument(
        "--without_mapper",
        action="store_true",
        help="leave out `match`, and stop SIFT after matching, for clips whose mapping takes hours",
    )
    add_results(parser, "phone_to_folder")
    arguments = parser.parse_args()
    console = Console(stderr=True)
    for name in arguments.clips:
        folder = arguments.cache.resolve() / name
        try:
            clip = clip_of(name, folder)
            console.print(f"{name}: reconstruct", markup=False)
            rows, names = measure_ours(clip, folder / "reconstruct")
            if not arguments.without_mapper:
                console.print(f"{name}: match", markup=False)
                rows += measure_match(clip, folder / "match")
            if not arguments.ours:
                console.print(f"{name}: SIFT on {len(names)} images", markup=False)
                mapped = not arguments.without_mapper
                rows += measure_sift(clip, folder / "sift", names, mapped=mapped)
        except ColmapAv1Error as error:
            console.print(f"error: {name}: {error}", markup=False)
            continue
        save(arguments.results, [asdict(row) for row in rows], ("clip", "way"))
    rows_of_all = read_rows(arguments.results)
    print(render.phone_to_folder([r for r in rows_of_all if r["clip"] in arguments.clips]), end="")
    return 0


def clip_of(name: str, folder: Path) -> Clip:
    """A sequence of ../shared, or a rendered clip."""
    seconds = RENDERED.fullmatch(name)
    if seconds is not None:
        video = phone_clip.phone_clip(folder.parent / "clips", int(seconds[1]))
        poses = phone_clip.true_poses(int(seconds[1]) * phone_clip.FPS)
        return Clip(name, video, ImageOptions(), CameraOptions(), poses)
    sequence = read_sequence(ruler.SEQUENCES / name)
    case = next((case for case in ruler.CASES if case.name == name), None)
    return Clip(
        name,
        ruler.as_shot(sequence, folder / "source"),
        IMAGES.get(name, ImageOptions()),
        CameraOptions() if sequence.camera is None else ruler.camera_options(sequence.camera),
        sequence.cam_from_world,
        case is not None and case.forward_motion,
    )


def measure_ours(clip: Clip, folder: Path) -> tuple[list[Row], list[str]]:
    """Rows of the steps, the total and the stages of `reconstruct`, and names of its images."""
    converted, made, output = folder_of(clip, folder)
    rows = [row_of(clip, "conversion", converted)] if converted is not None else []
    rows.append(row_of(clip, "reconstruct from AV1", made))
    report = json.loads((output / "report.json").read_text())
    figures = figures_of(clip, output / "sparse" / "0", output / "images", report["num_images"])
    rows.append(replace(sum_of("reconstruct", rows), **figures))
    rows += [
        Row(clip.name, f"{render.STAGE}{stage}", cpu_s, report["seconds"][stage], None)
        for stage, cpu_s in report["cpu_seconds"].items()
    ]
    # Images that are not registered are not written; SIFT gets the written ones.
    return rows, sorted(path.name for path in (output / "images").iterdir())


def measure_match(clip: Clip, folder: Path) -> list[Row]:
    """Rows of `match`, of the mappers on its database, and of the totals."""
    database = folder / "database" / "a.db"
    images = database.parent / "images"
    log = folder / "log"

    def fill() -> dict[str, Any]:
        options = MatchOptions(images=clip.images, camera=clip.camera)
        run = run_measured(run_match, clip.video, database, images, options, log=log)
        num_images, command, settings = run.result
        return {
            "taken": taken(run),
            "num_images": num_images,
            "command": command,
            "settings": settings,
        }

    given = [file_digest(clip.video), clip.images, clip.camera, pycolmap.__version__]
    made = run_stage_in(
        database.parent, given, dict[str, Any], fill, products=[database, images], timed=True
    )
    command = str(made.result["command"])
    num_images = int(made.result["num_images"])
    matched = row_of(clip, "match", made.result["taken"])
    rows = [matched]
    printed = database.with_name("a_model")
    shutil.rmtree(printed, ignore_errors=True)
    # pycolmap gets a copy: it migrates a database to its own layout.
    copy, output = folder / "copy.db", folder / "pycolmap"
    shutil.copyfile(database, copy)
    shutil.rmtree(output, ignore_errors=True)
    settings = MapOptions(**made.result["settings"])
    by_map = folder / "map"
    shutil.rmtree(by_map, ignore_errors=True)
    runs = {
        render.MATCH_PYCOLMAP: (
            run_measured(map_incrementally, copy, images, output, command, log=log),
            output / "0",
        ),
        render.MATCH_MAP: (
            run_measured(run_map, database, images, by_map, settings, log=log),
            by_map / "0",
        ),
    }
    if shutil.which("colmap") is not None:
        runs[render.MATCH_COLMAP] = (run_measured(run_command, command, log=log), printed / "0")
    for way, (run, model) in runs.items():
        mapper = row_of(clip, f"{way}: mapper", taken(run))
        total = replace(sum_of(way, [matched, mapper]), images=num_images)
        if model.is_dir():
            total = replace(total, **figures_on(clip, model, images, folder, num_images))
        rows += [mapper, total]
    return rows


def run_match(
    video: Path, database: Path, images: Path, options: MatchOptions
) -> tuple[int, str, dict[str, Any]]:
    """Fill a new database.

    Returns:
        The number of images, and the command for COLMAP and the options of `map` that `match`
        prints.
    """
    report = match(database, video, image_path=images, options=options)
    return report.num_images, report.next_commands[0], asdict(report.map_options)


def run_map(database: Path, images: Path, output: Path, options: MapOptions) -> None:
    """Map a database by `map`."""
    map_database(database, images, output, options=options)


def run_command(words: str) -> None:
    """Run a command line in a shell."""
    subprocess.run(words, shell=True, check=True)


def measure_sift(clip: Clip, folder: Path, names: list[str], *, mapped: bool) -> list[Row]:
    """Rows of the steps of SIFT on the same images, and their total."""
    steps, model, images = sift_of(clip, folder, names, mapped=mapped)
    rows = [row_of(clip, f"SIFT: {name}", step) for name, step in steps.items()]
    total = replace(sum_of(render.SIFT_FROM_FILE, rows), images=len(names))
    if model is None:
        return [*rows, total]
    before_mapper = rows[:-1]
    rows.append(replace(total, **figures_on(clip, model, images, folder, len(names))))
    output = folder / "map"
    shutil.rmtree(output, ignore_errors=True)
    settings = MapOptions(refine_intrinsics=clip.camera.camera_params is None)
    database = folder / "features" / "database.db"
    run = run_measured(run_map, database, images, output, settings, log=folder / "log")
    mapper = row_of(clip, f"{render.SIFT_MAP}: mapper", taken(run))
    total = replace(sum_of(render.SIFT_MAP, [*before_mapper, mapper]), images=len(names))
    figures = figures_on(clip, output / "0", images, folder, len(names))
    return [*rows, mapper, replace(total, **figures)]


def folder_of(clip: Clip, folder: Path) -> tuple[dict[str, Any] | None, dict[str, Any], Path]:
    """Cost of conversion (None for AV1 clips) and of the rest of `reconstruct`, and its folder."""
    stream, output = folder / "converted" / "stream.mp4", folder / "made" / "output"
    is_av1 = read_video(clip.video).codec == "av1"

    def convert() -> dict[str, Any]:
        return taken(run_measured(run_encode, clip.video, stream, log=stream.parent / "log"))

    source = file_digest(clip.video)
    converted = None
    if not is_av1:
        kept = run_stage_in(
            stream.parent, [source], dict[str, Any], convert, products=[stream], timed=True
        )
        converted = kept.result
    keep_stream = None if is_av1 else stream
    # Trained renderings are compared with the pictures, so these are lossless.
    options = ReconstructOptions(
        match=MatchOptions(images=clip.images, camera=clip.camera, keep_stream=keep_stream),
        image_type="png",
    )

    def make() -> dict[str, Any]:
        log = output.parent / "log"
        return taken(run_measured(run_reconstruct, clip.video, output, options, log=log))

    given = [source, clip.images, clip.camera]
    made = run_stage_in(
        output.parent, given, dict[str, Any], make, products=[output], timed=True
    ).result
    return converted, made, output


def run_encode(video: Path, stream: Path) -> None:
    """Convert a video like `reconstruct`."""
    options = with_downscale(EncodeOptions(effort="quick"), read_video(video).picture_size)
    stream_of(video, stream, options=options)


def run_reconstruct(video: Path, output: Path, options: ReconstructOptions) -> None:
    """Reconstruct with an existing stream."""
    reconstruct(video, output, options=options)


def sift_of(
    clip: Clip, folder: Path, names: list[str], *, mapped: bool
) -> tuple[dict[str, dict[str, Any]], Path | None, Path]:
    """Cost of SIFT's steps, its model if it is mapped, and its images."""
    images, database = folder / "frames" / "images", folder / "features" / "database.db"
    frames = [int(Path(name).stem.rpartition("_")[2]) for name in names]
    opened = read_video(clip.video)
    footage = Footage(
        video=clip.video,
        image_path=images,
        names=names,
        frames=tuple(frames),
        num_frames=max(frames) + 1,
        size=opened.picture_size,
        pixel_aspect=opened.display.pixel_aspect,
        camera=clip.camera,
    )

    def write() -> dict[str, Any]:
        images.mkdir()
        log = images.parent / "log"
        return taken(run_measured(run_ffmpeg, clip.video, images, names, frames, log=log))

    def extract_and_match() -> dict[str, Any]:
        log = database.parent / "log"
        extracted = run_measured(run_extraction, footage, database, log=log)
        matched = run_measured(run_matching, database, log=log)
        return {"features": taken(extracted), "matches": taken(matched)}

    given: list[Any] = [file_digest(clip.video), names]
    written = run_stage_in(
        images.parent, given, dict[str, Any], write, products=[images], timed=True
    ).result
    given = [*given, clip.camera, pycolmap.__version__]
    matching = run_stage_in(
        database.parent,
        given,
        dict[str, dict[str, Any]],
        extract_and_match,
        products=[database],
        timed=True,
    ).result
    steps = {"frames": written, **matching}
    if not mapped:
        return steps, None, images
    known = clip.camera.camera_params is not None
    settings = MapOptions(refine_intrinsics=not known, forward_motion=clip.forward_motion)
    run = measure_mapper(database, images, folder / "model", settings)
    return {**steps, "mapper": taken(run)}, run.model, images


def run_ffmpeg(video: Path, folder: Path, names: list[str], frames: list[int]) -> None:
    """Write frames of a video as images."""
    wanted = any_of([f"eq(n\\,{frame})" for frame in frames])
    if frames == list(range(len(frames))):
        wanted = f"lt(n\\,{len(frames)})"
    numbered = folder / "%06d.png"
    ruler.ffmpeg(
        *("-i", str(video), "-vf", f"select='{wanted}'"),
        *("-fps_mode", "passthrough", "-start_number", "0", str(numbered)),
    )
    for number, name in enumerate(names):
        (folder / f"{number:06d}.png").replace(folder / name)


def any_of(terms: list[str]) -> str:
    """A sum of terms as a balanced expression, because ffmpeg refuses deep nesting."""
    if len(terms) == 1:
        return terms[0]
    half = len(terms) // 2
    return f"({any_of(terms[:half])}+{any_of(terms[half:])})"


def run_extraction(footage: Footage, database: Path) -> None:
    """SIFT features of all images, with COLMAP's defaults."""
    pycolmap.set_random_seed(0)
    list_images(footage, database)
    pycolmap.extract_features(database, footage.image_path, footage.names)


def run_matching(database: Path) -> None:
    """Match sequentially, with COLMAP's defaults."""
    pycolmap.set_random_seed(0)
    pycolmap.match_sequential(database)


def taken(run: Measured[Any] | MapperRun) -> dict[str, Any]:
    """Cost of a measured process."""
    memory = (run.peak_memory or 0) / 1e6
    return {"cpu_s": run.cpu_seconds, "seconds": run.seconds, "memory_mb": memory}


def row_of(clip: Clip, way: str, step: dict[str, Any]) -> Row:
    """The row of a step."""
    return Row(clip.name, way, **step)


def sum_of(way: str, steps: list[Row]) -> Row:
    """The total of several steps."""
    return Row(
        steps[0].clip,
        way,
        cpu_s=sum(step.cpu_s for step in steps),
        seconds=sum(step.seconds for step in steps),
        memory_mb=max(step.memory_mb or 0 for step in steps),
    )


def figures_on(
    clip: Clip, model: Path, images: Path, folder: Path, num_images: int
) -> dict[str, Any]:
    """Fields of Row for a model of distorted images; `folder` gets undistorted ones."""
    straight = undistorted(model, images, folder / "undistorted")
    return figures_of(clip, model, None, num_images) | ruler.long_range(*straight)


def figures_of(clip: Clip, model: Path, images: Path | None, num_images: int) -> dict[str, Any]:
    """Fields of Row for a model; the long-range epipolar error only with undistorted `images`."""
    reconstruction = read_model(model)
    about = model_figures(reconstruction)
    found: dict[str, Any] = {
        "images": num_images,
        "registered": about.num_registered,
        "points": about.num_points,
        "error_px": about.mean_error,
    }
    if clip.poses is not None:
        errors = pose_errors(model_poses(reconstruction, len(clip.poses)), clip.poses)
        if errors is not None:
            found |= {"ate": errors.ate, "ate_of_extent": errors.ate / errors.extent}
    return found if images is None else found | ruler.long_range(model, images)


def undistorted(model: Path, images: Path, folder: Path) -> tuple[Path, Path]:
    """An undistorted model and its images, for the long-range check; its time is not counted."""
    shutil.rmtree(folder, ignore_errors=True)
    pycolmap.logging.minloglevel = pycolmap.logging.WARNING.value
    pycolmap.undistort_images(folder, model, images)
    return folder / "sparse", folder / "images"


if __name__ == "__main__":
    sys.exit(main())

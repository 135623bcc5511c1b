"""Simulate jerks of the camera by removing frames, and measure whether models stay accurate.

python examples/benchmarks/jerks.py --cache benchmark_jerks --places 50

Each place is a separate clip: up to three gaps are cut into a sequence, each with a motion of 60 to
200 px and at most 12 degrees between two frames. In every second clip, the frames on either side
are blurred along the motion. `reconstruct` maps the clip with its defaults, and `match` fills a
database for COLMAP's mapper. Camera centres are compared with the ground truth of the whole
sequence, or with SIFT's model of it. A model is bent if its centres have an error of more than 0.5
% of their extent. The table counts bent models, whether a warning reports them, and images that are
not registered.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import clips as ruler
import cv2
import imageio_ffmpeg
import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import phone_clip
import render
from numpy.typing import NDArray
from results import add_results, read_rows, save
from rich.console import Console
from sequences import measure_frontend, model_poses, prepare_footage, read_sequence

from colmap_av1 import (
    ColmapAv1Error,
    ImageOptions,
    MapOptions,
    MatchOptions,
    ReconstructOptions,
    map_database,
    match,
    reconstruct,
)
from colmap_av1.evaluate import measure_mapper, pose_errors, run_measured
from colmap_av1.geometry.colmap_model import read_model
from colmap_av1.options import CameraOptions
from colmap_av1.video.decoding import decode_frames

# The rendered clip at half size; all other clips are sequences of ../shared.
RENDERED = "orbit"
RENDERED_SECONDS = 4
SEQUENCES = ("log_building", "ditch", "street", "holiday_display", RENDERED)
WAYS = ("reconstruct", "match, mapper")
PIXELS = (60.0, 200.0)
DEGREES = 12.0
MOST_GAPS = 3
# Number of frames kept at either end and between two gaps, so that each part can be mapped.
ROOM = 10
# Lengths in pixels of the motion blur in every second clip.
BLURS = (9, 17, 25)
EVERY_FRAME = ImageOptions(every=1)
# Smallest number of points of an image that determine the motion of the picture.
POINTS = 3000

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class Whole:
    """A complete sequence.

    Attributes:
        name: name of the sequence.
        pictures: all frames.
        camera: options for the known camera.
        model: model that the places are chosen by, from SIFT, or from `reconstruct` for the
            rendered clip.
        poses: float64 [num_frames, 3, 4] true poses, or those of SIFT's model; NaN where unknown.
    """

    name: str
    pictures: list[Image]
    camera: CameraOptions
    model: Any
    poses: NDArray[np.float64]


@dataclass(frozen=True)
class Gap:
    """Removed frames between two others.

    Attributes:
        before: the last frame before the gap.
        after: the first frame after the gap.
        pixels: motion of the picture across the gap, the median over points.
        degrees: rotation of the camera across the gap.
    """

    before: int
    after: int
    pixels: float
    degrees: float

    def __str__(self) -> str:
        return f"{self.before}-{self.after}"


@dataclass(frozen=True)
class Row:
    """Result of one way on one clip; `ate` is in per cent of the extent, None without a model."""

    place: int
    sequence: str
    way: str
    gaps: str
    pixels: float
    degrees: float
    blur: int
    images: int
    registered: int
    ate: float | None
    warnings: str


def main() -> int:
    """Measure the places, and save and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cache", type=Path, required=True, help="folder for models and clips")
    parser.add_argument("--places", type=int, default=50, help="number of places")
    parser.add_argument("--first", type=int, default=0, help="number of the first place")
    parser.add_argument("--sequences", nargs="+", choices=SEQUENCES, default=SEQUENCES)
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=WAYS)
    add_results(parser, "jerks")
    arguments = parser.parse_args()
    console = Console(stderr=True)
    cache = arguments.cache.resolve()
    whole: Whole | None = None
    places = range(arguments.first, arguments.first + arguments.places)
    # Ordered by sequence, so that only the pictures of one are in memory.
    for place in sorted(places, key=lambda place: (place % len(SEQUENCES), place)):
        name = SEQUENCES[place % len(SEQUENCES)]
        if name not in arguments.sequences or not (name == RENDERED or ruler.is_there(name)):
            continue
        if whole is None or whole.name != name:
            whole = whole_sequence(name, cache / name, console)
        for row in try_place(whole, place, arguments.ways, cache / "place", console):
            save(arguments.results, [asdict(row)], ("place", "way"))
    print(render.jerks(read_rows(arguments.results)), end="")
    return 0


def whole_sequence(name: str, folder: Path, console: Console) -> Whole:
    """A complete sequence with a model and reference poses."""
    if name == RENDERED:
        return whole_orbit(folder, console)
    sequence = read_sequence(ruler.SEQUENCES / name)
    video = ruler.as_shot(sequence, folder / "source")
    known = sequence.camera is not None
    camera = ruler.camera_options(sequence.camera) if known else CameraOptions()
    case = next((case for case in ruler.CASES if case.name == name), ruler.Case(name))
    footage = prepare_footage(
        video,
        folder / "footage",
        num_frames=sequence.num_frames,
        image_step=1,
        camera=camera,
    )
    console.print(f"{name}: SIFT's model of the whole", markup=False)
    database = measure_frontend("sift-sequential", footage, folder / "sift").database
    settings = MapOptions(refine_intrinsics=not known, forward_motion=case.forward_motion)
    mapped = measure_mapper(database, footage.image_path, folder / "model", settings)
    if mapped.model is None:
        raise ColmapAv1Error(f"{name}: SIFT made no model: see {folder / 'model'}")
    model = read_model(mapped.model)
    poses = sequence.cam_from_world
    if poses is None:
        poses = model_poses(model, sequence.num_frames)
    pictures = [picture for _, picture in decode_frames(video)]
    return Whole(name, pictures, camera, model, poses)


def whole_orbit(folder: Path, console: Console) -> Whole:
    """The rendered clip, with a model from `reconstruct`."""
    full = phone_clip.phone_clip(folder / "clips", RENDERED_SECONDS)
    pictures = [
        np.asarray(cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
        for _, picture in decode_frames(full)
    ]
    write_clip(folder / "orbit.mp4", pictures)
    console.print(f"{RENDERED}: a model of the whole", markup=False)
    output = folder / "whole"
    given = (folder / "orbit.mp4", output, CameraOptions())
    run_measured(run_reconstruct, *given, log=folder / "log")
    model = read_model(output / "sparse" / "0")
    poses = phone_clip.true_poses(len(pictures))
    return Whole(RENDERED, pictures, CameraOptions(), model, poses)


def try_place(
    whole: Whole, place: int, ways: Sequence[str], folder: Path, console: Console
) -> list[Row]:
    """Rows of a clip with gaps, one for each way."""
    rng = np.random.default_rng(place)
    gaps = gaps_of(whole, rng)
    blur = int(rng.choice(BLURS)) if place % 2 else 0
    left_out = {frame for gap in gaps for frame in range(gap.before + 1, gap.after)}
    kept = [frame for frame in range(len(whole.pictures)) if frame not in left_out]
    console.print(f"{place}: {whole.name} without {', '.join(map(str, gaps))}", markup=False)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    clip = folder / "clip.mp4"
    edges = {frame for gap in gaps for frame in (gap.before, gap.after)} if blur else set()
    write_clip(
        clip,
        [
            blurred(whole.pictures[frame], blur) if frame in edges else whole.pictures[frame]
            for frame in kept
        ],
    )
    rows = []
    for way in ways:
        made, warnings = way_of(way, whole, clip, folder)
        num_registered, ate = figures(whole.poses, made, kept)
        row = Row(
            place=place,
            sequence=whole.name,
            way=way,
            gaps=" ".join(map(str, gaps)),
            pixels=max((gap.pixels for gap in gaps), default=0.0),
            degrees=max((gap.degrees for gap in gaps), default=0.0),
            blur=blur,
            images=len(kept),
            registered=num_registered,
            ate=ate,
            warnings="; ".join(warnings),
        )
        rows.append(row)
    return rows


def gaps_of(whole: Whole, rng: np.random.Generator) -> list[Gap]:
    """One to three gaps with enough frames between them, in the order of frames."""
    posed = {number(image.name): image for image in whole.model.images.values() if image.has_pose}
    frames = sorted(posed)
    wanted = int(rng.integers(1, MOST_GAPS + 1))
    gaps: list[Gap] = []
    for before in rng.permutation(frames[ROOM:-ROOM]).tolist():
        least = rng.uniform(*PIXELS)
        gap = next(
            (
                found
                for after in frames[frames.index(before) + 2 :]
                for found in [gap_between(whole.model, posed, before, after)]
                if found.pixels >= least
            ),
            None,
        )
        fits = gap is not None and gap.pixels <= 1.1 * PIXELS[1] and gap.degrees <= DEGREES
        if gap is None or not fits or gap.after + ROOM > frames[-1]:
            continue
        if all(gap.before > own.after + ROOM or gap.after + ROOM < own.before for own in gaps):
            gaps.append(gap)
        if len(gaps) == wanted:
            break
    return sorted(gaps, key=lambda gap: gap.before)


def gap_between(model: Any, posed: dict[int, Any], before: int, after: int) -> Gap:
    """Motion of picture and camera from one frame to another, measured by a model."""
    first, second = posed[before], posed[after]
    seen = [point for point in first.points2D if point.has_point3D()][:POINTS]
    xy = np.array([point.xy for point in seen]).reshape(-1, 2)
    xyz = np.array([model.points3D[point.point3D_id].xyz for point in seen]).reshape(-1, 3)
    local = np.asarray(second.cam_from_world() * xyz)
    ahead = local[:, 2] > 0
    moved = np.asarray(model.cameras[second.camera_id].img_from_cam(local[ahead])) - xy[ahead]
    pixels = float(np.median(np.hypot(*moved.T))) if len(moved) else np.inf
    turn = (second.cam_from_world() * first.cam_from_world().inverse()).rotation
    return Gap(before, after, pixels, float(np.degrees(turn.angle())))


def number(name: str) -> int:
    """The frame number in the name of an image."""
    return int(Path(name).stem.rpartition("_")[2])


def blurred(picture: Image, length: int) -> Image:
    """The picture with horizontal motion blur."""
    line = np.full((1, length), 1 / length, np.float32)
    return np.asarray(cv2.filter2D(picture, -1, line), np.uint8)


def write_clip(path: Path, pictures: Sequence[Image]) -> None:
    """Write pictures as nearly lossless H.264."""
    height, width = pictures[0].shape[:2]
    words = f"-v error -y -f rawvideo -pix_fmt bgr24 -s {width}x{height} -r 25 -i -".split()
    words += ["-c:v", "libx264", "-preset", "veryfast", "-crf", "14", "-pix_fmt", "yuv420p"]
    command = [imageio_ffmpeg.get_ffmpeg_exe(), *words, str(path)]
    subprocess.run(command, input=b"".join(p.tobytes() for p in pictures), check=True)


def way_of(way: str, whole: Whole, clip: Path, folder: Path) -> tuple[Any | None, list[str]]:
    """The model of a clip by one way, if any, and the warnings about it.

    Args:
        way: one of `WAYS`.
        whole: the complete sequence.
        clip: the video.
        folder: folder for the output of the ways, each in a subfolder, which is emptied before.
    """
    output = folder / way.partition(",")[0]
    shutil.rmtree(output, ignore_errors=True)
    output.parent.mkdir(parents=True, exist_ok=True)
    run = run_reconstruct if way == "reconstruct" else run_match
    try:
        warnings = run_measured(run, clip, output, whole.camera, log=folder / "log").result
    except ColmapAv1Error as error:
        return None, [str(error)]
    model = "sparse/0" if way == "reconstruct" else "models/0"
    return read_model(output / model), warnings


def run_reconstruct(clip: Path, output: Path, camera: CameraOptions) -> list[str]:
    """Reconstruct with default options, like the command."""
    options = ReconstructOptions(match=MatchOptions(camera=camera, images=EVERY_FRAME))
    return about_the_model(reconstruct(clip, output, options=options).warnings)


def run_match(clip: Path, output: Path, camera: CameraOptions) -> list[str]:
    """A database, mapped by COLMAP's incremental mapper."""
    output.mkdir()
    options = MatchOptions(camera=camera, images=EVERY_FRAME)
    matched = match(output / "a.db", clip, image_path=output / "images", options=options)
    settings = matched.map_options
    if camera.camera_params is not None:
        settings = replace(settings, refine_intrinsics=False)
    mapped = map_database(output / "a.db", output / "images", output / "models", options=settings)
    missing = mapped.num_images - mapped.num_registered[0]
    parts = [f"{missing} images are not registered in folder 0"] if missing else []
    return about_the_model([*matched.warnings, *mapped.warnings, *parts])


def about_the_model(warnings: Sequence[str]) -> list[str]:
    """The warnings about bent or disconnected models and images that are not registered."""
    signs = (
        "few matches",
        "not registered",
        "no model has all",
        "join '",
        "fit the poses",
        "far apart in time",
        "nothing connects",
    )
    return [warning for warning in warnings if any(sign in warning for sign in signs)]


def figures(
    poses: NDArray[np.float64], model: Any | None, kept: list[int]
) -> tuple[int, float | None]:
    """Number of registered images, and error of their centres in per cent of the true extent."""
    if model is None:
        return 0, None
    errors = pose_errors(model_poses(model, len(kept)), poses[kept])
    ate = None if errors is None else 100 * errors.ate / errors.extent
    return model.num_reg_images(), ate


if __name__ == "__main__":
    sys.exit(main())

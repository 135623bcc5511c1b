"""Measure the effect of encoders, speeds and qualities on the tracks and the model.

python examples/benchmarks/encoders.py --cache benchmark_encoders

Each clip is converted with each setting. The tracks of the stream are counted and, if cameras are
known, compared with them; `reconstruct` creates a model from the motion of the stream and the
original pictures of the clip. Hardware encoders are measured if available.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tempfile
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import clips as ruler
import numpy as np  # before pycolmap: the other order breaks writing PNG files later
from results import add_results, save
from rich.console import Console
from sequences import Sequence, model_poses, read_sequence
from track_metrics import epipolar_errors

from colmap_av1 import (
    CameraOptions,
    ColmapAv1Error,
    EncodeError,
    EncodeOptions,
    ImageOptions,
    MatchOptions,
    ReconstructOptions,
    build_tracks,
    read_motion,
    reconstruct,
)
from colmap_av1.evaluate import pose_errors, run_measured
from colmap_av1.geometry.colmap_model import read_model
from colmap_av1.util.digests import file_digest
from colmap_av1.util.stages import run_stage_in
from colmap_av1.video.encode import stream_of
from colmap_av1.video.encoders import find_encoder

HARDWARE = (
    EncodeOptions("nvenc"),
    EncodeOptions("qsv"),
    EncodeOptions("amf"),
    EncodeOptions("vaapi"),
)
SETTINGS = (
    *(EncodeOptions("libaom", 20, speed) for speed in (6, 7, 8, 9, 10)),
    EncodeOptions("libaom", 32, 8),
    *(EncodeOptions("svt", 20, speed) for speed in (8, 10, 12)),
)
# Every n-th frame is an image, by clip.
CLIPS = {
    "log_building": 1,
    "ditch": 1,
    "holiday_display": 1,
    "street": 1,
    "shelfbox": 1,
    "kitchen": 2,
}


@dataclass(frozen=True)
class Row:
    """Figures of one setting on one clip; None if unknown.

    CPU seconds are those of ffmpeg for each megapixel of a frame, including decoding the source.
    Tracks have at least 4 or 8 frames. Epipolar errors are medians in pixels between observations
    1 or 8 frames apart. Long-range epipolar errors are described at `clips.long_range`.
    """

    clip: str
    encoder: str
    speed: int | None
    quality: int | None
    cpu_per_megapixel: float
    kb_per_frame: float
    tracks_of_4: int
    tracks_of_8: int
    epipolar_1: float | None
    epipolar_8: float | None
    registered: int | None = None
    images: int | None = None
    points: int | None = None
    error: float | None = None
    ate: float | None = None
    long_range: float | None = None
    long_range_90: float | None = None
    reconstruct_cpu: float | None = None


def main() -> int:
    """Measure every setting on every clip, and save and print the rows."""
    parser = argparse.ArgumentParser(
        description="Measure the effect of encoders on the tracks and the model.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument(
        "--cache", type=Path, help="folder that keeps all results [a temporary one]"
    )
    parser.add_argument("--clips", nargs="+", choices=CLIPS, default=list(CLIPS), metavar="NAME")
    names = [name_of(setting) for setting in SETTINGS]
    parser.add_argument("--settings", nargs="+", choices=names, default=names, metavar="NAME")
    add_results(parser, "encoders")
    arguments = parser.parse_args()
    console = Console(stderr=True)
    wanted = [setting for setting in SETTINGS if name_of(setting) in arguments.settings]
    settings = [*filter(works, HARDWARE), *wanted]
    with ExitStack() as stack:
        cache = arguments.cache or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        for clip in arguments.clips:
            if not (ruler.SEQUENCES / clip).is_dir():
                console.print(f"{clip}: not measured, {ruler.SEQUENCES / clip} is absent")
                continue
            for setting in settings:
                console.print(f"{clip}: {name_of(setting)}", markup=False)
                try:
                    row = measure(clip, cache.absolute() / clip, setting)
                except ColmapAv1Error as error:
                    console.print(f"error: {clip}: {error}", markup=False)
                    continue
                save(arguments.results, [asdict(row)], ("clip", "encoder", "speed", "quality"))
                print(row, flush=True)
    return 0


def name_of(setting: EncodeOptions) -> str:
    """Name of a setting, by its command-line options."""
    return f"{setting.encoder}-{setting.speed}-{setting.quality}"


def works(setting: EncodeOptions) -> bool:
    """Whether an encoder works on this machine."""
    try:
        find_encoder(setting)
    except EncodeError:
        return False
    return True


def measure(clip: str, folder: Path, setting: EncodeOptions) -> Row:
    """Convert a clip with a setting, and reconstruct it."""
    sequence = read_sequence(ruler.SEQUENCES / clip)
    source = ruler.as_shot(sequence, folder / "source")
    where = folder / name_of(setting)
    stream, cpu_seconds = converted(source, where / "stream", setting)
    tracks = build_tracks(read_motion(stream))
    length = tracks.lengths
    errors: dict[int, float] = {}
    if sequence.camera is not None and sequence.cam_from_world is not None:
        cameras = (sequence.cam_from_world, sequence.camera)
        errors = {n: ruler.median(epipolar_errors(tracks, *cameras, n)) for n in (1, 8)}
    return Row(
        clip=clip,
        encoder=str(setting.encoder),
        speed=setting.speed,
        quality=setting.quality,
        cpu_per_megapixel=cpu_seconds * 1e6 / (tracks.num_frames * tracks.width * tracks.height),
        kb_per_frame=stream.stat().st_size / 1000 / tracks.num_frames,
        tracks_of_4=int(np.count_nonzero(length >= 4)),
        tracks_of_8=int(np.count_nonzero(length >= 8)),
        epipolar_1=errors.get(1),
        epipolar_8=errors.get(8),
        **modelled(sequence, source, stream, where / "model", setting),
    )


def converted(source: Path, folder: Path, setting: EncodeOptions) -> tuple[Path, float]:
    """The stream of a setting, and the CPU time of ffmpeg."""
    stream = folder / "stream.mp4"

    def make() -> float:
        before = os.times()
        stream_of(source, stream, options=setting)
        after = os.times()
        spent = after.children_user + after.children_system
        return spent - before.children_user - before.children_system

    given = (file_digest(source), setting)
    made_by = ("video",)
    spent = run_stage_in(
        folder, given, float, make, products=[stream], made_by=made_by, timed=True
    ).result
    return stream, spent


def modelled(
    sequence: Sequence, source: Path, stream: Path, folder: Path, setting: EncodeOptions
) -> dict[str, Any]:
    """Fields of Row for the model; empty without a model."""
    camera = CameraOptions()
    if sequence.camera is not None:
        params = ",".join(map(str, sequence.camera.params))
        camera = CameraOptions(camera_model=sequence.camera.model.name, camera_params=params)
    every = CLIPS[sequence.name]
    images = ImageOptions(every=every if every > 1 else None)
    match = MatchOptions(images=images, camera=camera, encode=setting, keep_stream=stream)

    def make() -> dict[str, Any]:
        output = folder / "output"
        try:
            made = run_measured(
                reconstructed, source, output, ReconstructOptions(match=match), log=folder / "log"
            )
        except ColmapAv1Error as error:
            return {"message": str(error)}
        facts = {**made.result, "reconstruct_cpu": made.cpu_seconds}
        if sequence.cam_from_world is not None:
            poses = model_poses(read_model(output / "sparse" / "0"), sequence.num_frames)
            errors = pose_errors(poses, sequence.cam_from_world)
            facts["ate"] = errors.ate if errors is not None else None
        facts |= ruler.long_range(output / "sparse" / "0", output / "images")
        shutil.rmtree(output)
        return facts

    given = (file_digest(source), file_digest(stream), images, camera)
    facts = run_stage_in(folder, given, dict[str, Any], make, products=[]).result
    facts.pop("message", None)
    return facts


def reconstructed(source: Path, output: Path, options: ReconstructOptions) -> dict[str, Any]:
    """Reconstruct; called in a separate process."""
    report = reconstruct(source, output, options=options)
    return {
        "registered": report.num_registered,
        "images": report.num_images,
        "points": report.num_points,
        "error": report.mean_error,
    }


if __name__ == "__main__":
    sys.exit(main())

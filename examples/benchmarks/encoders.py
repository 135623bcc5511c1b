"""Measure what encoders, their speeds and qualities are worth for tracks and maps.

python examples/benchmarks/encoders.py --cache benchmark_tracks

Each clip is encoded with each setting; tracks are measured against true poses where these and the
intrinsics are known, where neither is against the model of SIFT and exhaustive matching; a spread
subset of them is mapped.
Hardware encoders are measured where they work. The cache is that of tracks.py.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import tracks as ruler
from rich.console import Console

from colmap_av1 import (
    CameraOptions,
    ColmapAv1Error,
    EncodeError,
    EncodeOptions,
    MapOptions,
    build_tracks,
    read_motion,
)
from colmap_av1.evaluate import (
    epipolar_errors,
    measure_mapper,
    model_figures,
    prepare_footage,
    run_frontend,
    run_measured,
)
from colmap_av1.model.colmap_model import read_model
from colmap_av1.util.digests import file_digest
from colmap_av1.util.stages import run_stage_in
from colmap_av1.video.encode import encode
from colmap_av1.video.encoders import find_encoder

HARDWARE = ("nvenc", "qsv", "amf", "vaapi")
SETTINGS = (
    *(EncodeOptions("libaom", 20, speed) for speed in (4, 6, 8)),
    *(EncodeOptions("libaom", quality, 6) for quality in (30, 40)),
    *(EncodeOptions("svt", 20, speed) for speed in (8, 10)),
    EncodeOptions("svt", 40, 8),
)
CLIPS = ("street", "log_building", "kitchen")
SPANS = (1, 8)
LONG = (4, 8)


@dataclass(frozen=True)
class Row:
    """What one setting gives on one clip."""

    setting: str
    cpu_per_frame: float
    bytes_per_frame: float
    num_tracks: dict[int, int]
    errors: dict[int, float] | None
    num_registered: int
    num_images: int
    mean_error: float


def main() -> int:
    """Measure every setting on every clip and print the tables."""
    parser = argparse.ArgumentParser(
        description="Measure what encoders are worth for tracks and maps.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument(
        "--cache", type=Path, help="folder that keeps all results; without, a temporary one"
    )
    parser.add_argument("--clips", nargs="+", choices=CLIPS, default=CLIPS, metavar="NAME")
    arguments = parser.parse_args()
    console = Console(stderr=True)
    settings = [*filter(works, (EncodeOptions(name) for name in HARDWARE)), *SETTINGS]
    with ExitStack() as stack:
        cache = arguments.cache or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        for case in ruler.CASES:
            if case.name not in arguments.clips:
                continue
            if not (ruler.SEQUENCES / case.name).is_dir():
                console.print(f"{case.name}: not measured, {ruler.SEQUENCES / case.name} is absent")
                continue
            rows, about = measure_clip(case, cache / case.name, settings, console)
            print(f"### {case.name}\n\n{about}\n")
            print(table(rows), flush=True)
    return 0


def works(setting: EncodeOptions) -> bool:
    """Whether an encoder works here."""
    try:
        find_encoder(setting)
    except EncodeError:
        return False
    return True


def measure_clip(
    case: ruler.Case, folder: Path, settings: list[EncodeOptions], console: Console
) -> tuple[list[Row], str]:
    """Rows of one clip, and a line on what they are measured against."""
    folder.mkdir(parents=True, exist_ok=True)
    material = ruler.real_sequence(case, folder, console)
    camera = CameraOptions()
    if material.camera is not None:
        params = ",".join(map(str, material.camera.params))
        camera = CameraOptions(camera_model=material.camera.model.name, camera_params=params)
    how = {"num_frames": material.num_frames, "image_step": case.image_step, "camera": camera}
    mapper = MapOptions(
        refine_intrinsics=material.camera is None, forward_motion=case.forward_motion
    )
    truth = ruler.known_truth(material)
    if truth.poses is None:
        footage = prepare_footage(material.video, folder / "footage", **how)
        model = ruler.reference_model(footage, folder, mapper, console)
        truth = ruler.with_reference(truth, model, material.num_frames)
    source = lossless(material, folder)
    rows = []
    for setting in settings:
        name = f"{setting.encoder}-{setting.speed}-{setting.quality}"
        console.print(f"{case.name}: {name}", markup=False)
        where = folder / "encoders" / name
        try:
            stream, encoding = encoded(source, where / "stream", setting)
            footage = prepare_footage(stream, where / "footage", **how)
            sparse = run_frontend("av1-sparse", footage, where / "sparse")
            mapped = measure_mapper(sparse.database, footage.image_path, where / "model", mapper)
        except ColmapAv1Error as error:
            console.print(f"error: {case.name}: {name}: {error}", markup=False)
            continue
        tracks = build_tracks(read_motion(stream))
        length = np.diff(tracks.offsets)
        errors = None
        if truth.geometry is not None:
            errors = {
                span: ruler.median(epipolar_errors(tracks, *truth.geometry, span)) for span in SPANS
            }
        figures = model_figures(read_model(mapped.model)) if mapped.model is not None else None
        rows.append(
            Row(
                setting=f"{setting.encoder} {setting.speed or ''} | {setting.quality or ''}",
                cpu_per_frame=encoding["cpu_seconds"] / material.num_frames,
                bytes_per_frame=stream.stat().st_size / material.num_frames,
                num_tracks={n: int(np.count_nonzero(length >= n)) for n in LONG},
                errors=errors,
                num_registered=figures.num_registered if figures is not None else 0,
                num_images=len(footage.frames),
                mean_error=figures.mean_error if figures is not None else float("nan"),
            )
        )
    return rows, f"{material.num_frames} frames; {truth.about}."


def lossless(material: ruler.Material, folder: Path) -> Path:
    """The pictures the clip is made of, in one file."""
    assert material.source is not None
    words = material.source
    video = folder / "lossless" / "video.mkv"

    def make() -> dict[str, Any]:
        ruler.ffmpeg(*words, "-an", "-c:v", "ffv1", "-pix_fmt", "yuv420p", str(video))
        return {}

    run_stage_in(video.parent, words, make, products=[video], made_by=())
    return video


def encoded(source: Path, folder: Path, setting: EncodeOptions) -> tuple[Path, dict[str, Any]]:
    """The stream of a setting, and the time it took."""
    stream = folder / "stream.mp4"

    def make() -> dict[str, Any]:
        measured = run_measured(encode_quietly, source, stream, setting, log=folder / "log.txt")
        return {"seconds": measured.seconds, "cpu_seconds": measured.cpu_seconds}

    given = (file_digest(source), setting)
    return stream, run_stage_in(folder, given, make, products=[stream], timed=True).facts


def encode_quietly(source: Path, stream: Path, setting: EncodeOptions) -> None:
    """Encode in a process that is measured."""
    encode(source, stream, options=setting)


def table(rows: list[Row]) -> str:
    """Markdown table of the settings."""
    lines = [
        "| encoder, speed | quality | CPU ms a frame | kB a frame | "
        + " | ".join(f"tracks of {n}+" for n in LONG)
        + f" | epipolar px at {' / '.join(map(str, SPANS))} frames | registered | mapped at |",
        "|---|---|" + "---:|" * (4 + len(LONG)) + "---:|",
    ]
    for row in rows:
        errors = "-"
        if row.errors is not None:
            errors = " / ".join(f"{row.errors[span]:.2f}" for span in SPANS)
        counts = " | ".join(f"{row.num_tracks[n]:,}" for n in LONG)
        cost = f"{1000 * row.cpu_per_frame:.0f} | {row.bytes_per_frame / 1000:.1f}"
        mapped = f"{row.num_registered} of {row.num_images} | {row.mean_error:.2f} px"
        lines.append(f"| {row.setting} | {cost} | {counts} | {errors} | {mapped} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())

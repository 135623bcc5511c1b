"""Compare the time to read the motion of an AV1 file with decoding it with dav1d.

python examples/benchmarks/read_motion.py --cache benchmark_clips

Both times include opening and demuxing the file; frames are not converted. Runs alternate in one
process. The table shows medians: CPU time with one thread, which depends little on other load, and
wall time with more threads. The example clip is always measured; the other clips are created from
the sequences in ../shared.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import av
import render
from clips import EXAMPLES, SEQUENCES, ffmpeg, ffmpeg_input
from results import Value, add_results, read_rows, save
from rich.console import Console
from rich.progress import Progress

from colmap_av1 import ColmapAv1Error, ReadOptions, _core, read_motion
from colmap_av1.video.container import open_stream

LIBAOM = "-c:v libaom-av1 -usage realtime -cpu-used 6 -lag-in-frames 0 -row-mt 1 -b:v 0"
SVT_AV1 = "-c:v libsvtav1 -preset 8"
# Upscaled from 640x480, so it lacks the detail of a real 1080p camera.
TO_1080P = "-frames:v 120 -vf scale=1920:1440:flags=lanczos,crop=1920:1080"

SOURCES = {
    "street": ("street", ""),
    "log_building": ("log_building", ""),
    "1080p": ("kitchen", TO_1080P),
}
ENCODERS = {"aom": LIBAOM, "svt": SVT_AV1}
RATES = (20, 40)


@dataclass(frozen=True)
class Clip:
    """A clip of the benchmark; `sequence` is None for the example clip, which exists."""

    name: str
    sequence: str | None = None
    encoding: str = ""


CLIPS = [
    Clip("scene"),
    *(
        Clip(f"{source}-{encoder}{rate}", sequence, f"{filters} {words} -crf {rate} -g 9999")
        for source, (sequence, filters) in SOURCES.items()
        for encoder, words in ENCODERS.items()
        for rate in RATES
    ),
    # Clips that can be read in parallel: with several key frames, and with tiles.
    Clip("street-keys", "street", f"{LIBAOM} -crf 20 -g 9"),
    Clip("1080p-keys", "kitchen", f"{TO_1080P} {LIBAOM} -crf 20 -g 20"),
    Clip("1080p-tiles", "kitchen", f"{TO_1080P} {LIBAOM} -crf 20 -g 9999 -tiles 2x2"),
]


@dataclass(frozen=True)
class Timing:
    """Medians in seconds for the whole clip; `reader` and `dav1d` by number of threads.

    `gain` is the speed-up of the reader's wall time with more threads. Times with one thread are
    CPU times.
    """

    clip: str
    frames: int
    megabits: float
    reader: dict[int, float]
    dav1d: dict[int, float]
    gain: dict[int, float]
    demux: float
    parse: float


def main() -> int:
    """Create missing clips, time each, and print a table."""
    parser = argparse.ArgumentParser(
        description="Compare the time to read motion with decoding by dav1d.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--cache", type=Path, help="folder that keeps the clips [a temporary one]")
    parser.add_argument("--repeats", type=int, default=5, help="number of runs of each")
    parser.add_argument(
        "--clips",
        nargs="+",
        default=[""],
        metavar="NAME",
        help=f"only clips whose names have one of these parts: {', '.join(c.name for c in CLIPS)}",
    )
    parser.add_argument(
        "--threads", type=int, nargs="+", default=[1, 2], help="numbers of threads to time"
    )
    add_results(parser, "read_motion")
    arguments = parser.parse_args()
    if arguments.repeats < 1 or min(arguments.threads) < 1:
        parser.error("--repeats and --threads start at 1")
    clips = [clip for clip in CLIPS if any(word in clip.name for word in arguments.clips)]
    if not clips:
        parser.error(f"no clip has a name like {' '.join(arguments.clips)}: see --help")

    threads = sorted(set(arguments.threads))
    timings = []
    skipped = []
    with contextlib.ExitStack() as stack:
        folder = arguments.cache or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        folder.mkdir(parents=True, exist_ok=True)
        progress = stack.enter_context(
            Progress(console=Console(stderr=True), transient=True, disable=not sys.stderr.isatty())
        )
        task = progress.add_task("", total=len(clips))
        for clip in clips:
            try:
                progress.update(task, description=f"making {clip.name}")
                path = make_clip(clip, folder)
                progress.update(task, description=f"timing {clip.name}")
                timings.append(time_clip(clip.name, path, threads, arguments.repeats))
            except FileNotFoundError as error:
                skipped.append(f"{clip.name}: skipped, {error}")
            except (ColmapAv1Error, RuntimeError) as error:
                print(f"error: {clip.name}: {error}", file=sys.stderr)
                return 1
            progress.advance(task)
    save(arguments.results, [r for t in timings for r in figures(t)], ("clip", "threads"))
    measured = {timing.clip for timing in timings}
    rows = [row for row in read_rows(arguments.results) if row["clip"] in measured]
    for n in threads:
        print(render.read_motion(rows, str(n)))
    print(conditions(arguments.repeats))
    for line in skipped:
        print(line)
    return 0


def make_clip(clip: Clip, folder: Path) -> Path:
    """The file of a clip, encoded in `folder` if it is missing.

    Raises:
        FileNotFoundError: the sequence does not exist.
        RuntimeError: ffmpeg failed.
    """
    if clip.sequence is None:
        return EXAMPLES / "scene.mp4"
    path = folder / f"{clip.name}.mp4"
    if path.exists():
        return path
    sequence = SEQUENCES / clip.sequence
    source = sequence / "clip.mp4"
    if not source.is_file():
        source = sequence / "frames"
    if not source.exists():
        raise FileNotFoundError(f"no sequence at {sequence}")
    unfinished = path.with_suffix(".part.mp4")
    encoding = [*clip.encoding.split(), "-pix_fmt", "yuv420p", "-an"]
    try:
        ffmpeg(*ffmpeg_input(source, 25), *encoding, str(unfinished))
    except subprocess.CalledProcessError as error:
        unfinished.unlink(missing_ok=True)
        raise RuntimeError(f"ffmpeg failed: {error.returncode}") from error
    unfinished.replace(path)
    return path


def time_clip(name: str, path: Path, threads: list[int], repeats: int) -> Timing:
    """Run all tasks alternately, once for warm-up and then `repeats` times."""
    with open_stream(path) as stream:
        configuration = stream.configuration
        packets = [bytes(packet.data) for packet in stream.packets()]
    units = [configuration, *packets] if configuration else packets
    runs: dict[tuple[str, int], Callable[[], int]] = {
        ("demux", 1): partial(demux, path),
        ("parse", 1): partial(parse, units),
    }
    for n in threads:
        runs["reader", n] = partial(read, path, n)
        runs["dav1d", n] = partial(decode, path, n)

    frames = {key: run() for key, run in runs.items()}
    shown = frames["dav1d", threads[0]]
    real: dict[tuple[str, int], list[float]] = {key: [] for key in runs}
    used: dict[tuple[str, int], list[float]] = {key: [] for key in runs}
    for turn in range(repeats):
        # Alternate the order, so that each task benefits equally from warm caches.
        for key in list(runs)[:: -1 if turn % 2 else 1]:
            start = time.perf_counter(), time.process_time()
            runs[key]()
            real[key].append(time.perf_counter() - start[0])
            used[key].append(time.process_time() - start[1])

    def median(what: str, n: int = 1) -> float:
        return statistics.median((used if n == 1 else real)[what, n])

    alone = statistics.median(real["reader", threads[0]])
    return Timing(
        clip=name,
        frames=shown,
        megabits=sum(map(len, packets)) * 8 / 1e6,
        reader={n: median("reader", n) for n in threads},
        dav1d={n: median("dav1d", n) for n in threads},
        gain={n: alone / statistics.median(real["reader", n]) for n in threads},
        demux=median("demux"),
        parse=median("parse"),
    )


def read(path: Path, threads: int) -> int:
    """Read the motion of a file; returns the number of coded frames."""
    return count(read_motion(path, ReadOptions(num_threads=threads)))


def demux(path: Path) -> int:
    """Read the packets of a file; returns their number."""
    with open_stream(path) as stream:
        return count(stream.packets())


def parse(units: list[bytes]) -> int:
    """Parse temporal units without creating arrays; returns the number of frames."""
    parser = _core.Parser(num_threads=1)
    frames = 0
    for unit in units:
        position = 0
        while position < len(unit):
            event, position = parser.parse(unit, position)
            frames += event is not None
    parser.finish()
    return frames


def decode(path: Path, threads: int) -> int:
    """Decode a file with dav1d; returns the number of pictures."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        decoder = av.CodecContext.create("libdav1d", "r")
        assert isinstance(decoder, av.VideoCodecContext)
        decoder.extradata = stream.codec_context.extradata
        decoder.thread_count = threads
        pictures = 0
        for packet in container.demux(stream):
            pictures += len(decoder.decode(packet if packet.size else None))
        return pictures


def count(items: Iterator[object]) -> int:
    """Number of items of an iterator."""
    return sum(1 for _ in items)


def figures(timing: Timing) -> list[dict[str, Value]]:
    """A row for each number of threads, in milliseconds per shown frame."""
    per_frame = 1e3 / timing.frames
    return [
        {
            "clip": timing.clip,
            "threads": n,
            "megabits": timing.megabits,
            "read_motion_ms": timing.reader[n] * per_frame,
            "dav1d_ms": timing.dav1d[n] * per_frame,
            "gain": timing.gain[n] if n > min(timing.gain) else None,
            "parse_ms": timing.parse * per_frame if n == 1 else None,
            "demux_ms": timing.demux * per_frame if n == 1 else None,
        }
        for n in timing.reader
    ]


def conditions(repeats: int) -> str:
    """Explanation of the figures, and versions of the libraries."""
    load = f", load average {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    return (
        f"Milliseconds per shown frame, medians of {repeats} alternating runs: CPU time with one "
        "thread, wall time with more. Parse: the share of the parser in the reader's time with one "
        "thread. Gain: speed-up of the reader with more threads.\n"
        f"Python {platform.python_version()}, PyAV {av.__version__} with FFmpeg "
        f"{av.ffmpeg_version_info} and its libdav1d{load}."
    )


if __name__ == "__main__":
    sys.exit(main())

"""Measure the memory for reading the motion of a long 4K video.

python examples/benchmarks/read_memory.py --cache benchmark_clips

The script encodes 100 frames of 3840x2160, repeats their packets up to the given number of frames,
reads the result frame by frame in a separate process, and reports the peak memory of that process.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import imageio_ffmpeg
import render
from results import add_results, read_rows, save

from colmap_av1 import ReadOptions, read_motion

ENCODED = 100
SOURCE = "testsrc2=size=3840x2160:rate=25"


def main() -> int:
    """Create the video if it is missing, read it, and print one line."""
    parser = argparse.ArgumentParser(
        description="Measure the memory of reading a long 4K video.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--cache", type=Path, help="folder that keeps the video")
    parser.add_argument("--frames", type=int, default=2000)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--read", type=Path, help=argparse.SUPPRESS)
    add_results(parser, "read_memory")
    arguments = parser.parse_args()
    if arguments.read is not None:
        return read(arguments.read, arguments.threads)
    with contextlib.ExitStack() as stack:
        folder = arguments.cache or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        folder.mkdir(parents=True, exist_ok=True)
        video = make_video(folder, arguments.frames)
        words = ["--threads", str(arguments.threads), "--read", str(video)]
        command = [sys.executable, __file__, *words]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    peak, before = map(float, done.stdout.split())
    row = {"frames": arguments.frames, "threads": arguments.threads}
    row |= {"peak_MB": round(peak), "before_reading_MB": round(before)}
    save(arguments.results, [row], ("frames", "threads"))
    print(render.plain(read_rows(arguments.results)), end="")
    return 0


def make_video(folder: Path, frames: int) -> Path:
    """The video with `frames` frames, created in `folder` if it is missing."""
    ffmpeg = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-nostdin", "-y"]
    clip = folder / "4k.mp4"
    if not clip.exists():
        encoding = f"-frames:v {ENCODED} -c:v libsvtav1 -preset 12 -crf 35 -pix_fmt yuv420p"
        subprocess.run(
            [*ffmpeg, "-f", "lavfi", "-i", SOURCE, *encoding.split(), str(clip)],
            env=os.environ | {"SVT_LOG": "1"},  # Print errors only.
            check=True,
        )
    video = folder / f"4k-{frames}.mp4"
    if not video.exists():
        loops = str(-(-frames // ENCODED) - 1)
        repeat = ["-stream_loop", loops, "-i", str(clip), "-c", "copy", "-frames:v", str(frames)]
        subprocess.run([*ffmpeg, *repeat, str(video)], check=True)
    return video


def read(video: Path, threads: int) -> int:
    """Read a video frame by frame; print the peak memory in MB after and before reading."""
    before = peak_mb()
    for _ in read_motion(video, ReadOptions(num_threads=threads)):
        pass
    print(peak_mb(), before)
    return 0


def peak_mb() -> float:
    """Peak resident memory of this process in MB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1e6 if sys.platform == "darwin" else 1e3)


if __name__ == "__main__":
    sys.exit(main())

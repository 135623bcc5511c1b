"""Measure the errors due to a rolling shutter, with and without estimating its read-out time.

python examples/benchmarks/rolling_shutter.py --cache benchmark_shutter

The script renders a hand-held walk and a hand-held pan in a room, 50 frames of 480x360 at 25 per
second, with read-out times of 0, 5, 15 and 30 ms. It encodes the clips as AV1 and reconstructs each
with and without `--rolling_shutter estimate`. The intrinsics are given.
"""

from __future__ import annotations

import argparse
import contextlib
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
import pycolmap
import render
import room
from clips import load_render_scene
from numpy.typing import NDArray
from results import add_results, read_rows, save

from colmap_av1.geometry.colmap_model import camera_centres, posed_images, read_model

Floats = NDArray[np.float64]

SCRIPT = load_render_scene()
WIDTH, HEIGHT, FOCAL = 480, 360, 400.0
NUM_FRAMES, RATE = 50, 25
READ_OUTS = (0, 5, 15, 30)
CLIPS = ("walk", "pan")


def poses(clip: str, t: Floats) -> Floats:
    """Poses [n, 3, 4] of a clip at times [n] in seconds."""
    seeds = map(np.random.default_rng, range(6))
    x, y, z, yaw, pitch, roll = (SCRIPT.unsteady(t, seed) for seed in seeds)
    if clip == "walk":
        centre = np.column_stack([0.9 * t - 2 + 0.02 * x, 0.02 * y - 2.2, 1.55 + 0.03 * z])
        angles = 2 + 1.4 * yaw, 1.2 * pitch - 4, 0.6 * roll
    else:
        centre = np.column_stack([0.35 * t - 1 + 0.01 * x, 0.01 * y - 2.2, 1.55 + 0.01 * z])
        angles = 22 * t - 22 + 0.8 * yaw, 0.8 * pitch - 4, 0.6 * roll
    a, b, c = (np.radians(angle) for angle in angles)
    ahead = np.column_stack([np.sin(a) * np.cos(b), np.cos(a) * np.cos(b), np.sin(b)])
    level = room.look(centre, centre + ahead)
    one, none = np.ones_like(c), np.zeros_like(c)
    rows = [[np.cos(c), -np.sin(c), none], [np.sin(c), np.cos(c), none], [none, none, one]]
    return np.asarray(np.array(rows).transpose(2, 0, 1) @ level)


def make_clip(path: Path, clip: str, read_out: float) -> None:
    """Render and encode a clip if it is missing; the read-out time is in milliseconds."""
    if path.exists():
        return
    params = [FOCAL, WIDTH / 2, HEIGHT / 2]
    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=WIDTH, height=HEIGHT, params=params)
    rays, textures = room.rays_of(camera, 1), room.make_textures()
    rows = ((np.arange(HEIGHT) + 0.5) / HEIGHT - 0.5) * read_out / 1000
    frames = (room.render(rays, poses(clip, k / RATE + rows), textures) for k in range(NUM_FRAMES))
    source = f"-f rawvideo -pix_fmt bgr24 -s {WIDTH}x{HEIGHT} -r {RATE} -i -"
    coding = "-c:v libaom-av1 -usage realtime -cpu-used 6 -lag-in-frames 0 -crf 20 -b:v 0 -g 9999"
    program = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-y", *source.split()]
    partial = path.with_suffix(".partial.mp4")
    with subprocess.Popen(
        [*program, "-pix_fmt", "yuv420p", *coding.split(), str(partial)], stdin=subprocess.PIPE
    ) as process:
        assert process.stdin is not None
        for frame in frames:
            process.stdin.write(frame.tobytes())
    if process.returncode:
        raise RuntimeError(f"ffmpeg could not encode {path}")
    partial.rename(path)


def measure(video: Path, output: Path, clip: str, how: str) -> dict[str, Any]:
    """Reconstruct a clip, and measure read-out time, reprojection and centre errors, CPU time."""
    words = ["--video", str(video), "--output", str(output), "--every", "2", "--points", "survey"]
    words += ["--camera_model", "SIMPLE_PINHOLE"]
    words += [f"--camera_params={FOCAL},{WIDTH / 2},{HEIGHT / 2}", "--rolling_shutter", how]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [sys.executable, "-m", "colmap_av1", "reconstruct", *words],
        check=True,
        capture_output=True,
        text=True,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    rows = dict(line.split("\t", 1) for line in done.stdout.splitlines() if "\t" in line)
    images = posed_images(read_model(output / "sparse" / "0"))
    frames = np.array([int(name[6:12]) for name in images])
    found = camera_centres(np.array([image.cam_from_world for image in images.values()]))
    exact = camera_centres(poses(clip, frames / RATE))
    return {
        "found": float(rows["rolling shutter"].split()[0]) if "rolling shutter" in rows else None,
        "images": len(images),
        "error_px": float(rows["reprojection error"].split()[0]),
        "ate_mm": 1000 * centre_error(found, exact),
        "cpu_s": sum(
            getattr(after, name) - getattr(before, name) for name in ("ru_utime", "ru_stime")
        ),
    }


def centre_error(found: Floats, exact: Floats) -> float:
    """RMS distance of camera centres after similarity alignment (Umeyama 1991)."""
    fit = pycolmap.estimate_sim3d(found, exact)
    assert fit is not None
    moved = fit.scale * found @ fit.rotation.matrix().T + fit.translation
    return float(np.sqrt(((moved - exact) ** 2).sum(axis=1).mean()))


def main() -> int:
    """Render missing clips, reconstruct, and print the table."""
    parser = argparse.ArgumentParser(description="Measure errors due to a rolling shutter.")
    parser.add_argument("--cache", type=Path, help="folder that keeps the clips")
    add_results(parser, "rolling_shutter")
    arguments = parser.parse_args()
    with contextlib.ExitStack() as stack:
        scratch = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        folder = arguments.cache or scratch
        folder.mkdir(parents=True, exist_ok=True)
        for clip in CLIPS:
            for read_out in READ_OUTS:
                video = folder / f"{clip}_{read_out}ms.mp4"
                make_clip(video, clip, read_out)
                none, found = (
                    measure(video, scratch / f"{video.stem}_{how}", clip, how)
                    for how in ("none", "estimate")
                )
                row = {"clip": clip, "read_out_ms": read_out, "found_ms": found["found"]}
                for name in ("images", "error_px", "ate_mm", "cpu_s"):
                    row |= {f"{name}_none": none[name], f"{name}_estimate": found[name]}
                save(arguments.results, [row], ("clip", "read_out_ms"))
    print(render.rolling_shutter(read_rows(arguments.results)), end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())

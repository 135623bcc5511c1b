"""Render a clip of any length that resembles the video of a phone, with exact poses.

python examples/benchmarks/phone_clip.py --seconds 10 --cache benchmark_phone

The camera walks back and forth in the courtyard of `render_scene.py`, at 1920x1080 and 30 frames
per second, with hand shake, motion blur of 1/60 s, sensor noise, and H.264 at 16 Mbit/s with a key
frame every second. Rendering a second takes a minute or two; seconds in the cache are not rendered
again, and a longer clip begins like a shorter one. At most 30 s are rendered; longer clips repeat
them backwards, forwards, and so on.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import clips as ruler
import cv2
import imageio_ffmpeg
import numpy as np
from numpy.typing import NDArray

from colmap_av1.util.files import whole_file

SCRIPT = ruler.load_render_scene()
SIZE = (1920, 1080)
FOCAL = 1560.0
FPS = 30
# Seconds from one end of the path to the other, and the angles of its ends around the scene.
_SWEEP = 6.0
_ANGLES = (-22.0, 20.0)
_EXPOSURE = 1 / 60
_SAMPLES = 2  # Number of samples over the exposure.
# Standard deviation of the sensor noise in grey levels, and blur of the noise by demosaicing.
_NOISE, _SPREAD = 4.0, 0.6
_SEED = 20240301
# Largest number of seconds that are rendered.
_RENDERED = 30
PHONE = "-c:v libx264 -preset veryfast -b:v 16M -maxrate 24M -bufsize 24M -g 30 -bf 0"
_LOSSLESS = "-c:v libx264 -preset ultrafast -qp 0"


def main() -> int:
    """Render a clip, and print its path."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=int, default=10)
    parser.add_argument("--cache", type=Path, required=True, help="folder for clips")
    arguments = parser.parse_args()
    print(phone_clip(arguments.cache, arguments.seconds))
    return 0


def phone_clip(cache: Path, seconds: int) -> Path:
    """The clip with the given length; missing seconds are rendered into the cache."""
    video = cache / f"phone_{seconds}s.mp4"
    if video.exists():
        return video
    cache.mkdir(parents=True, exist_ok=True)
    parts = [_second(cache, number) for number in range(seconds)]
    listed = cache / f"parts_{seconds}s.txt"
    listed.write_text("".join(f"file '{part.absolute()}'\n" for part in parts))
    with whole_file(video) as partial:
        words = ["-f", "concat", "-safe", "0", "-i", str(listed), *PHONE.split()]
        ruler.ffmpeg(*words, "-pix_fmt", "yuv420p", "-f", "mp4", str(partial))
    listed.unlink()
    return video


def poses_at(seconds: NDArray[np.float64]) -> NDArray[np.float64]:
    """[n, 3, 4] cam_from_world poses at given times, of a hand-held camera on an arc."""
    along = (1 - np.cos(math.pi * seconds / _SWEEP)) / 2
    angle = np.radians(_ANGLES[0] + (_ANGLES[1] - _ANGLES[0]) * along)
    shift, turn = SCRIPT.hand_held(seconds, np.random.default_rng(_SEED))
    # The distance changes with time, so that the way back differs.
    radius = 4.8 - 0.25 * np.sin(2 * math.pi * seconds / (2.7 * _SWEEP))
    height = 1.6 + 0.15 * np.sin(2 * math.pi * seconds / (3.3 * _SWEEP))
    target = np.array([0.10, 0.35, 0.62])
    poses = np.empty((len(seconds), 3, 4))
    for k in range(len(seconds)):
        orbit = np.array([math.sin(angle[k]), -math.cos(angle[k]), 0]) * radius[k]
        centre = np.array([0.1, 0.35, height[k]]) + orbit + shift[k]
        poses[k] = SCRIPT.look(centre, target, turn[k])
    return poses


def true_poses(num_frames: int) -> NDArray[np.float64]:
    """[n, 3, 4] poses of the first frames, at the middle of their exposure."""
    sweep, frame = np.divmod(np.arange(num_frames), _RENDERED * FPS)
    return poses_at(np.where(sweep % 2, _RENDERED * FPS - 1 - frame, frame) / FPS)


@functools.cache
def _painted() -> tuple[Any, list[Any]]:
    """The scene at this size, and its textures."""
    SCRIPT.SUPERSAMPLE = 1
    width, height = SIZE
    scene = dataclasses.replace(
        SCRIPT.build_scene(),
        **{"width": width, "height": height, "fx": FOCAL, "fy": FOCAL},
        **{"cx": width / 2, "cy": height / 2},
    )
    return scene, [SCRIPT._texture(scene, k) for k in range(len(scene.surfaces))]


def _picture(frame: int) -> NDArray[np.uint8]:
    """Picture of a frame, uint8 [height, width, 3] RGB, with motion blur and noise."""
    scene, textures = _painted()
    times = frame / FPS + _EXPOSURE * ((np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5)
    rng = np.random.default_rng((_SEED, frame))
    total = np.zeros((scene.height, scene.width, 3), np.float32)
    for number, pose in enumerate(poses_at(times)):
        # Samples also vary in position within the pixel.
        inside = ((number + 0.5) / _SAMPLES - 0.5) * np.array([1, -1]) * 0.5
        shifted = dataclasses.replace(
            scene,
            cam_from_world=pose[None],
            cx=scene.cx - inside[0],
            cy=scene.cy - inside[1],
        )
        total += SCRIPT.render_frame(shifted, textures, 0)
    noise = rng.standard_normal(total.shape, np.float32)
    noise = cv2.GaussianBlur(noise, (0, 0), _SPREAD)
    noise *= _NOISE / noise.std()
    return np.asarray(np.clip(np.round(total / _SAMPLES + noise), 0, 255).astype(np.uint8))


def _second(cache: Path, number: int) -> Path:
    """A second of the clip, reversed in every other repetition."""
    sweep, own = divmod(number, _RENDERED)
    if sweep % 2 == 0:
        return _rendered_second(cache, own)
    forwards = _rendered_second(cache, _RENDERED - 1 - own)
    part = forwards.with_name(f"back_{forwards.name}")
    if not part.exists():
        with whole_file(part) as partial:
            words = ["-i", str(forwards), "-vf", "reverse", *_LOSSLESS.split()]
            ruler.ffmpeg(*words, "-f", "mp4", str(partial))
    return part


def _rendered_second(cache: Path, number: int) -> Path:
    part = cache / f"second_{number:03d}.mp4"
    if part.exists():
        return part
    width, height = SIZE
    with whole_file(part) as partial:
        command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-y", "-f", "rawvideo"]
        command += ["-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(FPS), "-i", "-"]
        command += ["-vf", "scale=out_color_matrix=bt709:out_range=tv", *_LOSSLESS.split()]
        command += ["-colorspace", "bt709", "-pix_fmt", "yuv420p", "-f", "mp4", str(partial)]
        with subprocess.Popen(command, stdin=subprocess.PIPE) as process:
            assert process.stdin is not None
            for frame in range(number * FPS, (number + 1) * FPS):
                process.stdin.write(_picture(frame).tobytes())
            process.stdin.close()
        if process.returncode != 0:
            raise RuntimeError(f"ffmpeg could not write {part}")
    return part


if __name__ == "__main__":
    sys.exit(main())

"""Measure models of walks with fast turns: one model, several accurate models, or a bent model.

python examples/benchmarks/walks.py --cache benchmark_walks

The script renders walks through three furnished rooms with plain walls, 320x240 at 25 frames per
second. At the doors, the camera turns by 8 to 12 degrees per frame, with motion blur of half a
frame. Each walk has its own furniture, turns and speed. True poses are known, intrinsics are not
given. `reconstruct` runs with its defaults, and so does COLMAP's incremental mapper on the database
of `match`, and on SIFT features of all frames, matched sequentially. A model is bent if its camera
centres have an error of more than 2 % of their extent.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pycolmap
import render
import room
from mapping import map_incrementally
from numpy.typing import NDArray
from results import add_results, read_rows, save
from sequences import model_poses

from colmap_av1 import ColmapAv1Error, match, reconstruct
from colmap_av1.evaluate import pose_errors
from colmap_av1.geometry.colmap_model import read_model
from colmap_av1.images.files import write_images

Floats = NDArray[np.float64]

WIDTH, HEIGHT, FOCAL, RATE = 320, 240, 240.0, 25
WALLS = np.array([[-9.0, -3.0, 0.0], [9.0, 3.0, 2.7]])
DOORS = (-3.0, 3.0)  # x of the walls between the rooms
BENT = 0.02
# Number of samples over the exposure of a blurred frame.
NUM_BLURRED = 3
# Number of different textures. They are stacked, and cv2.remap accepts at most 32767 rows.
NUM_FACES = 60
SIFT, RECONSTRUCT, MATCH = WAYS = ("SIFT sequential, mapper", "reconstruct", "match, mapper")
PLAIN = 3.0  # standard deviation of plain walls in grey levels


@dataclass(frozen=True)
class Row:
    """The models of a walk.

    Attributes:
        walk: seed of the walk.
        way: how the models were made, one of `WAYS`.
        images: number of chosen images.
        registered: number of registered images of each model, in the order of their folders.
        errors: error of the camera centres of each model, as a share of their extent.
        warnings: warnings of `reconstruct` or `match`; none with SIFT.
    """

    walk: str
    way: str
    images: int
    registered: str
    errors: str
    warnings: str


def main() -> int:
    """Make the models of each walk, and save and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cache", type=Path, required=True, help="folder for clips and models")
    parser.add_argument("--walks", nargs="+", type=int, default=list(range(20)))
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=WAYS, metavar="WAY")
    add_results(parser, "walks")
    arguments = parser.parse_args()
    for seed in arguments.walks:
        folder = arguments.cache.resolve() / str(seed)
        video = folder / "walk.mp4"
        if not video.is_file():
            folder.mkdir(parents=True, exist_ok=True)
            make_clip(video, seed)
        for way in arguments.ways:
            save(arguments.results, [asdict(measure(video, seed, way))], ("walk", "way"))
    print(render.walks(read_rows(arguments.results)), end="")
    return 0


def measure(video: Path, seed: int, way: str) -> Row:
    """Make the models of a walk."""
    output = video.parent / {SIFT: "sift", RECONSTRUCT: "output", MATCH: "mapped"}[way]
    shutil.rmtree(output, ignore_errors=True)
    truth = walk(seed)
    num_images, warnings = len(truth), tuple[str, ...]()
    try:
        if way == RECONSTRUCT:
            report = reconstruct(video, output)
            num_images, warnings = report.num_images, report.warnings
            folders = [output, *(model.output for model in report.other_models)]
            made = [read_model(own / "sparse" / "0") for own in folders]
        else:
            output.mkdir()
            database, images = output / "walk.db", output / "images"
            if way == MATCH:
                matched = match(database, video, image_path=images)
                num_images, warnings = matched.num_images, matched.warnings
                command = matched.next_commands[0]
            else:
                frames = range(len(truth))
                write_images(video, images, [f"{frame:06d}.png" for frame in frames], frames)
                one = pycolmap.CameraMode.SINGLE
                pycolmap.extract_features(database, images, camera_mode=one)
                pycolmap.match_sequential(database)
                command = ""
            map_incrementally(database, images, output / "models", command)
            folders = sorted((output / "models").iterdir(), key=lambda own: int(own.name))
            made = [read_model(own) for own in folders]
    except ColmapAv1Error as error:
        return Row(str(seed), way, 0, "", "", str(error))
    models = [model_poses(own, len(truth)) for own in made]
    errors = [pose_errors(own, truth) for own in models]
    return Row(
        str(seed),
        way,
        num_images,
        " + ".join(str(int(np.isfinite(own[:, 0, 0]).sum())) for own in models),
        " + ".join("-" if own is None else f"{own.ate / own.extent:.2%}" for own in errors),
        "; ".join(warnings),
    )


def walk(seed: int) -> Floats:
    """The poses of a walk, float64 [num_frames, 3, 4]."""
    return _poses(*_path(seed))


def _path(seed: int) -> tuple[Floats, Floats]:
    """Camera centres, float64 [n, 3] in metres, and yaw, float64 [n] in degrees."""
    rng = np.random.default_rng(seed)
    speed = rng.uniform(0.03, 0.06)
    yaw, x = [0.0], [rng.uniform(-8.0, -7.0)]

    def turn(to: float, moving: float) -> None:
        frames = max(1, round(abs(to - yaw[-1]) / rng.uniform(8, 12)))
        start = yaw[-1]
        for k in range(1, frames + 1):
            yaw.append(start + (to - start) * k / frames)
            x.append(x[-1] + moving)

    def ahead(frames: int) -> None:
        for _ in range(frames):
            yaw.append(yaw[-1])
            x.append(x[-1] + speed)

    for _ in range(2):
        ahead(int(rng.integers(15, 30)))
        side = float(rng.choice([-90, 90]))
        turn(side, 0.3 * speed)
        ahead(int(rng.integers(8, 16)))
        if rng.random() < 0.5:
            turn(-side, 0.3 * speed)
            ahead(int(rng.integers(8, 16)))
        turn(0.0, 0.3 * speed)
    ahead(20)
    seconds = np.arange(len(x)) / RATE
    sway = [
        sum(np.sin(2 * np.pi * (f * seconds + rng.random())) / f for f in (0.7, 1.6, 3.0))
        for _ in range(3)
    ]
    centre = np.column_stack([x, 0.03 * sway[0], 1.55 + 0.02 * sway[1]])
    return centre, np.array(yaw) + 0.6 * sway[2]


def _poses(centre: Floats, yaw: Floats) -> Floats:
    angle = np.radians(yaw)
    ahead = np.column_stack([np.cos(angle), np.sin(angle), np.full(len(yaw), -0.05)])
    return room.look(centre, centre + ahead)


def furniture(seed: int) -> Floats:
    """Boxes of the furniture and of the walls between the rooms, float64 [n, 2, 3]."""
    rng = np.random.default_rng(1000 + seed)
    boxes = []
    for x in DOORS:
        boxes += [
            [[x - 0.1, -3.0, 0.0], [x + 0.1, -0.6, 2.7]],
            [[x - 0.1, 0.6, 0.0], [x + 0.1, 3.0, 2.7]],
            [[x - 0.1, -0.6, 2.1], [x + 0.1, 0.6, 2.7]],
        ]
    for _ in range(16):
        size = rng.uniform(0.3, 1.0, 3) * [1, 1, 2]
        side = rng.choice([-1, 1])
        at = np.array([rng.uniform(-8.5, 8.0), side * rng.uniform(1.2, 2.2), 0.0])
        low = at - [0, size[1] / 2, 0]
        boxes.append([low, low + size])
    return np.array(boxes)


def textures() -> NDArray[np.float32]:
    """Textures of the faces, see `room.render`: the outer walls and some boxes are plain."""
    made = room.make_textures(NUM_FACES)
    made[:3] = 128 + (made[:3] - 128) * np.float32(PLAIN / 38)
    return made


def pictures(seed: int) -> Iterator[NDArray[np.uint8]]:
    """The frames of a walk, uint8 [HEIGHT, WIDTH, 3], BGR."""
    camera = pycolmap.Camera(
        model="PINHOLE",
        width=WIDTH,
        height=HEIGHT,
        params=[FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2],
    )
    rays = room.rays_of(camera, samples=1)
    boxes = furniture(seed)
    faces = textures()
    centre, yaw = _path(seed)
    rng = np.random.default_rng(3000 + seed)
    for k in range(len(yaw)):
        step = yaw[k] - yaw[max(k - 1, 0)]
        parts = NUM_BLURRED if abs(step) > 1 else 1
        angles = yaw[k] + step * 0.5 * (np.arange(parts) / parts - (parts - 1) / (2 * parts))
        seen = [
            room.render(rays, np.repeat(own[None], HEIGHT, 0), faces, walls=WALLS, boxes=boxes)
            for own in _poses(np.repeat(centre[k][None], parts, 0), angles)
        ]
        noisy = np.mean(seen, axis=0) + rng.normal(0, 2.0, (HEIGHT, WIDTH, 3))
        yield np.clip(noisy.round(), 0, 255).astype(np.uint8)


def make_clip(path: Path, seed: int, num_frames: int | None = None) -> None:
    """Render the first frames of a walk, and encode them as H.264, as phones do."""
    raw = f"-f rawvideo -pix_fmt bgr24 -s {WIDTH}x{HEIGHT} -r {RATE} -i -".split()
    encoder = ["-c:v", "libx264", "-crf", "18", "-pix_fmt", "yuv420p"]
    subprocess.run(
        [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-v", "error", *raw, *encoder, str(path)],
        input=b"".join(picture.tobytes() for picture in islice(pictures(seed), num_frames)),
        check=True,
    )


if __name__ == "__main__":
    sys.exit(main())

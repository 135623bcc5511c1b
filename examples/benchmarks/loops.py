"""Measure whether true loops are closed, and no false ones, on two rendered clips.

python examples/benchmarks/loops.py --cache benchmark_loops

`rounds`: a hand-held camera goes twice around the objects of the example's courtyard, 600 frames of
640x360 with noise. `fronts`: it moves along a street of identical house fronts, 400 frames, and
never returns to a place. The true poses are known. `reconstruct` gets the whole clip, and every
fifth frame of it; SIFT, matched exhaustively and mapped by COLMAP, gets the same fifth. A pair of
images is false if the median distance of its inliers to the true epipolar lines exceeds 3 px.
Rendering takes 15 minutes of CPU time; clips are kept in the cache.
"""

from __future__ import annotations

import argparse
import math
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap
import render
from clips import load_render_scene
from numpy.typing import NDArray
from results import Value, add_results, read_rows, save
from sequences import measure_frontend, model_poses, prepare_footage

from colmap_av1 import CameraOptions, ImageOptions, MatchOptions, ReconstructOptions, reconstruct
from colmap_av1.evaluate import measure_mapper, pose_errors, run_measured
from colmap_av1.geometry.colmap_model import camera_centres, read_model

SCRIPT = load_render_scene()
NUM_FRAMES = {"rounds": 600, "fronts": 400}
WAYS = ("reconstruct", "reconstruct, every 5th", "SIFT exhaustive, every 5th")
STEP = 5
NOISE = 2.0  # Standard deviation in grey levels.
# Images with at least this many frames between them share a view only in a loop.
FAR = 90
# A pair is false if the median distance of its inliers to the true epipolar lines is larger.
FALSE = 3.0

Floats = NDArray[np.float64]


def shake(num_frames: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Shake of a hand-held camera: shifts (m) and rotation vectors, each [num_frames, 3]."""
    seconds = np.arange(num_frames) / SCRIPT.FPS

    def wobble(amplitude: float) -> Floats:
        total = np.zeros(num_frames)
        for hertz, share in ((0.7, 1.0), (1.7, 0.42), (3.1, 0.16), (5.3, 0.05)):
            detune, phase = rng.uniform(0.85, 1.15), rng.uniform(0, 2 * math.pi)
            total += share * np.sin(2 * math.pi * hertz * detune * seconds + phase)
        return amplitude * total

    shift = np.stack([wobble(0.020), wobble(0.015), wobble(0.018)], 1)
    return shift, np.radians(np.stack([wobble(0.45), wobble(0.40), wobble(0.55)], 1))


def look(centre: Floats, target: Floats, turn: Floats) -> Floats:
    """Pose [3, 4] of a camera that looks at a target, changed by a rotation vector."""
    ahead = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(ahead, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    rotation = cv2.Rodrigues(turn)[0] @ np.stack([right, np.cross(ahead, right), ahead])
    return np.column_stack([rotation, -rotation @ centre])


def wall(start: tuple[float, float], end: tuple[float, float], material: str) -> Any:
    """A vertical wall, 9 m high, that faces (0, 0, 2)."""
    a, b = np.array([*start, 9.0]), np.array([*end, 9.0])
    # Extend beyond the neighbouring wall and into the ground, so that no ray slips through by
    # rounding.
    margin = 0.04 * (b - a) / np.linalg.norm(b - a)
    a, b = a - margin, b + margin
    face = SCRIPT.Surface("quad", a, b - a, np.array([0, 0, -9.04]), material, 110.0, casts=False)
    middle = face.origin + (face.edge_u + face.edge_v) / 2
    return SCRIPT._outward(face, 2 * middle - np.array([0, 0, 2.0]))


def ground(corner: tuple[float, float], size: tuple[float, float], texels: float) -> Any:
    """The flagstone ground, from its corner of smallest x and largest y."""
    face = SCRIPT.Surface(
        "quad",
        np.array([*corner, 0.0]),
        np.array([size[0], 0.0, 0.0]),
        np.array([0.0, -size[1], 0.0]),
        "flagstones",
        texels,
        casts=False,
    )
    return SCRIPT._outward(face, np.array([0, 0, -1.0]))


def rounds() -> tuple[Any, dict[int, int]]:
    """The scene that the camera goes around twice; all surfaces have different textures."""
    things = SCRIPT.build_scene().surfaces[5:]  # Without ground, walls and pillar.
    corners = [(-10, -9.5), (-10.5, 3), (-6, 9.5), (2, 10), (10, 7), (10.3, -4), (5, -10)]
    materials = ("rubble", "plastered_brick", "ivy", "rubble", "plastered_brick", "ivy", "rubble")
    walls = [
        wall(corner, corners[(i + 1) % len(corners)], materials[i])
        for i, corner in enumerate(corners)
    ]
    num_frames = NUM_FRAMES["rounds"]
    shift, turn = shake(num_frames, np.random.default_rng(5))
    poses = []
    for k in range(num_frames):
        angle = 2 * math.pi * 2 * k / (num_frames - 1) * 1.03
        radius = 4.6 - 0.5 * k / num_frames + 0.3 * math.sin(3 * angle)
        height = 1.5 + 0.25 * math.sin(1.3 * angle) + 0.2 * k / num_frames
        centre = np.array([0.1 + radius * math.sin(angle), 0.35 - radius * math.cos(angle), height])
        poses.append(look(centre + shift[k], np.array([0.1, 0.35, 0.7]), turn[k]))
    surfaces = (ground((-11, 11), (22, 22), 110.0), *walls, *things)
    return SCRIPT.Scene(surfaces, np.array(poses)), {}


def fronts() -> tuple[Any, dict[int, int]]:
    """The street of identical fronts, and the index of each surface's copy in the first front."""
    length = 8.0
    surfaces = [ground((-12, 6), (70, 16), 60.0)]
    surfaces += [wall((56, -10), (56, 6), "rubble"), wall((-8, 6), (-8, -10), "ivy")]
    alike: dict[int, int] = {}
    for number in range(8):
        x = -8 + length * number
        face = SCRIPT.Surface(
            "quad",
            np.array([x, 5.0, 9.0]),
            np.array([length, 0, 0]),
            np.array([0, 0, -9.04]),
            "plastered_brick",
            110.0,
            casts=False,
        )
        front = [
            SCRIPT._outward(face, np.array([x + length / 2, 50.0, 2.0])),
            *SCRIPT._box((x + 1.2, 4.6), (0.6, 0.6, 2.4), 0, "ivy", texels=120),
            *SCRIPT._box((x + 4.0, 4.3), (1.2, 0.8, 1.0), 20, "crate", texels=120),
            *SCRIPT._box((x + 6.4, 4.5), (0.9, 0.9, 0.6), -10, "planter", texels=120),
        ]
        for surface in front:
            alike[len(surfaces)] = len(surfaces) - number * len(front)
            surfaces.append(surface)
    num_frames = NUM_FRAMES["fronts"]
    shift, turn = shake(num_frames, np.random.default_rng(5))
    poses = []
    for k in range(num_frames):
        centre = np.array([-2 + 42 * k / (num_frames - 1), -1.2, 1.6]) + shift[k]
        poses.append(look(centre, centre + np.array([0.25, 1.0, -0.06]), turn[k]))
    return SCRIPT.Scene(tuple(surfaces), np.array(poses)), alike


SCENES = {"rounds": rounds, "fronts": fronts}


def pictures(scene: Any, alike: dict[int, int]) -> Iterator[NDArray[np.uint8]]:
    """The frames in order, uint8 [height, width, 3] RGB, with sensor noise."""
    SCRIPT.SUPERSAMPLE = 2
    textures: list[Any] = []
    for serial in range(len(scene.surfaces)):
        first = alike.get(serial, serial)
        textures.append(textures[first] if first != serial else SCRIPT._texture(scene, serial))
    noise = np.random.default_rng(9)
    for frame in range(len(scene.cam_from_world)):
        shown = SCRIPT.render_frame(scene, textures, frame).astype(np.float32)
        shown += noise.normal(0, NOISE, shown.shape).astype(np.float32)
        yield np.clip(shown, 0, 255).astype(np.uint8)


def run_reconstruct(video: Path, output: Path, every: int | None) -> dict[str, Any]:
    """Reconstruct, like the command."""
    options = ReconstructOptions(match=MatchOptions(images=ImageOptions(every=every)))
    report = reconstruct(video, output, options=options)
    return {"images": report.num_images, "revisits": report.links.num_loop_closures}


def measure(clip: str, way: str, video: Path, scene: Any, folder: Path) -> dict[str, Value]:
    """The row of one way on a clip."""
    truth = scene.cam_from_world
    if way.startswith("SIFT"):
        footage = prepare_footage(
            video,
            folder / "footage",
            num_frames=len(truth),
            image_step=STEP,
            camera=CameraOptions(),
        )
        matched = measure_frontend("sift-exhaustive", footage, folder / "sift")
        database = matched.database
        mapped = measure_mapper(database, footage.image_path, folder / "sift-model")
        if mapped.model is None:
            raise RuntimeError(f"{clip}: SIFT made no model: see {folder / 'sift-model'}")
        model, cpu = mapped.model, (matched.cpu_seconds or 0.0) + (mapped.cpu_seconds or 0.0)
        facts: dict[str, Any] = {"images": len(footage.names), "revisits": None}
    else:
        output = folder / way.replace(", ", "_").replace(" ", "_")
        shutil.rmtree(output, ignore_errors=True)
        every = STEP if "every" in way else None
        run = run_measured(run_reconstruct, video, output, every, log=output.with_suffix(".log"))
        database, model = output / "database.db", output / "sparse" / "0"
        facts, cpu = run.result, run.cpu_seconds
    made = read_model(model)
    errors = pose_errors(model_poses(made, len(truth)), truth)
    path = np.linalg.norm(np.diff(camera_centres(truth), axis=0), axis=1).sum()
    return {
        "clip": clip,
        "way": way,
        **facts,
        "registered": made.num_reg_images(),
        "ate": None if errors is None else errors.ate,
        "ate_of_path": None if errors is None else 100 * errors.ate / float(path),
        **false_pairs(database, scene),
        "cpu_s": cpu,
    }


def false_pairs(database: Path, scene: Any) -> dict[str, int]:
    """Numbers of verified pairs of a database, all and far apart, and of false ones among each."""
    intrinsics = np.array(
        [[scene.fx, 0, scene.cx], [0, scene.fy, scene.cy], [0, 0, 1.0]], dtype=np.float64
    )
    inverse = np.linalg.inv(intrinsics)
    counts = dict.fromkeys(("pairs", "false", "far_pairs", "far_false"), 0)
    with pycolmap.Database.open(database) as opened:
        frames = {i.image_id: int(Path(i.name).stem[-6:]) for i in opened.read_all_images()}
        xy = {image: opened.read_keypoints(image)[:, :2] for image in frames}
        for pair, geometry in zip(*opened.read_two_view_geometries(), strict=True):
            matches = np.asarray(geometry.inlier_matches)
            if len(matches) == 0:
                continue
            first, second = pycolmap.pair_id_to_image_pair(pair)
            a, b = (scene.cam_from_world[frames[image]] for image in (first, second))
            rotation = b[:, :3] @ a[:, :3].T
            x, y, z = b[:, 3] - rotation @ a[:, 3]
            cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
            fundamental = inverse.T @ cross @ rotation @ inverse
            points = [
                np.c_[xy[image][matches[:, side]], np.ones(len(matches))]
                for side, image in enumerate((first, second))
            ]
            lines = points[0] @ fundamental.T
            off = np.abs((points[1] * lines).sum(1)) / np.hypot(lines[:, 0], lines[:, 1])
            is_false = bool(np.median(off) > FALSE)
            counts["pairs"] += 1
            counts["false"] += is_false
            if abs(frames[first] - frames[second]) >= FAR:
                counts["far_pairs"] += 1
                counts["far_false"] += is_false
    return counts


def main() -> int:
    """Render missing clips, measure, and save and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cache", type=Path, required=True, help="folder for clips and models")
    parser.add_argument("--clips", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS))
    add_results(parser, "loops")
    arguments = parser.parse_args()
    for clip in arguments.clips:
        folder = arguments.cache.resolve() / clip
        folder.mkdir(parents=True, exist_ok=True)
        scene, alike = SCENES[clip]()
        video = folder / "clip.mp4"
        if not video.exists():
            SCRIPT.encode(pictures(scene, alike), video)
        for way in arguments.ways:
            save(arguments.results, [measure(clip, way, video, scene, folder)], ("clip", "way"))
    print(render.loops(read_rows(arguments.results)), end="")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

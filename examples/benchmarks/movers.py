"""Measure the effect of dynamic objects, people in the rendered scene, on `reconstruct`.

python examples/benchmarks/movers.py --cache benchmark_movers

The clips show the courtyard of the example clip without people, and with people who cover about 5,
15 and 30 % of the pictures. Camera centres and the pixels that show people are exactly known.
Because the accuracy of poses varies randomly, the table has means over several encodings of the
same pictures. Rendering takes some minutes; pictures and clips are kept in the cache.
"""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import cv2
import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap
import render
from clips import load_render_scene
from numpy.typing import NDArray
from results import Value, add_results, read_rows, save
from sequences import model_poses

from colmap_av1 import CameraOptions, MaskOptions, MatchOptions, ReconstructOptions, reconstruct
from colmap_av1.evaluate import run_measured
from colmap_av1.evaluate.metrics.poses import pose_errors
from colmap_av1.geometry.colmap_model import read_model

Floats = NDArray[np.float64]
# Values of the option (`drop` and `mask` give the same model), or `keep` with exact masks given.
Moving = Literal["keep", "mask", "exact"]
# Different rates, and reversed time, to get different motion fields of the same pictures.
ENCODINGS = {
    "forward": (22, False),
    "backward": (22, True),
    "fine": (18, False),
    "coarse": (26, True),
}
# Number of pixels by which exact masks are dilated, because motion blocks cross people's edges.
GROWN = 4
SCRIPT = load_render_scene()
# A point is on a person if most of its observations are on people, and its distance from the
# background surface exceeds this share of its depth.
OFF_SURFACE = 0.05
SUPERSAMPLE = 2
STEPS_PER_SECOND = 1.8


@dataclass(frozen=True)
class Person:
    """A walking person.

    Attributes:
        start: (x, y) position in metres in the first frame.
        velocity: (x, y) in metres per second.
        size: height divided by 1.7 metres.
        wait: seconds before the person starts to walk.
    """

    start: tuple[float, float]
    velocity: tuple[float, float]
    size: float = 1.0
    wait: float = 0.0


# People by the share of the pictures that they cover, in per cent. They walk with the camera,
# against it or towards it, and one waits first.
PEOPLE: dict[int, tuple[Person, ...]] = {
    0: (),
    5: (Person((1.4, -1.0), (-1.1, 0.05)),),
    15: (
        Person((1.4, -1.0), (-1.1, 0.05)),
        Person((-1.9, -1.6), (1.35, 0.0)),
        Person((0.5, 1.1), (-0.2, -0.75), 1.05),
    ),
    30: (
        Person((1.4, -1.0), (-1.1, 0.05)),
        Person((-2.1, -1.75), (1.35, 0.0), 1.05),
        Person((0.5, 1.1), (-0.2, -0.75), 1.05),
        Person((1.5, -1.9), (-0.5, 0.0), 1.0, 0.8),
        Person((-0.6, -1.2), (-0.45, -0.5)),
    ),
}


def body(person: Person) -> list[Any]:
    """Surfaces of a person in the first frame: trunk, head, legs and arms."""
    x, y = person.start
    size = person.size

    def upright(radius: float, low: float, high: float, material: str, aside: float = 0.0) -> Any:
        return SCRIPT.Surface(
            "cylinder",
            np.array([x, y + aside * size, low * size]),
            np.array([radius * size, 0, 0]),
            np.array([0, 0, (high - low) * size]),
            material,
            260.0,
            casts=False,
        )

    head = SCRIPT.Surface(
        "sphere",
        np.array([x, y, 1.57 * size]),
        np.array([0.125 * size, 0, 0]),
        np.array([0, 0, 0.125 * size]),
        "terracotta",
        330.0,
        casts=False,
    )
    return [
        upright(0.21, 0.78, 1.46, "planter"),
        head,
        upright(0.10, 0.0, 0.80, "rubble", 0.11),
        upright(0.10, 0.0, 0.80, "rubble", -0.11),
        upright(0.055, 0.85, 1.40, "barrel", 0.26),
        upright(0.055, 0.85, 1.40, "barrel", -0.26),
    ]


def moved(person: Person, seconds: float) -> list[Any]:
    """Surfaces of a person at a later time, with swinging legs and arms."""
    walked = max(seconds - person.wait, 0.0)
    step = np.array([*person.velocity, 0.0]) * walked
    along = np.array([*person.velocity, 0.0])
    along /= np.linalg.norm(along)
    swing = 0.22 * person.size * np.sin(np.pi * STEPS_PER_SECOND * walked)
    bob = np.array([0, 0, 0.02 * abs(np.cos(np.pi * STEPS_PER_SECOND * walked))])
    offsets = [step + bob, step + bob]
    offsets += [step + along * swing * sign for sign in (1, -1, -0.8, 0.8)]
    parts = zip(body(person), offsets, strict=True)
    return [replace(part, origin=part.origin + offset) for part, offset in parts]


def scene_at(scene: Any, people: Sequence[Person], frame: int) -> Any:
    """The scene with people at the time of a frame."""
    parts = [part for person in people for part in moved(person, frame / SCRIPT.FPS)]
    return replace(scene, surfaces=(*scene.surfaces, *parts))


def pictures(scene: Any, people: Sequence[Person]) -> Iterator[NDArray[np.uint8]]:
    """The frames in order, uint8 [height, width, 3] RGB."""
    SCRIPT.SUPERSAMPLE = SUPERSAMPLE
    textures = SCRIPT.paint(scene)
    textures += SCRIPT.paint(scene_at(scene, people, 0), len(scene.surfaces))
    for frame in range(len(scene.cam_from_world)):
        yield SCRIPT.render_frame(scene_at(scene, people, frame), textures, frame)


def shown_people(scene: Any, people: Sequence[Person]) -> NDArray[np.bool_]:
    """Bool [frames, height, width]: pixels whose centres show a person."""
    y, x = np.mgrid[0 : scene.height, 0 : scene.width] + 0.5
    xy = np.column_stack([x.ravel(), y.ravel()])
    seen = [
        SCRIPT.cast(scene_at(scene, people, frame), frame, xy)[1]
        for frame in range(len(scene.cam_from_world))
    ]
    return (np.array(seen) >= len(scene.surfaces)).reshape(-1, scene.height, scene.width)


def main() -> int:
    """Reconstruct with each share of people, and print a table."""
    parser = argparse.ArgumentParser(description="Measure the effect of people on a model.")
    parser.add_argument("--cache", type=Path, required=True, help="folder for clips and models")
    parser.add_argument("--shares", type=int, nargs="*", default=[*PEOPLE], choices=[*PEOPLE])
    parser.add_argument(
        "--moving", nargs="*", default=[*get_args(Moving)], choices=get_args(Moving)
    )
    parser.add_argument("--encodings", nargs="*", default=[*ENCODINGS], choices=[*ENCODINGS])
    add_results(parser, "movers")
    arguments = parser.parse_args()
    arguments.cache.mkdir(parents=True, exist_ok=True)
    scene = SCRIPT.build_scene()
    rows: list[dict[str, Value]] = []
    for share in arguments.shares:
        people = PEOPLE[share]
        shown = made_clips(arguments.cache, scene, share)
        for moving in arguments.moving:
            if moving == "exact" and not people:
                continue
            for encoding in arguments.encodings:
                clip = arguments.cache / f"people_{share}_{encoding}.mp4"
                rows.append(measure(clip, scene, shown, moving, encoding=encoding))
                save(arguments.results, rows, ["people", "moving", "encoding"])
    print(render.TABLES["movers"](read_rows(arguments.results)))
    return 0


def made_clips(cache: Path, scene: Any, share: int) -> NDArray[np.bool_]:
    """Render the clips `people_SHARE_ENCODING.mp4` in the cache; returns `shown_people` of them."""
    people = PEOPLE[share]
    rendered, truth = cache / f"frames_{share}.npy", cache / f"people_{share}.npy"
    if not rendered.is_file():
        np.save(rendered, np.stack(list(pictures(scene, people))))
    if not truth.is_file():
        np.save(truth, np.packbits(shown_people(scene, people), axis=2))
    frames = np.load(rendered, mmap_mode="r")
    for name, (crf, backwards) in ENCODINGS.items():
        clip = cache / f"people_{share}_{name}.mp4"
        if not clip.is_file():
            SCRIPT.encode(iter(frames[::-1] if backwards else frames), clip, crf)
    return np.unpackbits(np.load(truth), axis=2, count=scene.width).view(np.bool_)


def measure(
    clip: Path, scene: Any, shown: NDArray[np.bool_], moving: Moving, *, encoding: str
) -> dict[str, Value]:
    """Reconstruct an encoding of a clip, and compare the model with the ground truth."""
    cache = clip.parent
    if ENCODINGS[encoding][1]:
        shown = shown[::-1]
        scene = replace(scene, cam_from_world=scene.cam_from_world[::-1])
    output = cache / f"{clip.stem}_{moving}"
    shutil.rmtree(output, ignore_errors=True)
    masks = write_masks(cache / f"{clip.stem}_masks", shown) if moving == "exact" else None
    intrinsics = f"{scene.fx},{scene.fy},{scene.cx},{scene.cy}"
    camera = CameraOptions(camera_model="PINHOLE", camera_params=intrinsics)
    options = ReconstructOptions(
        match=MatchOptions(camera=camera, masks=MaskOptions(mask_path=masks)),
        moving="keep" if moving == "exact" else moving,
    )
    measured = run_measured(make, clip, output, options, log=cache / f"{output.name}.log")
    model = read_model(output / "sparse" / "0")
    errors = pose_errors(model_poses(model, len(shown)), scene.cam_from_world)
    on_people, num_points = points_on_people(model, scene, shown)
    row: dict[str, Value] = {
        "people": f"{shown.mean():.0%}",
        "moving": moving,
        "encoding": encoding,
        "registered": model.num_reg_images(),
        "ate_mm": 1000 * errors.ate if errors is not None else None,
        "points": num_points,
        "points_on_people": on_people / num_points,
        "cpu_s": measured.cpu_seconds,
    }
    if moving == "mask" and shown.any():
        row |= agreement(output / "masks", shown)
    return row


def make(clip: Path, output: Path, options: ReconstructOptions) -> None:
    """Reconstruct; called in a separate process."""
    reconstruct(clip, output, options=options)


def write_masks(folder: Path, shown: NDArray[np.bool_]) -> Path:
    """Write exact masks of the frames, slightly dilated."""
    folder.mkdir(exist_ok=True)
    square = np.ones((2 * GROWN + 1, 2 * GROWN + 1), np.uint8)
    for frame, people in enumerate(shown):
        grown = cv2.dilate(people.astype(np.uint8), square)
        cv2.imwrite(str(folder / f"{frame:04d}.png"), 255 * (1 - grown))
    return folder


def points_on_people(
    model: pycolmap.Reconstruction, scene: Any, shown: NDArray[np.bool_]
) -> tuple[int, int]:
    """Numbers of points on people and of all points."""
    off = np.zeros(len(model.points3D))
    number = {point_id: k for k, point_id in enumerate(model.points3D)}
    count = np.zeros(len(off))
    # Scale of the model, from its camera centres.
    names = sorted(image.name for image in model.images.values())
    by_name = {image.name: image for image in model.images.values()}
    centres = np.array([by_name[name].projection_center() for name in names])
    frames = [int(name[6:12]) for name in names]
    poses = scene.cam_from_world[frames]
    true = np.array([-pose[:, :3].T @ pose[:, 3] for pose in poses])
    unit = np.linalg.norm(true - true.mean(axis=0)) / np.linalg.norm(centres - centres.mean(axis=0))
    for name, frame in zip(names, frames, strict=True):
        image = by_name[name]
        seen = [p for p in image.points2D if p.has_point3D()]
        ids = [p.point3D_id for p in seen]
        xy = np.array([p.xy for p in seen])
        xyz = np.array([model.points3D[i].xyz for i in ids])
        pose = image.cam_from_world().matrix()
        depth = unit * (xyz @ pose[2, :3] + pose[2, 3])
        behind = SCRIPT.cast(scene, frame, xy)[0]
        column, row = np.clip(xy.astype(int), 0, [scene.width - 1, scene.height - 1]).T
        wrong = shown[frame, row, column] & (np.abs(depth / behind - 1) > OFF_SURFACE)
        index = [number[i] for i in ids]
        np.add.at(off, index, wrong)
        np.add.at(count, index, 1)
    return int(np.count_nonzero(off > 0.5 * count)), len(off)


def agreement(masks: Path, shown: NDArray[np.bool_]) -> dict[str, Value]:
    """Agreement of the written masks with the true ones, over all frames."""
    found = np.zeros_like(shown)
    for path in masks.iterdir():
        found[int(path.stem[6:12])] = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) == 0
    both, either = np.count_nonzero(found & shown), np.count_nonzero(found | shown)
    people = np.count_nonzero(shown)
    return {
        "iou": both / either,
        "covered": both / people,
        "static_lost": np.count_nonzero(found & ~shown) / np.count_nonzero(~shown),
    }


if __name__ == "__main__":
    raise SystemExit(main())

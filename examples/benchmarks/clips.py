"""Clips of the benchmarks: videos, known cameras and reference models."""

from __future__ import annotations

import functools
import importlib.util
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap
from numpy.typing import NDArray
from rich.console import Console
from sequences import Sequence, measure_frontend, model_poses, prepare_footage, read_sequence

from colmap_av1 import CameraOptions, ColmapAv1Error, MapOptions
from colmap_av1.evaluate import Footage, measure_mapper
from colmap_av1.geometry.colmap_model import read_model
from colmap_av1.util.digests import file_digest
from colmap_av1.util.stages import run_stage_in

EXAMPLES = Path(__file__).resolve().parents[1]
SEQUENCES = EXAMPLES.parents[1] / "shared" / "sequences"
REFERENCE = "sift-exhaustive"
# External tool that compares SIFT matches between images far apart with the poses.
LOOP_CONSISTENCY = SEQUENCES.parent / "tools" / "loop_consistency.py"
# Smallest number of images between the images of a pair.
FAR = 10
# The settings of `colmap-av1 encode --encoder libaom --speed 6`.
ENCODING = (
    "-c:v libaom-av1 -usage realtime -cpu-used 6 -lag-in-frames 0 -row-mt 1 -crf 20 -b:v 0 -g 9999 "
    "-pix_fmt yuv420p -an"
)

Poses = NDArray[np.float64]


@dataclass(frozen=True)
class Case:
    """A sequence and its settings; `image_step` is `every` of ImageOptions."""

    name: str
    image_step: int = 1
    forward_motion: bool = False


CASES = (
    Case("scene"),
    Case("street", forward_motion=True),
    Case("shelfbox"),
    Case("kitchen", image_step=2),
    Case("log_building"),
    Case("ditch"),
    Case("holiday_display"),
)


@dataclass(frozen=True)
class Material:
    """The video and the ground truth of a case.

    `transfer` is the ground-truth correspondence of the rendered clip; `source` are ffmpeg's input
    options for the original pictures of a sequence that is not rendered.
    """

    video: Path
    num_frames: int
    camera: Any | None
    poses: Poses | None
    transfer: Callable[..., Any] | None = None
    source: tuple[str, ...] | None = None

    @property
    def intrinsics(self) -> CameraOptions:
        """Options for the known camera, or default options if it is unknown."""
        return CameraOptions() if self.camera is None else camera_options(self.camera)


@dataclass(frozen=True)
class Truth:
    """Ground truth for epipolar errors and for poses, and a description."""

    geometry: tuple[Poses, Any] | None
    poses: Poses | None
    about: str


def camera_options(camera: Any) -> CameraOptions:
    """The options for a known pycolmap.Camera."""
    params = ",".join(map(str, camera.params))
    return CameraOptions(camera_model=camera.model.name, camera_params=params)


def is_there(name: str) -> bool:
    """Whether a clip is available: the rendered clip always, sequences only with ../shared."""
    return name == "scene" or (SEQUENCES / name).is_dir()


def load_render_scene() -> Any:
    """The script that rendered the example clip, as a module."""
    spec = importlib.util.spec_from_file_location("render_scene", EXAMPLES / "render_scene.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["render_scene"] = module
    spec.loader.exec_module(module)
    return module


def rendered_clip() -> Material:
    """The example clip with its exact ground truth."""
    render_scene = load_render_scene()
    scene = render_scene.build_scene()
    camera = pycolmap.Camera(
        model="PINHOLE",
        width=scene.width,
        height=scene.height,
        params=[scene.fx, scene.fy, scene.cx, scene.cy],
    )
    return Material(
        video=EXAMPLES / "scene.mp4",
        num_frames=len(scene.cam_from_world),
        camera=camera,
        poses=scene.cam_from_world,
        transfer=functools.partial(render_scene.transfer, scene),
    )


def real_sequence(case: Case, folder: Path, console: Console) -> Material:
    """A sequence of ../shared, encoded as AV1 in `folder`."""
    sequence = read_sequence(SEQUENCES / case.name)
    source = sequence.source
    words = ffmpeg_input(source, sequence.fps)
    video = folder / "video" / "video.mp4"

    def encode() -> None:
        console.print(f"{case.name}: encoding", markup=False)
        ffmpeg(*words, *ENCODING.split(), str(video))

    pictures = sorted(source.iterdir()) if source.is_dir() else [source]
    given = (words, ENCODING, [file_digest(p) for p in pictures])
    run_stage_in(video.parent, given, None, encode, products=[video], made_by=())
    return Material(
        video, sequence.num_frames, sequence.camera, sequence.cam_from_world, source=words
    )


def material_of(case: Case, folder: Path, console: Console) -> Material:
    """The rendered clip, or a sequence whose encoded video is kept in `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    return rendered_clip() if case.name == "scene" else real_sequence(case, folder, console)


def footage_of(
    case: Case, material: Material, folder: Path, camera: CameraOptions | None = None
) -> Footage:
    """The images that all front-ends get, with the material's camera unless `camera` is given."""
    return prepare_footage(
        material.video,
        folder / "footage",
        num_frames=material.num_frames,
        image_step=case.image_step,
        camera=material.intrinsics if camera is None else camera,
    )


def mapper_options(case: Case, material: Material) -> MapOptions:
    """Options of the mapper, which keeps known intrinsics fixed."""
    return MapOptions(refine_intrinsics=material.camera is None, forward_motion=case.forward_motion)


def ffmpeg_input(source: Path, fps: float) -> tuple[str, ...]:
    """Input options of ffmpeg for a clip, or for images named by consecutive numbers."""
    if not source.is_dir():
        return ("-i", str(source))
    first = min(source.iterdir())
    pattern = source / f"%0{len(first.stem)}d{first.suffix}"
    return ("-framerate", str(fps), "-start_number", str(int(first.stem)), "-i", str(pattern))


def ffmpeg(*words: str) -> None:
    """Run ffmpeg."""
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-nostdin", "-y", *words]
    subprocess.run(command, check=True)


def as_shot(sequence: Sequence, folder: Path) -> Path:
    """The original video of a sequence, or its frames as nearly lossless H.264."""
    if sequence.source.is_file():
        return sequence.source
    video = folder / "video.mp4"
    words = (*ffmpeg_input(sequence.source, sequence.fps), "-c:v", "libx264", "-preset")
    words += ("veryfast", "-crf", "14", "-pix_fmt", "yuv420p")

    def make() -> None:
        ffmpeg(*words, str(video))

    run_stage_in(folder, words, None, make, products=[video], made_by=())
    return video


def long_range(model: Path, images: Path, apart: int = FAR) -> dict[str, float]:
    """Long-range epipolar error of a model: columns of a row.

    Args:
        model: folder of a model without distortion.
        images: folder of its images.
        apart: smallest number of images between the images of a pair.

    Returns:
        Median and 90th percentile over pairs of images in pixels; empty if the program that
        measures it is absent.
    """
    if not LOOP_CONSISTENCY.is_file():
        return {}
    command = [sys.executable, str(LOOP_CONSISTENCY), str(model), str(images), str(apart)]
    printed = subprocess.run(command, capture_output=True, text=True, check=False).stdout
    found = re.search(r"median ([\d.]+), 90% ([\d.]+)", printed)
    if found is None:
        return {}
    return {"long_range": float(found[1]), "long_range_90": float(found[2])}


def known_truth(material: Material) -> Truth:
    """The known ground truth of the cameras."""
    if material.poses is None:
        return Truth(None, None, "no poses known")
    if material.camera is None:
        return Truth(None, material.poses, "true poses, no epipolar error")
    return Truth((material.poses, material.camera), material.poses, "true poses")


def with_reference(truth: Truth, model: Any, num_frames: int) -> Truth:
    """The ground truth, completed by the reference model."""
    poses = model_poses(model, num_frames)
    geometry = (poses, next(iter(model.cameras.values())))
    if truth.poses is None:
        return Truth(geometry, poses, f"errors against {REFERENCE}'s model")
    return Truth(geometry, truth.poses, f"true poses; epipolar error against {REFERENCE}'s model")


def reference_model(footage: Footage, folder: Path, settings: MapOptions, console: Console) -> Any:
    """The model that replaces unknown ground truth."""
    console.print(f"{folder.name}: {REFERENCE} as the reference", markup=False)
    run = measure_frontend(REFERENCE, footage, folder / REFERENCE)
    where = folder / f"{REFERENCE}-model"
    mapper = measure_mapper(run.database, footage.image_path, where, settings)
    if mapper.model is None:
        raise ColmapAv1Error(f"{REFERENCE} made no model, so there is no reference: see {where}")
    return read_model(mapper.model)


def median(values: NDArray[np.float64]) -> float:
    """The median; NaN without values."""
    return quantile(values, 0.5)


def quantile(values: NDArray[np.float64], share: float) -> float:
    """A quantile; NaN without values."""
    return float(np.quantile(values, share)) if len(values) else float("nan")

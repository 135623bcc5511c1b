"""The rendered clip with its exact cameras and depth, and a dense model of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from colmap_av1.options import (
    ImageOptions,
    MatchOptions,
    PoseOptions,
    ReconstructOptions,
    TriangulateOptions,
)
from colmap_av1.reconstruct import ReconstructReport, reconstruct

_EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
SCENE = _EXAMPLES / "scene.mp4"
EVERY = 3
NUM_IMAGES = 20
OPTIONS = ReconstructOptions(
    match=MatchOptions(images=ImageOptions(every=EVERY)),
    poses=PoseOptions(pose_tracks_per_image=300, pose_spacing=24.0),
    triangulate=TriangulateOptions(points="survey"),
)


@dataclass(frozen=True)
class Truth:
    """Exact cameras and depth of the rendered clip."""

    camera: pycolmap.Camera
    cam_from_world: np.ndarray
    depth: np.ndarray
    depth_x: np.ndarray
    depth_y: np.ndarray


@pytest.fixture(scope="session")
def truth() -> Truth:
    with np.load(_EXAMPLES / "scene_truth.npz") as file:
        params = [float(file[name]) for name in ("fx", "fy", "cx", "cy")]
        size = {"width": int(file["width"]), "height": int(file["height"])}
        camera = pycolmap.Camera(camera_id=7, model="PINHOLE", params=params, **size)
        depth = [file[name] for name in ("depth", "depth_x", "depth_y")]
        return Truth(camera, file["cam_from_world"], *depth)


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> ReconstructReport:
    return reconstruct(SCENE, tmp_path_factory.mktemp("made") / "scene", options=OPTIONS)

"""Further models, which are not connected to the first."""

from __future__ import annotations

import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap

from colmap_av1.geometry.colmap_model import ModelImage
from colmap_av1.geometry.posed_model import PosedModel
from colmap_av1.poses.further_models import keeps_intrinsics


def model(count: int, camera_id: int = 1) -> PosedModel:
    camera = pycolmap.Camera.create_from_model_name(camera_id, "SIMPLE_RADIAL", 500, 640, 480)
    images = [ModelImage(i + 1, f"{i}.png", camera_id, np.eye(3, 4)) for i in range(count)]
    return PosedModel({camera_id: camera}, images)


def test_a_small_model_keeps_the_intrinsics_of_the_first() -> None:
    first = model(40)
    assert keeps_intrinsics(model(12), first)
    assert not keeps_intrinsics(model(35), first)  # it determines them itself
    assert not keeps_intrinsics(model(12), model(10))
    assert not keeps_intrinsics(model(12, camera_id=2), first)

"""The order of the mapper's models."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
from image_sets import images

from colmap_av1.geometry.colmap_model import ModelImage
from colmap_av1.geometry.posed_model import PosedModel, write_posed_model
from colmap_av1.poses.mapping_stage import MappedResult, num_nearest, with_model_first
from colmap_av1.poses.run import Run
from colmap_av1.util.stages import Kept


def model_of(names: list[str]) -> PosedModel:
    return PosedModel({}, [ModelImage(i + 1, n, 1, np.eye(3, 4)) for i, n in enumerate(names)])


def test_size_of_a_model_counts_the_images_between_its_key_images() -> None:
    image_set = images(20)
    keyed = image_set.some([0, 10, 12, 14])
    names = keyed.images.names
    assert num_nearest(model_of(names[:2]), image_set, keyed) == 12  # images 0 to 11
    assert num_nearest(model_of(names[2:]), image_set, keyed) == 8
    assert num_nearest(model_of(names), image_set, keyed) == 20


def test_another_model_of_the_mapper_becomes_the_first(tmp_path: Path) -> None:
    keyed = images(8, 4)
    names = keyed.images.names
    (tmp_path / "poses").mkdir()
    for number, own in enumerate((names[:5], names[5:])):
        write_posed_model(tmp_path / f"poses/{number}.npz", model_of(own))
    found = MappedResult(
        poses="poses/0.npz",
        num_registered=5,
        mapper="global",
        other_models=("poses/1.npz",),
    )
    mapped = Kept(found, digest="0", resumed=False)
    run = cast("Run", SimpleNamespace(stages=tmp_path))
    changed = with_model_first(run, mapped, "poses/1.npz")
    assert (changed.result.poses, changed.result.num_registered) == ("poses/1.npz", 7)
    assert changed.result.other_models == ("poses/0.npz",)
    assert changed.digest != mapped.digest

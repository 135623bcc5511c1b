"""The order of the mapper's models, and the reasons why it finds none."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from image_sets import images
from synthetic_scene import CAMERA_PARAMS, FOCAL, HEIGHT, WIDTH, Scene, make_scene, match_scene

from colmap_av1.database.writing import write_matches
from colmap_av1.errors import ModelError
from colmap_av1.geometry.cameras import make_camera
from colmap_av1.geometry.colmap_model import ModelImage
from colmap_av1.geometry.posed_model import PosedModel, write_posed_model
from colmap_av1.matching.depth import DepthEvidence
from colmap_av1.matching.links.report import LinkReport
from colmap_av1.matching.two_view_geometry import TwoViewConfig
from colmap_av1.options import CameraOptions, MatchOptions, PoseOptions, ReconstructOptions
from colmap_av1.poses.mapping_stage import (
    MappedResult,
    mapping_stage,
    num_nearest,
    with_model_first,
)
from colmap_av1.poses.match_stage import MatchesResult
from colmap_av1.poses.run import Run
from colmap_av1.util.run_context import RunContext
from colmap_av1.util.stages import Kept

NUM_IMAGES = 8
FAR_OFF = CAMERA_PARAMS.replace(str(FOCAL), str(10 * FOCAL))


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


def map_scene(scene: Scene, params: str, folder: Path, *, is_assumed: bool = False) -> str:
    """Map a scene, and return why COLMAP's mapper finds no model.

    Args:
        scene: the tracks.
        params: parameters of the camera.
        folder: folder for the database.
        is_assumed: the parameters are not given, but assumed.
    """
    camera = make_camera(CameraOptions(camera_params=params), WIDTH, HEIGHT)
    camera.has_prior_focal_length = not is_assumed
    image_set = images(NUM_IMAGES)
    matched = match_scene(scene, camera)
    cameras = [camera] * NUM_IMAGES
    write_matches(folder / "database.db", image_set.images.names, cameras, matched)
    configs = [geometry.config for geometry in matched.geometries]
    found = MatchesResult(
        links=LinkReport(),
        warnings=(),
        key_images=tuple(range(NUM_IMAGES)),
        num_pose_tracks=scene.tracks.num_tracks,
        assumes_video_focal_length=is_assumed,
        forward_motion=False,
        depth=DepthEvidence(0, 0, is_focal_length_known=not is_assumed),
        num_pairs=len(configs),
        num_flat_pairs=configs.count(TwoViewConfig.PLANAR_OR_PANORAMIC),
        num_verified_pairs=len(configs) - configs.count(TwoViewConfig.DEGENERATE),
        keypoints_per_image=float(np.mean([len(own.xy) for own in matched.keypoints])),
    )
    given = CameraOptions() if is_assumed else CameraOptions("SIMPLE_RADIAL", params)
    options = ReconstructOptions(
        match=MatchOptions(camera=given), poses=PoseOptions(mapper="incremental")
    )
    inputs: Any = None  # only used by earlier stages
    run = Run(inputs, (), (), folder, folder, options, RunContext())
    with pytest.raises(ModelError) as error:
        mapping_stage(run, Kept(found, digest="0", resumed=False), image_set, image_set)
    return str(error.value)


@pytest.mark.parametrize(
    ("cause", "scene", "params", "is_assumed"),
    [
        ("rotates", {"turning": True, "num_points": 400}, CAMERA_PARAMS, False),
        ("few tracks", {"num_points": 30}, CAMERA_PARAMS, False),
        ("few tracks", {"num_points": 650, "noise": 300.0}, CAMERA_PARAMS, False),  # all are wrong
        ("focal length", {"num_points": 400}, FAR_OFF, True),
        ("intrinsics", {"num_points": 400}, FAR_OFF, False),
    ],
)
def test_error_names_the_probable_cause_of_a_missing_model(
    cause: str, scene: dict[str, Any], params: str, is_assumed: bool, tmp_path: Path
) -> None:
    made = make_scene(num_frames=NUM_IMAGES, **scene)
    why = map_scene(made, params, tmp_path, is_assumed=is_assumed)
    causes = ("rotates", "few tracks", "focal length", "intrinsics")
    assert [own for own in causes if own in why] == [cause]

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from dense_scene import NUM_IMAGES, Truth
from scipy.spatial.transform import Rotation
from sequences import model_poses

from colmap_av1.errors import ModelError, WriteError
from colmap_av1.evaluate.metrics.poses import pose_errors
from colmap_av1.geometry.colmap_model import read_model, write_model
from colmap_av1.geometry.posed_model import posed_model, read_posed_model
from colmap_av1.options import MapOptions, Mapper
from colmap_av1.poses import mapper as mapper_module
from colmap_av1.poses.adjusting import without_sparse_images
from colmap_av1.reconstruct import ReconstructReport
from colmap_av1.util.progress import Progress, no_progress


def run_mapper(folder: Path, database: Path, mapper: Mapper, progress: Progress) -> None:
    mapper_module.map_poses(
        database,
        folder / "poses",
        MapOptions(mapper=mapper, num_threads=1),
        image_path=None,
        log=folder / "log",
        num_images=NUM_IMAGES,
        progress=progress,
    )


def test_interrupted_mapper_writes_no_model(made: ReconstructReport, tmp_path: Path) -> None:
    def interrupt(stage: str, done: int, total: int | None) -> None:
        if done >= 2:
            raise KeyboardInterrupt

    copy = tmp_path / "mapped.db"
    copy.write_bytes(made.database.read_bytes())
    with pytest.raises(KeyboardInterrupt):
        run_mapper(tmp_path, copy, "incremental", interrupt)
    assert not list((tmp_path / "poses").rglob("*.bin"))


def test_failing_mapper_names_its_log(tmp_path: Path) -> None:
    (tmp_path / "no.db").write_bytes(b"no database")
    with pytest.raises(ModelError, match="log"):
        run_mapper(tmp_path, tmp_path / "no.db", "global", no_progress)
    assert (tmp_path / "log").stat().st_size > 0


def adjusted_model(made: ReconstructReport, folder: Path) -> pycolmap.Reconstruction:
    """The adjusted model with its points, written to a folder as a COLMAP model."""
    adjusted = read_posed_model(made.output / ".stages" / "adjusted.npz")
    write_model(folder, adjusted.cameras, adjusted.images, adjusted.points)
    return read_model(folder)


@pytest.mark.parametrize("iterative", [False, True])
def test_adjustment_corrects_perturbed_poses(
    made: ReconstructReport, truth: Truth, tmp_path: Path, iterative: bool
) -> None:
    model = adjusted_model(made, tmp_path)
    rng = np.random.default_rng(0)
    for frame in model.frames.values():
        pose = frame.rig_from_world
        turn = pycolmap.Rotation3d(rng.normal(0.0, 0.004, 3)) * pose.rotation
        frame.rig_from_world = pycolmap.Rigid3d(turn, pose.translation + rng.normal(0.0, 0.02, 3))
    bent = pose_errors(model_poses(model, 60), truth.cam_from_world)
    focal_length = model.cameras[1].mean_focal_length()
    model.write_binary(tmp_path)
    mapper_module.adjust_model(
        tmp_path,
        refine_intrinsics=False,
        loss_scales=(0.5,),
        seed=0,
        num_threads=1,
        log=tmp_path / "log",
        iterative=iterative,
    )
    adjusted = read_model(tmp_path)
    errors = pose_errors(model_poses(adjusted, 60), truth.cam_from_world)
    before = pose_errors(
        model_poses(read_model(made.output / "sparse" / "0"), 60), truth.cam_from_world
    )
    assert errors.rotation < min(bent.rotation / 3, before.rotation + 0.05)
    assert errors.ate < min(bent.ate / 3, before.ate * 1.5)
    assert adjusted.cameras[1].mean_focal_length() == focal_length


def test_adjustment_straightens_a_bent_end(
    made: ReconstructReport, truth: Truth, tmp_path: Path
) -> None:
    """The last images are wrong together with their points: only points at the joint show it."""
    model = adjusted_model(made, tmp_path)
    for number, point in list(model.points3D.items()):
        if point.track.length() > 6:
            model.delete_point3D(number)
    images = sorted(model.images.values(), key=lambda image: image.name)
    last = {image.image_id for image in images[-6:]}
    joint = images[-7].projection_center()
    turn = Rotation.from_euler("y", 4, degrees=True).as_matrix()
    bent = pycolmap.Sim3d(1.5, pycolmap.Rotation3d(turn), joint - 1.5 * turn @ joint)
    for point in model.points3D.values():
        if np.mean([element.image_id in last for element in point.track.elements]) > 0.5:
            point.xyz = bent * point.xyz
    for image in images[-6:]:
        centre = bent * image.projection_center()
        rotation = image.frame.rig_from_world.rotation.matrix() @ turn.T
        image.frame.rig_from_world = pycolmap.Rigid3d(
            pycolmap.Rotation3d(rotation), -rotation @ centre
        )
    before = model_poses(model, 60)
    errors = {}
    for scales in ((0.25,), (1.0, 0.25)):
        model.write_binary(tmp_path)
        how = {"refine_intrinsics": False, "seed": 0, "num_threads": 1, "log": tmp_path / "log"}
        mapper_module.adjust_model(tmp_path, loss_scales=scales, **how)
        poses = model_poses(read_model(tmp_path), 60)
        errors[scales] = pose_errors(poses, truth.cam_from_world).ate
    assert pose_errors(before, truth.cam_from_world).ate > 0.08
    assert errors[1.0, 0.25] < 0.003
    assert errors[0.25,] > 10 * errors[1.0, 0.25]


@pytest.mark.skipif(sys.platform == "win32", reason="file sizes cannot be limited there")
def test_full_disk_is_reported(made: ReconstructReport, tmp_path: Path) -> None:
    """COLMAP reports no error when it cannot write a model."""
    import resource  # noqa: PLC0415 - not available on Windows

    (tmp_path / "model").mkdir()
    adjusted_model(made, tmp_path / "model")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, before[1]))
    try:
        with pytest.raises(WriteError, match="disk"):
            mapper_module.adjust_model(
                tmp_path / "model",
                refine_intrinsics=False,
                loss_scales=(0.5,),
                seed=0,
                num_threads=1,
                log=tmp_path / "log",
            )
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize(("kept", "stays"), [(8, False), (29, False), (30, True)])
def test_images_with_few_points_are_dropped(
    made: ReconstructReport, tmp_path: Path, kept: int, stays: bool
) -> None:
    """A few points determine a pose badly, for example where a near object fills the image."""
    model = adjusted_model(made, tmp_path)
    assert model.num_reg_images() == NUM_IMAGES
    image = min(model.images.values(), key=lambda image: image.name)
    seen = [index for index, p in enumerate(image.points2D) if p.has_point3D()]
    for index in seen[kept:]:
        model.delete_observation(image.image_id, index)
    found = without_sparse_images(posed_model(model, with_points=True)).model
    names = {own.name for own in model.images.values()} - (set() if stays else {image.name})
    assert found.by_name.keys() == names


def test_images_of_a_model_with_few_points_are_kept(
    made: ReconstructReport, tmp_path: Path
) -> None:
    model = adjusted_model(made, tmp_path)
    by_length = sorted(model.points3D, key=lambda number: -model.points3D[number].track.length())
    for number in by_length[25:]:
        model.delete_point3D(number)
    found = without_sparse_images(posed_model(model, with_points=True)).model
    assert 0 < np.bincount(found.points.image, minlength=NUM_IMAGES).min() <= 25
    assert len(found.images) == NUM_IMAGES

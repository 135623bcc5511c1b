from __future__ import annotations

import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from dense_scene import NUM_IMAGES, Truth

from colmap_av1.errors import ModelError
from colmap_av1.evaluate.metrics.poses import model_poses, pose_errors
from colmap_av1.model import mapper as mapper_module
from colmap_av1.model.colmap_model import read_model
from colmap_av1.options import MapOptions, Mapper
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


def test_interrupted_mapper_ends(made: ReconstructReport, tmp_path: Path) -> None:
    def interrupt(stage: str, done: int, total: int | None) -> None:
        if done >= 2:
            raise KeyboardInterrupt

    copy = tmp_path / "mapped.db"
    copy.write_bytes(made.database.read_bytes())
    with pytest.raises(KeyboardInterrupt):
        run_mapper(tmp_path, copy, "incremental", interrupt)
    assert not list((tmp_path / "poses").rglob("*.bin"))


def test_mapper_that_fails(tmp_path: Path) -> None:
    (tmp_path / "no.db").write_bytes(b"no database")
    with pytest.raises(ModelError, match=r"status 1 \(.*\): .*log says where"):
        run_mapper(tmp_path, tmp_path / "no.db", "global", no_progress)
    assert (tmp_path / "log").stat().st_size > 0


def test_mapper_starts_from_the_longest_tracks(
    made: ReconstructReport, truth: Truth, tmp_path: Path
) -> None:
    """And finds the points of the others, too."""
    found = {}
    for start_tracks in (None, 40):
        folder = tmp_path / str(start_tracks)
        folder.mkdir()
        copy = folder / "mapped.db"
        copy.write_bytes(made.database.read_bytes())
        sizes = mapper_module.map_poses(
            copy,
            folder / "poses",
            MapOptions(mapper="global", num_threads=1),
            image_path=None,
            log=folder / "log",
            num_images=NUM_IMAGES,
            progress=no_progress,
            start_tracks=start_tracks,
        )
        model = read_model(folder / "poses" / "0")
        counts = re.search(r"Before filtering: (\d+), after filtering: (\d+)", log_of(folder))
        assert counts is not None
        error = pose_errors(model_poses(model, 60), truth.cam_from_world)
        found[start_tracks] = (sizes, [int(n) for n in counts.groups()], model, error)
    (sizes, (before, after), whole, error), (few_sizes, few, model, few_error) = found.values()
    assert few_sizes == sizes == (made.num_key_images,)
    assert (few[0], after) == (before, before)
    assert few[1] < before / 2
    assert model.num_points3D() > 0.9 * whole.num_points3D()
    assert few_error.rotation < 2 * error.rotation


def log_of(folder: Path) -> str:
    return (folder / "log").read_text()


def test_adjustment_mends_poses(made: ReconstructReport, truth: Truth, tmp_path: Path) -> None:
    model = read_model(made.output / ".stages" / "adjusted")
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
        loss_scale=0.5,
        seed=0,
        num_threads=1,
        log=tmp_path / "log",
    )
    adjusted = read_model(tmp_path)
    errors = pose_errors(model_poses(adjusted, 60), truth.cam_from_world)
    before = pose_errors(
        model_poses(read_model(made.output / "sparse" / "0"), 60), truth.cam_from_world
    )
    assert errors.rotation < min(bent.rotation / 3, before.rotation + 0.05)
    assert errors.ate < min(bent.ate / 3, before.ate * 1.5)
    assert adjusted.cameras[1].mean_focal_length() == focal_length


@pytest.mark.skipif(sys.platform == "win32", reason="files have no limits there")
def test_full_disk(made: ReconstructReport, tmp_path: Path) -> None:
    """COLMAP says nothing of what it cannot write."""
    import resource  # noqa: PLC0415 - there is none on Windows

    shutil.copytree(made.output / ".stages" / "adjusted", tmp_path / "model")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, before[1]))
    try:
        with pytest.raises(ModelError, match="was not written to its end: see that the disk has"):
            mapper_module.adjust_model(
                tmp_path / "model",
                refine_intrinsics=False,
                loss_scale=0.5,
                seed=0,
                num_threads=1,
                log=tmp_path / "log",
            )
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)

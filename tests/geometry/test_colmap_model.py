from __future__ import annotations

import re
import warnings
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from colmap_av1.check.model import check_model
from colmap_av1.errors import ModelError
from colmap_av1.geometry.colmap_model import read_model


@pytest.fixture
def reconstruction() -> pycolmap.Reconstruction:
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 4, 60
    return pycolmap.synthesize_dataset(options)


@pytest.mark.parametrize("write", ["write_binary", "write_text"])
def test_binary_and_text_models_are_read(
    reconstruction: pycolmap.Reconstruction, tmp_path: Path, write: str
) -> None:
    getattr(reconstruction, write)(tmp_path)
    read = read_model(tmp_path)
    assert read.num_reg_images() == 4
    written = sorted(tuple(p.xyz) for p in reconstruction.points3D.values())
    np.testing.assert_allclose(sorted(tuple(p.xyz) for p in read.points3D.values()), written)


def test_points_with_invalid_positions_are_dropped(
    reconstruction: pycolmap.Reconstruction, tmp_path: Path
) -> None:
    some = list(reconstruction.points3D)[:3]
    for point_id, value in zip(some, (np.nan, np.inf, -np.inf), strict=True):
        reconstruction.points3D[point_id].xyz = np.array([0.0, value, 1.0])
    reconstruction.write_binary(tmp_path)
    with pytest.warns(UserWarning, match="3 points"):
        read = read_model(tmp_path)
    assert set(read.points3D) == set(reconstruction.points3D) - set(some)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_model(read)


def test_files_other_than_models_are_refused(
    reconstruction: pycolmap.Reconstruction, tmp_path: Path
) -> None:
    with pytest.raises(ModelError, match="no COLMAP model"):
        read_model(tmp_path)
    model = tmp_path / "sparse" / "0"
    model.mkdir(parents=True)
    reconstruction.write_binary(model)
    with pytest.raises(ModelError, match=re.escape(str(model))):
        read_model(tmp_path)
    whole = (model / "images.bin").read_bytes()
    (model / "images.bin").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ModelError, match="cannot be read"):
        read_model(model)
    (model / "images.bin").write_bytes(whole)
    read_model(model)
    whole = (model / "cameras.bin").read_bytes()
    (model / "cameras.bin").write_bytes(whole[:-8])
    with pytest.raises(ModelError, match="cannot be read"):
        read_model(model)


def test_model_without_poses_is_refused(tmp_path: Path) -> None:
    pycolmap.Reconstruction().write_text(tmp_path)
    with pytest.raises(ModelError, match="registered"):
        read_model(tmp_path)

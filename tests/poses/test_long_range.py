"""The long-range check compares images far apart in time with the poses of a model."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from colmap_av1 import ImageError
from colmap_av1.cli import main
from colmap_av1.geometry.colmap_model import read_model
from colmap_av1.poses.long_range import model_long_range_errors
from colmap_av1.reconstruct import ReconstructReport

_FAILED_CHECK = 1


@pytest.fixture(scope="module")
def bent(made: ReconstructReport, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The model with the second half of its images rotated by five degrees."""
    model = read_model(made.output / "sparse" / "0")
    half = len(model.images) // 2
    turn = pycolmap.Rigid3d(
        pycolmap.Rotation3d(cv2.Rodrigues(np.radians([5.0, 0, 0]))[0]), np.zeros(3)
    )
    for image in sorted(model.images.values(), key=lambda image: image.name)[half:]:
        frame = model.frames[image.frame_id]
        frame.rig_from_world = turn * image.cam_from_world()
    folder = tmp_path_factory.mktemp("bent") / "0"
    folder.mkdir()
    model.write(folder)
    return folder


def test_consistent_model_passes(made: ReconstructReport) -> None:
    model = read_model(made.output / "sparse" / "0")
    found = model_long_range_errors(model, made.output / "images")
    assert found.median == pytest.approx(made.long_range, rel=0.05)
    assert found.median is not None
    assert found.median < 1
    assert found.warning() is None


def test_bent_model_is_reported(
    made: ReconstructReport, bent: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    images = made.output / "images"
    found = model_long_range_errors(read_model(bent), images)
    assert found.median is not None
    assert found.median > 10
    assert found.warning() is not None
    words = ["check", "--strict", "--model", str(bent), "--image_path", str(images)]
    assert main(words) == _FAILED_CHECK
    printed = capsys.readouterr()
    assert "long-range epipolar error" in printed.out
    assert "doubled" in printed.err
    whole = ["check", "--strict", "--model", str(made.output / "sparse" / "0")]
    assert main([*whole, "--image_path", str(images)]) == 0


def test_parts_without_points_do_not_count(made: ReconstructReport, tmp_path: Path) -> None:
    model = read_model(made.output / "sparse" / "0")
    texture = np.random.default_rng(0).integers(0, 255, (60, 80, 3), dtype=np.uint8)
    moving = cv2.resize(texture, None, fx=3, fy=3, interpolation=cv2.INTER_CUBIC)
    height, width = moving.shape[:2]
    for k, image in enumerate(sorted(model.images.values(), key=lambda image: image.name)):
        picture = cv2.imread(str(made.output / "images" / image.name))
        left, top = 5 + 3 * k, 5 + k
        picture[top : top + height, left : left + width] = moving[
            : picture.shape[0] - top, : picture.shape[1] - left
        ]
        cv2.imwrite(str(tmp_path / image.name), picture)
        hidden = [
            number
            for number, point in enumerate(image.points2D)
            if point.has_point3D()
            and (np.abs(point.xy - (left + width / 2, top + height / 2)) < (140, 110)).all()
        ]
        for number in hidden:
            model.delete_observation(image.image_id, number)
    found = model_long_range_errors(model, tmp_path)
    assert found.median is not None
    assert found.warning() is None


def test_images_without_texture_are_reported(made: ReconstructReport, tmp_path: Path) -> None:
    for path in (made.output / "images").iterdir():
        blurred = cv2.blur(cv2.imread(str(path)), (61, 61))
        cv2.imwrite(str(tmp_path / path.name), blurred)
    found = model_long_range_errors(read_model(made.output / "sparse" / "0"), tmp_path)
    assert found.median is None
    warning = found.warning()
    assert warning is not None
    assert "nothing" in warning


def test_images_of_another_size_are_refused(made: ReconstructReport, tmp_path: Path) -> None:
    for path in (made.output / "images").iterdir():
        cv2.imwrite(str(tmp_path / path.name), np.zeros((20, 30, 3), np.uint8))
    with pytest.raises(ImageError, match="30x20"):
        model_long_range_errors(read_model(made.output / "sparse" / "0"), tmp_path)


def test_folder_without_any_image_of_the_model_is_refused(
    made: ReconstructReport, tmp_path: Path
) -> None:
    model = read_model(made.output / "sparse" / "0")
    for path in (made.output / "images").iterdir():
        shutil.copyfile(path, tmp_path / f"other_{path.name}")
    with pytest.raises(ImageError, match=f"^{re.escape(str(tmp_path))}: "):
        model_long_range_errors(model, tmp_path)
    # With too few images for a pair, no picture is read.
    few = pycolmap.Reconstruction(model)
    for image_id in sorted(few.images)[3:]:
        few.deregister_frame(few.images[image_id].frame_id)
    with pytest.raises(ImageError, match=f"^{re.escape(str(tmp_path))}: "):
        model_long_range_errors(few, tmp_path)
    assert model_long_range_errors(few, made.output / "images").median is None


@pytest.mark.parametrize(
    ("words", "missing"),
    [
        ([], "--database"),
        (["--database", "d.db", "--image_path", "i"], "--model"),
    ],
)
def test_check_names_the_missing_option(
    words: list[str], missing: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["check", *words]) == 2
    assert missing in capsys.readouterr().err

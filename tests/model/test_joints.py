"""What joins neighbouring images of a model, and where it hardly does."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap
import pytest

from colmap_av1.cli import main
from colmap_av1.model.agreement.crossings import model_crossings
from colmap_av1.model.agreement.joints import model_joints
from colmap_av1.model.colmap_model import read_model
from colmap_av1.reconstruct import ReconstructReport

_FAILED_CHECK = 1
_LEFT = 5
_SOUND = 0.95


def test_model_that_holds_together(made: ReconstructReport) -> None:
    joints = model_joints(read_model(made.output / "sparse" / "0"))
    assert len(joints.pairs) == made.num_registered - 1
    assert joints.weak == []
    assert joints.warning is None


def test_a_joint_that_few_points_hold(
    made: ReconstructReport, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = read_model(made.output / "sparse" / "0")
    by_name = sorted(model.images.values(), key=lambda image: image.name)
    middle = len(by_name) // 2
    before = {image.image_id for image in by_name[:middle]}
    joining = []
    for point_id, point in sorted(model.points3D.items()):
        own = [element.image_id in before for element in point.track.elements]
        if any(own) and not all(own):
            joining.append((len({e.image_id for e in point.track.elements}) > 2, point_id))
    for _, point_id in sorted(joining)[:-_LEFT]:
        model.delete_point3D(point_id)

    joints = model_joints(model)
    first, second = by_name[middle - 1].name, by_name[middle].name
    assert [joints.pairs[i] for i in joints.weak] == [(first, second)]
    assert joints.num_points[joints.weak].tolist() == [_LEFT]

    model.write(tmp_path)
    words = ["--model", str(tmp_path), "--image_path", str(made.output / "images")]
    assert main(["check", "--strict", *words]) == _FAILED_CHECK
    assert f"only {_LEFT} points join '{first}'" in capsys.readouterr().err


def test_parts_that_are_joined_wrongly(
    made: ReconstructReport, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """All after the middle is turned about it, as where a mapper takes the wrong of two poses."""
    model = read_model(made.output / "sparse" / "0")
    database = made.output / "database.db"
    sound = model_crossings(model, database)
    assert len(sound.pairs) == made.num_registered - 1
    assert sound.share.min() > _SOUND
    assert sound.warning is None

    by_name = sorted(model.images.values(), key=lambda image: image.name)
    middle = len(by_name) // 2
    turn = pycolmap.Rotation3d(np.array([0, 0, np.sin(0.1), np.cos(0.1)]))
    about = by_name[middle].cam_from_world()
    aside = about.inverse() * pycolmap.Rigid3d(turn, np.zeros(3)) * about
    for image in by_name[middle:]:
        image.frame.set_cam_from_world(image.camera_id, image.cam_from_world() * aside)
    bent = model_crossings(model, database)
    first, second = by_name[middle - 1].name, by_name[middle].name
    assert (first, second) in [bent.pairs[i] for i in bent.wrong]
    assert bent.warning is not None
    named = re.search("across '(.*)' and '(.*)' fit the poses", bent.warning)
    assert named is not None
    assert named[1] <= first < second <= named[2]

    model.write(tmp_path)
    words = ["--model", str(tmp_path), "--image_path", str(made.output / "images")]
    assert main(["check", "--strict", "--database", str(database), *words]) == _FAILED_CHECK
    assert "joined wrongly there" in capsys.readouterr().err

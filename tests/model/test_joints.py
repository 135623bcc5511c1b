"""What joins neighbouring images of a model, and where it hardly does."""

from __future__ import annotations

from pathlib import Path

import pytest

from colmap_av1.cli import main
from colmap_av1.model.agreement.joints import model_joints
from colmap_av1.model.colmap_model import read_model
from colmap_av1.reconstruct import ReconstructReport

_FAILED_CHECK = 1
_LEFT = 5


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

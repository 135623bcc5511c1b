"""Training commands that render at milestones, and the tables and curves of a report."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from colmap_av1.errors import EvaluationError
from colmap_av1.evaluate.metrics.renderings import RenderingMetrics
from colmap_av1.evaluate.report.results import Column
from colmap_av1.evaluate.report.tables import milestones_table, renderings_table
from colmap_av1.evaluate.training.splatting import Milestone
from colmap_av1.evaluate.training.trainers import Split, Training, train

# Writes the test images, darker after fewer iterations, and the time taken.
TRAINER = """
import pathlib, sys, cv2
test, renders = map(pathlib.Path, sys.argv[1:3])
lines = ["iterations,seconds,gaussians"]
for stop in map(int, sys.argv[3].split(",")):
    folder = renders / str(stop)
    folder.mkdir()
    for path in (test / "images").iterdir():
        cv2.imwrite(str(folder / path.name), cv2.imread(str(path)) // (9 - stop))
    lines.append(f"{stop},{2 * stop},{100 * stop}")
(renders / "times.csv").write_text("\\n".join(lines))
"""
NAMES = [f"{i}.png" for i in range(4)]


@pytest.fixture
def split(tmp_path: Path) -> Split:
    """Four images; this trainer needs no model."""
    made = Split(tmp_path / "data", tmp_path / "train", tmp_path / "test")
    rng = np.random.default_rng(0)
    halves = (made.whole, NAMES), (made.train, NAMES[::2]), (made.test, NAMES[1::2])
    for part, names in halves:
        (part / "images").mkdir(parents=True)
        for name in names:
            picture = rng.integers(0, 256, (96, 96, 3), np.uint8)
            cv2.imwrite(str(part / "images" / name), picture)
    return made


def train_with(split: Split, program: str, milestones: tuple[int, ...] = (2, 6)) -> Training:
    script = split.whole.parent / "train.py"
    script.write_text(program)
    command = f"{shlex.join([sys.executable, str(script)])} {{test}} {{renders}} {{milestones}}"
    return train(
        f"{command} {{data}}",
        split,
        split.whole.parent / "training",
        name="av1",
        iterations=8,
        milestones=milestones,
    )


def test_command_renders_at_milestones(split: Split) -> None:
    training = train_with(split, TRAINER, (6, 2, 8, 20))
    states = [(state.iteration, state.seconds, state.num_gaussians) for state in training.states]
    assert states == [(2, 4, 200), (6, 12, 600), (8, 16, 800)]
    psnr = [state.mean("psnr_y") for state in training.states]
    assert psnr[0] < psnr[1] < psnr[2] == 60
    assert (training.seconds, training.metrics.psnr_y.tolist()) == (16, [60, 60])
    assert [path.parent.name for path in training.renders] == ["8", "8"]

    # The result is kept, also if the times are unknown.
    again = train_with(split, TRAINER, (6, 2))
    assert [state.mean("vmaf") for state in again.states] == [
        state.mean("vmaf") for state in training.states
    ]
    untimed = TRAINER.replace("(renders /", "(test /")
    for _ in range(2):
        states = train_with(split, untimed, ()).states
        assert [state.iteration for state in states] == [8]
        assert np.isnan(states[0].seconds)
        assert states[0].num_gaussians is None


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("str(stop)", "str(stop + 1)", "0 renderings"),
        ("iterations,seconds", "steps,seconds", r"times\.csv"),
        ("{2 * stop}", "nan", r"times\.csv"),
    ],
)
def test_missing_output_of_a_command_is_reported(
    split: Split, old: str, new: str, message: str
) -> None:
    assert old in TRAINER
    with pytest.raises(EvaluationError, match=message):
        train_with(split, TRAINER.replace(old, new))
    assert not (split.whole.parent / "training" / "result.json").exists()


def column(name: str, *states: tuple[int, float, float]) -> Column:
    """A column of a training with these (iterations, seconds, PSNR-Y)."""
    found = tuple(
        Milestone(
            *(iteration, seconds, None),
            RenderingMetrics(
                *(np.array([psnr, psnr]) for _ in range(2)),
                vmaf=np.array([3 * psnr]),
                sharpness=np.ones(2),
                sharpness_difference=np.zeros(2),
                lpips=None,
                no_lpips="no weights",
            ),
        )
        for iteration, seconds, psnr in states
    )
    return Column(name, training=Training(found[-1].seconds, found, [], [], [], found[-1].metrics))


def test_report_tables() -> None:
    """Compared with SIFT after the same number of iterations and after the same time."""
    sift = column("sift-sequential", (10, 20.0, 20.0), (30, 80.0, 26.0))
    own = column("av1", (10, 30.0, 25.0), (30, 50.0, 27.0))
    bare = Column("disk")
    table = renderings_table([own, bare, sift])
    rows = {row[0]: dict(zip(table.header, row, strict=True)) for row in table.rows}
    assert rows["av1"]["time to baseline PSNR-Y"] == rows["av1"]["time to baseline VMAF"] == "50%"
    assert rows["sift-sequential"]["time to baseline VMAF"] == "100%"
    assert rows["disk"]["time to baseline VMAF"] == "-"
    assert "The baseline is sift-sequential" in table.about

    on_the_way = milestones_table([own, bare, sift])
    assert on_the_way is not None
    assert on_the_way.header == ["front-end", "10 iterations", "30 iterations", "20 s", "80 s"]
    assert on_the_way.rows == [
        ["av1", "25.00 / 25.00 / 75.0", "27.00 / 27.00 / 81.0", "-", "27.00 / 27.00 / 81.0"],
        [
            *("sift-sequential", "20.00 / 20.00 / 60.0", "26.00 / 26.00 / 78.0"),
            *("20.00 / 20.00 / 60.0", "26.00 / 26.00 / 78.0"),
        ],
    ]
    assert milestones_table([bare]) is None
    # Without SIFT there is no baseline; without times there are no columns in seconds.
    assert milestones_table([own]).header[1:] == ["10 iterations", "30 iterations"]
    assert "baseline is" not in renderings_table([own]).about
    untimed = column("sift-exhaustive", (10, np.nan, 20.0))
    assert milestones_table([untimed, sift, own]).header[1:] == ["10 iterations", "30 iterations"]


def test_report_curves() -> None:
    pictures = pytest.importorskip("colmap_av1.evaluate.report.pictures")
    timed = column("av1", (10, 30.0, 25.0), (30, 50.0, 27.0))
    assert pictures.training_chart([Column("disk")]) is None
    for columns in ([timed], [timed, column("sift-sequential", (10, np.nan, 20.0))]):
        chart = pictures.training_chart(columns)
        assert chart is not None
        assert chart.startswith(b"<?xml")
        assert chart == pictures.training_chart(columns)

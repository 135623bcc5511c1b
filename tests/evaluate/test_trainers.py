"""Training commands run without a shell, and errors name their log."""

from __future__ import annotations

import re
import shlex
import sys
from pathlib import Path

import pytest

from colmap_av1.errors import EvaluationError
from colmap_av1.evaluate.training.trainers import Split, check_trainer, train

ANSWER = "import sys; print(sys.argv[1:]); sys.exit(3)"


def test_folder_names_are_not_interpreted_by_a_shell(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "a b $(touch c) `touch d` '\"; touch e; {f}"
    split = Split(folder / "data", folder / "train", folder / "test")
    program = shlex.join([sys.executable, "-c", ANSWER])
    command = f"{program} \"{{data}}\" --to='{{output}}/x' {{{{}}}}"
    log = folder / "training" / "log.txt"
    with pytest.raises(EvaluationError, match=re.escape(str(log))):
        train(command, split, folder / "training", name="av1", iterations=7, milestones=())
    output = folder / "training" / "output" / "x"
    assert log.read_text() == f"{[str(split.train), f'--to={output}', '{}']}\n"
    assert [path.name for path in tmp_path.iterdir()] == [folder.name]


def test_missing_program_is_reported_before_the_work() -> None:
    check_trainer(f"{sys.executable} {{data}}")
    with pytest.raises(EvaluationError, match="install"):
        check_trainer("./train {data}")

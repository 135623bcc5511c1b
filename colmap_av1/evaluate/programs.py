"""Programs in separate processes, as torch and pycolmap must not share one; their packages."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from colmap_av1.errors import EvaluationError
from colmap_av1.util.processes import bound


def run_program(program: Path, task: Any) -> Any:
    """Run a program that reads JSON from its standard input and writes JSON to its output.

    Args:
        program: a Python file.
        task: what it reads.

    Returns:
        What it wrote.

    Raises:
        EvaluationError: it failed; the message is the last line that it wrote on its errors.
    """
    run = subprocess.run(
        bound([sys.executable, str(program)]),
        input=json.dumps(task),
        capture_output=True,
        text=True,
        check=False,
    )
    if run.returncode != 0:
        said = run.stderr.strip().splitlines()
        raise EvaluationError(said[-1] if said else f"{program.name} ended without a word")
    return json.loads(run.stdout)


def check_packages(what: str, packages: tuple[str, ...], extra: str) -> None:
    """Check at the start that the packages of an extra, needed later, are installed.

    Args:
        what: what needs them.
        packages: as they are imported.
        extra: the extra of this package that installs them.

    Raises:
        EvaluationError: one is missing.
    """
    missing = next((name for name in packages if not _is_there(name)), None)
    if missing is not None:
        raise EvaluationError(
            f"{what} needs the package {missing}: pip install 'colmap-av1[{extra}]'"
        )


def _is_there(package: str) -> bool:
    try:
        return find_spec(package) is not None
    except (ImportError, ValueError):  # it is blocked
        return False

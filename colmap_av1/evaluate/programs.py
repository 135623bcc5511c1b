"""Running programs that need torch in separate processes, and checking for their packages.

torch and pycolmap must not be loaded in the same process.
"""

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
    """Run a program that reads JSON from standard input and writes JSON to standard output.

    Args:
        program: a Python file.
        task: the program's input.

    Returns:
        The program's output.

    Raises:
        EvaluationError: the program failed; the message is the last line of its standard error.
    """
    run = subprocess.run(
        bound([sys.executable, str(program)]),
        input=json.dumps(task),
        capture_output=True,
        text=True,
        check=False,
    )
    if run.returncode != 0:
        lines = run.stderr.strip().splitlines()
        raise EvaluationError(lines[-1] if lines else f"{program.name} failed without a message")
    return json.loads(run.stdout)


def check_packages(what: str, packages: tuple[str, ...], extra: str) -> None:
    """Check before any work that the packages of an extra are installed.

    Args:
        what: the feature that needs them, for the message.
        packages: their import names.
        extra: the extra of this package that installs them.

    Raises:
        EvaluationError: a package is missing.
    """
    missing = next((name for name in packages if not _is_installed(name)), None)
    if missing is not None:
        raise EvaluationError(
            f"{what} needs the package {missing}: pip install 'colmap-av1[{extra}]'"
        )


def _is_installed(package: str) -> bool:
    try:
        return find_spec(package) is not None
    except (ImportError, ValueError):  # Its import is blocked.
        return False

"""Importing the package is lazy, has no side effects, and explains a missing extension."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

from conftest import PROJECT

import colmap_av1


def run_python(program: str, folder: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", program]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


def test_import_loads_no_libraries_and_has_no_side_effects(tmp_path: Path) -> None:
    run = run_python(
        "import signal, sys, threading\n"
        "handlers = [signal.getsignal(n) for n in signal.valid_signals()]\n"
        "import colmap_av1\n"
        "colmap_av1.MatchOptions(), colmap_av1.VideoError\n"
        "assert handlers == [signal.getsignal(n) for n in signal.valid_signals()]\n"
        "assert threading.active_count() == 1\n"
        "assert not {'numpy', 'pycolmap', 'cv2', 'av'} & set(sys.modules)",
        tmp_path,
    )
    assert run.stderr == ""


def test_modules_do_not_hide_functions_of_the_same_name(tmp_path: Path) -> None:
    run = run_python(
        "import colmap_av1.match, colmap_av1.check.database, colmap_av1.densify\n"
        "import colmap_av1.compare\n"
        "from colmap_av1 import check_database, compare, densify, match\n"
        "assert all(map(callable, (check_database, compare, densify, match, colmap_av1.match)))",
        tmp_path,
    )
    assert run.stderr == ""


def test_every_public_name_exists() -> None:
    assert [name for name in colmap_av1.__all__ if not hasattr(colmap_av1, name)] == []
    assert set(colmap_av1.__all__) <= set(dir(colmap_av1))
    assert not hasattr(colmap_av1, "no_such_name")


def test_numpy_is_imported_before_pycolmap(tmp_path: Path) -> None:
    """In the other order, writing a PNG file crashes the process."""
    for name in ("check_database", "check_model", "reconstruct"):
        run = run_python(
            f"import colmap_av1, sys; colmap_av1.{name}; print(*sys.modules)", tmp_path
        )
        loaded = run.stdout.split()
        assert loaded.index("numpy") < loaded.index("pycolmap")


def test_import_without_the_core_explains_how_to_build(tmp_path: Path) -> None:
    shutil.copytree(
        PROJECT / "colmap_av1",
        tmp_path / "colmap_av1",
        ignore=shutil.ignore_patterns("csrc", "_core*.so", "_core*.pyd", "__pycache__"),
    )
    for statement in ("import colmap_av1", "from colmap_av1.errors import VideoError"):
        run = run_python(f"import sys; sys.path.insert(0, ''); {statement}", tmp_path)
        last = run.stderr.splitlines()[-1]
        assert last.startswith("ImportError: ")
        assert "pip install -e ." in last

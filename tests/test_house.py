"""The package's layout: imports run down the flow, rooms and files stay small."""

from __future__ import annotations

import ast
from pathlib import Path

from conftest import PROJECT

PACKAGE = PROJECT / "colmap_av1"

# What each room may import: itself, and the rooms before it.
FLOW = (
    *("errors", "options", "util", "video", "motion", "tracks", "images", "matching"),
    *("database", "model", "commands", "evaluate", "compare", "cli"),
)
# Modules at the top are commands, but for these.
AT_THE_TOP = {"errors": "errors", "options": "options", "compare": "compare"}
MAX_MODULES, MAX_LINES, MAX_FUNCTION_LINES = 14, 450, 60
# Long for a reason: each says one thing in order.
LONG_FUNCTIONS: dict[str, int] = {}
LONG_FILES: dict[str, int] = {}


def modules() -> dict[str, Path]:
    """The package's modules but its roots, by dotted name without the package's."""
    paths = [p for p in PACKAGE.rglob("*.py") if "csrc" not in p.parts]
    names = {".".join(p.relative_to(PACKAGE).with_suffix("").parts): p for p in paths}
    return {name: p for name, p in names.items() if name not in ("__init__", "__main__")}


def room_of(name: str) -> str:
    first = name.split(".", maxsplit=1)[0]
    if first in FLOW:
        return first
    return AT_THE_TOP.get(first, "commands")


def imported(path: Path) -> set[str]:
    """Modules of the package that a module imports, without the package's name."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("colmap_av1."):
            found.add((node.module or "").removeprefix("colmap_av1."))
    return found


def test_imports_run_down_the_flow() -> None:
    climbs = [
        f"{name} imports {other}"
        for name, path in modules().items()
        for other in sorted(imported(path))
        if FLOW.index(room_of(other)) > FLOW.index(room_of(name))
    ]
    assert climbs == []


def test_rooms_and_files_are_small() -> None:
    folders = {p.parent for p in modules().values()}
    count = {f: sum(p.name != "__init__.py" for p in f.glob("*.py")) for f in folders}
    assert {f.name: n for f, n in count.items() if n > MAX_MODULES} == {}
    lines = {name: len(p.read_text().splitlines()) for name, p in modules().items()}
    assert {name: n for name, n in lines.items() if n > MAX_LINES} == LONG_FILES


def test_functions_are_short() -> None:
    long = {}
    for name, path in modules().items():
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef):
                # A docstring says how to use it, not what it does.
                documented = ast.get_docstring(node) is not None
                first = node.body[0].end_lineno if documented else node.lineno
                length = (node.end_lineno or 0) - (first or 0)
                if length > MAX_FUNCTION_LINES:
                    long[f"{name}.{node.name}"] = length
    assert long == LONG_FUNCTIONS

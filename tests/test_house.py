"""The layout of the package: folders only import earlier folders."""

from __future__ import annotations

import ast
from pathlib import Path

from conftest import PROJECT

PACKAGE = PROJECT / "colmap_av1"

# A folder may import itself and earlier folders.
FLOW = (
    *("errors", "options", "util", "video", "motion", "tracks", "geometry", "images", "matching"),
    *("database", "poses", "splats", "check", "interop", "commands", "evaluate", "compare", "cli"),
)
# Other top-level modules are commands.
AT_THE_TOP = {"errors": "errors", "options": "options", "compare": "compare"}


def modules() -> dict[str, Path]:
    """Modules of the package by dotted name, without `__init__` and `__main__`."""
    paths = [p for p in PACKAGE.rglob("*.py") if "csrc" not in p.parts]
    names = {".".join(p.relative_to(PACKAGE).with_suffix("").parts): p for p in paths}
    return {name: p for name, p in names.items() if name not in ("__init__", "__main__")}


def folder_of(name: str) -> str:
    first = name.split(".", maxsplit=1)[0]
    if first in FLOW:
        return first
    return AT_THE_TOP.get(first, "commands")


def imported(path: Path) -> set[str]:
    """Modules of the package that a module imports, without the name of the package."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("colmap_av1."):
            found.add((node.module or "").removeprefix("colmap_av1."))
    return found


def test_folders_only_import_earlier_folders() -> None:
    climbs = [
        f"{name} imports {other}"
        for name, path in modules().items()
        for other in sorted(imported(path))
        if FLOW.index(folder_of(other)) > FLOW.index(folder_of(name))
    ]
    assert climbs == []

"""Results of batches without their run times, and the processes of batches."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import colmap_av1

# The folder in which the package under test is installed.
PACKAGES = Path(colmap_av1.__file__).parents[1]
# Fields that differ between equal runs.
TIMES = ("seconds", "cpu_seconds")


def rows_of(output: Path, name: str = "batch.csv") -> list[dict[str, str]]:
    """The rows of a batch without the times."""
    with (output / name).open(newline="", errors="surrogateescape") as file:
        rows = list(csv.DictReader(file))
    return [{k: v for k, v in row.items() if k not in TIMES} for row in rows]


def files_of(output: Path) -> dict[str, bytes]:
    """Contents of the files of all videos, by path; reports without the times."""
    found = {}
    for path in sorted(output.rglob("*")):
        relative = path.relative_to(output)
        if path.is_file() and len(relative.parts) > 1 and relative.parts[0] != ".batch":
            content = path.read_bytes()
            if path.name == "report.json":
                content = json.dumps(_timeless(json.loads(content))).encode()
            found[relative.as_posix()] = content
    return found


def _timeless(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _timeless(v) for k, v in value.items() if k not in TIMES}
    return value


def workers_of(*drivers: int) -> list[int]:
    """Process ids of `colmap_av1` commands whose parents are the given processes."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            command = (folder / "cmdline").read_bytes()
        except OSError:  # the process has ended
            continue
        if parent in drivers and b"\0-m\0colmap_av1\0" in command:
            found.append(int(folder.name))
    return sorted(found)

"""Files of results: each script saves its rows to `results/NAME.csv` and prints its table.

`render.py` puts the tables of all files into the documents.
"""

from __future__ import annotations

import argparse
import csv
import math
import os
import platform
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path

RESULTS = Path(__file__).resolve().parent / "results"

Value = str | float | int | None


def clips_parser(
    description: str | None, clips: Sequence[str], accepted: str
) -> argparse.ArgumentParser:
    """A parser with the options of scripts that measure clips.

    Args:
        description: the docstring of the script.
        clips: names of the clips that are measured by default.
        accepted: which names are accepted, for the help.
    """
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cache", type=Path, required=True, help="folder for clips and results")
    parser.add_argument("--clips", nargs="+", default=clips, metavar="NAME", help=accepted)
    return parser


def add_results(parser: argparse.ArgumentParser, name: str) -> None:
    """Add the option for the CSV file of a script."""
    parser.add_argument(
        "--results",
        type=Path,
        default=RESULTS / f"{name}.csv",
        metavar="CSV",
        help="file for the results; rows that are not measured again are kept",
    )


def spelled(row: Mapping[str, Value]) -> dict[str, str]:
    """A row in the format of the CSV file: six significant digits, empty for None."""
    return {name: _spell(value) for name, value in row.items()}


def save(path: Path, rows: Sequence[Mapping[str, Value]], key: Sequence[str]) -> None:
    """Save rows to a CSV file, replacing existing rows with the same values of the `key` columns.

    Every row gets the commit of the checkout and the machine as its last columns.
    """
    kept = {tuple(row[name] for name in key): row for row in read_rows(path)}
    where = {"commit": commit(), "machine": machine()}
    for row in rows:
        new = spelled({**row, **where})
        kept[tuple(new[name] for name in key)] = new
    columns = dict.fromkeys(name for row in kept.values() for name in row if name not in where)
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, [*columns, *where], restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows(kept.values())


def read_rows(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV file; empty without a file."""
    if not path.is_file():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def commit() -> str:
    """The commit of this checkout, with a mark if files other than results have changed."""
    git = ["git", "-C", str(RESULTS.parent)]
    words = ["describe", "--always", "--exclude", "*"]
    done = subprocess.run([*git, *words], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        return "unknown"
    others = [":(top)", f":(exclude){RESULTS.name}"]
    changed = subprocess.run([*git, "diff", "--quiet", "HEAD", "--", *others], check=False)
    return done.stdout.strip() + ("-dirty" if changed.returncode != 0 else "")


def machine() -> str:
    """Number of cores, and name of the processor."""
    name = platform.processor() or platform.machine()
    cpus = Path("/proc/cpuinfo")
    if cpus.is_file():
        models = [s for s in cpus.read_text().splitlines() if s.startswith("model name")]
        name = models[0].partition(":")[2].strip() if models else name
    return f"{os.cpu_count()} cores, {name}"


def _spell(value: Value) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    return f"{value:.6g}" if isinstance(value, float) else str(value)

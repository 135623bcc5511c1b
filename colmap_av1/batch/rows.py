"""Rows of a batch as CSV and JSON files."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, TextIO

from colmap_av1.batch.jobs import Row

_COLUMNS = [field.name for field in dataclasses.fields(Row)]
_WORDS = {"name", "input", "state", "reason", "warnings", "error"}
_WARNINGS = "; "


def write_csv(rows: Iterable[Row], file: Path) -> None:
    """Write rows as CSV; names that are no valid text keep their bytes.

    Raises:
        OSError: it cannot be written.
    """
    with file.open("w", newline="", encoding="utf-8", errors="surrogateescape") as text:
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(_COLUMNS)
        for row in rows:
            writer.writerow(_csv_word(getattr(row, column)) for column in _COLUMNS)


def write_json(rows: Iterable[Row], file: Path, facts: Mapping[str, Any]) -> None:
    """Write facts of a batch and its rows as JSON, a line for each row.

    Raises:
        OSError: it cannot be written.
    """
    with file.open("w", encoding="ascii") as text:
        start = json.dumps(plain(facts), indent=1)
        text.write(start.removesuffix("\n}") + ',\n "rows": [')
        _write_lines(rows, text)
        text.write("]\n}\n")


def _write_lines(rows: Iterable[Row], text: TextIO) -> None:
    for number, row in enumerate(rows):
        text.write(",\n  " if number else "\n  ")
        text.write(json.dumps(row_facts(row)))


def read_json(lines: Iterable[str]) -> Iterator[Row]:
    """The rows of a file of `write_json`, one by one.

    Raises:
        ValueError: a line is damaged.
    """
    for line in lines:
        text = line.strip().rstrip(",").removesuffix("]")
        if text.startswith('{"name"'):
            yield row_of(json.loads(text))


def row_facts(row: Row) -> dict[str, Any]:
    """A row as JSON holds it."""
    facts: dict[str, Any] = plain(vars(row))
    return facts


def row_of(facts: Mapping[str, Any]) -> Row:
    """The row of such facts.

    Raises:
        ValueError: they are not those of a row.
    """
    try:
        row = Row(**{**facts, "warnings": tuple(facts["warnings"])})
    except (KeyError, TypeError) as error:
        raise ValueError(f"no row: {error}") from error
    words = (row.name, row.input, row.reason, row.error, *row.warnings)
    numbers = [getattr(row, name) for name in _COLUMNS if name not in _WORDS]
    is_valid = (
        row.state in ("done", "failed")
        and all(isinstance(word, str) for word in words)
        and all(n is None or (type(n) in (int, float) and math.isfinite(n)) for n in numbers)
    )
    if not is_valid:
        raise ValueError("no row: a value is of the wrong kind")
    return row


def plain(value: Any) -> Any:
    """A value as JSON holds it, which has neither paths nor NaN nor keys that are numbers."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if value is None or isinstance(value, (bool, str)):
        return value
    if hasattr(value, "item"):  # NumPy's numbers
        return plain(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if isinstance(value, int) else str(value)


def _csv_word(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, tuple):
        value = _WARNINGS.join(value)
    return repr(value) if isinstance(value, float) else str(value)

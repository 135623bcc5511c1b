"""Rows of a batch as CSV and JSON."""

from __future__ import annotations

import csv
import dataclasses
import io
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

import cattrs

from colmap_av1.util.plain import json_text
from colmap_av1.util.remote import without_secrets


@dataclass(frozen=True)
class Row:
    """Result of a video; the fields are the columns of `batch.csv`.

    Attributes:
        name: path of its folder in the output.
        input: path or URL of the video, without secrets.
        state: whether the video was processed.
        reason: kind of the failure; empty if done.
        seconds: wall time of the last attempt.
        cpu_seconds: CPU time of the last attempt, including child processes; None if unknown.
        video_seconds: duration of the video; None if unknown.
        frames: number of shown frames.
        images: number of frames chosen as images.
        registered: number of registered images.
        tracks: number of tracks.
        points: number of 3D points.
        coverage: share of the images' cells that visible points project into.
        warnings: warnings for the user.
        error: the failure's message.
    """

    name: str
    input: str
    state: Literal["done", "failed"]
    reason: str = ""
    seconds: float = 0.0
    cpu_seconds: float | None = None
    video_seconds: float | None = None
    frames: int | None = None
    images: int | None = None
    registered: int | None = None
    tracks: int | None = None
    points: int | None = None
    coverage: float | None = None
    warnings: tuple[str, ...] = ()
    error: str = ""


def csv_of(rows: Iterable[Row]) -> bytes:
    """Rows as CSV; names that are not valid UTF-8 keep their bytes."""
    text = io.StringIO()
    columns = [field.name for field in dataclasses.fields(Row)]
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(vars(row) | {"warnings": "; ".join(row.warnings)} for row in rows)
    return text.getvalue().encode("utf-8", "surrogateescape")


def json_of(rows: Iterable[Row], facts: Mapping[str, object]) -> bytes:
    """Facts of a batch and its rows as JSON."""
    return json_bytes({**facts, "rows": [vars(row) for row in rows]})


def json_bytes(value: object) -> bytes:
    """A value as the content of a JSON file, with secrets removed from URLs."""
    return json_text(value, without_secrets).encode("ascii")


def row_of(facts: object) -> Row:
    """Convert an object of a JSON file to a row.

    Raises:
        ValueError: it is not a row.
    """
    try:
        row = cattrs.structure(facts, Row)
        for value in vars(row).values():
            if isinstance(value, int):
                float(value)  # The page cannot show larger integers.
        return row
    except (cattrs.BaseValidationError, TypeError, KeyError, OverflowError) as error:
        raise ValueError(f"not a row: {error}") from error

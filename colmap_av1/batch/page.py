"""The HTML page of a batch: failures, quantiles of the results, and a table of the videos."""

from __future__ import annotations

import base64
import json
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path, PurePosixPath

import numpy as np

from colmap_av1.batch.output import PAGE, ROWS, Output, output_at
from colmap_av1.batch.rows import Row, row_of
from colmap_av1.batch.run import batch_files
from colmap_av1.batch.video import THUMBNAIL
from colmap_av1.errors import OptionError, writing
from colmap_av1.util.pages import render_page
from colmap_av1.util.remote import absolute, without_secrets

# Number of rows that browsers still sort without delay. Failures are shown first.
MOST_ROWS = 2000
_QUANTILES = {
    0.0: "minimum",
    0.1: "10%",
    0.25: "25%",
    0.5: "median",
    0.75: "75%",
    0.9: "90%",
    1.0: "maximum",
}
_NUMBERS = {
    "seconds": "seconds",
    "cpu_seconds": "CPU seconds",
    "frames": "frames",
    "images": "images",
    "registered": "registered images",
    "tracks": "tracks",
    "points": "points",
    "coverage": "coverage",
}
_COLUMNS = {
    "name": "video",
    "state": "state",
    **_NUMBERS,
    "warnings": "warnings",
    "error": "error",
}
_NUM_BARS = 24


def write_page(output: str | os.PathLike[str], *, most_rows: int = MOST_ROWS) -> str:
    """Write `report.html`, a self-contained page, into the output of a batch.

    It shows the rows of `batch.json`, or of the files of all shards.

    Args:
        output: the output, a folder or URL.
        most_rows: maximum number of videos in the table; failures are shown first.

    Returns:
        The page's path or URL.

    Raises:
        OptionError: the output has no batch, or a file of the batch is damaged.
        WriteError: the page cannot be written.

    Examples:
        >>> from colmap_av1 import write_page
        >>> write_page("my_batch")
        '/.../my_batch/report.html'
    """
    place = absolute(os.fspath(output)).rstrip("/")
    shown_place = without_secrets(place)
    into = output_at(place)
    rows = _rows(into, shown_place)
    failed = [row for row in rows if row.state == "failed"]
    done = [row for row in rows if row.state == "done"]
    shown = [*failed, *done][:most_rows]
    columns = [name for name in _COLUMNS if any(_is_known(row, name) for row in shown)]
    reasons = Counter(row.reason for row in failed)
    first = {row.reason: row.error for row in reversed(failed)}
    timed = [row for row in done if row.cpu_seconds is not None and row.video_seconds]
    video_seconds = sum(row.video_seconds or 0.0 for row in timed)
    cpu_seconds = sum(row.cpu_seconds or 0.0 for row in timed)
    text = render_page(
        "batch.html",
        place=shown_place,
        num_videos=len(rows),
        num_done=len(done),
        num_failed=len(failed),
        video_minutes=video_seconds / 60,
        cpu_hours=cpu_seconds / 3600 / (video_seconds / 60) * 1000 if video_seconds else None,
        failures=[(reason, count, first[reason]) for reason, count in reasons.most_common()],
        quantiles=list(_QUANTILES.values()),
        spreads=_spreads(done),
        titles=[_COLUMNS[name] for name in columns],
        are_texts=[name not in _NUMBERS for name in columns],
        rows=[
            (row, _thumbnail(row, into), [_cell(row, name) for name in columns]) for row in shown
        ],
    )
    with writing(Path(f"{shown_place}/{PAGE}")):
        into.write(PAGE, text.encode("utf-8", "replace"))
    return f"{shown_place}/{PAGE}"


def _rows(into: Output, place: str) -> list[Row]:
    """The rows of all shards, one per video: that of the run that wrote its file last."""
    try:
        names = batch_files(into)
    except OSError as error:
        raise OptionError(
            f"{place}: cannot be read: {error}: give the output of a batch"
        ) from error
    if not names:
        raise OptionError(f"{place}: has no {ROWS}.json: give the output of a batch")
    tables: list[tuple[float, list[Row]]] = []
    for name in names:
        try:
            table = json.loads(into.read(name) or b"")
            tables.append((0.0, list(map(row_of, table.get("earlier", [])))))
            tables.append((float(table.get("time", 0)), list(map(row_of, table["rows"]))))
        except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
            raise OptionError(f"{place}/{name}: damaged: run the batch again") from error
    tables.sort(key=lambda table: table[0])
    return list({row.name: row for _, rows in tables for row in rows}.values())


def _spreads(rows: Sequence[Row]) -> list[Mapping[str, object]]:
    """Title, quantiles over all rows, and histogram heights of each numeric column."""
    spreads: list[Mapping[str, object]] = []
    for name, title in _NUMBERS.items():
        known = [value for row in rows if (value := getattr(row, name)) is not None]
        values = np.array(known, dtype=np.float64)
        if len(values) == 0 or not np.isfinite(values).all():
            continue
        counts, _ = np.histogram(values, bins=_NUM_BARS)
        spreads.append(
            {
                "title": title,
                "quantiles": [_number(name, q) for q in np.quantile(values, list(_QUANTILES))],
                "heights": (counts / counts.max()).tolist(),
            }
        )
    return spreads


def _cell(row: Row, name: str) -> tuple[str, object]:
    """A cell's text and sort key."""
    value: object = getattr(row, name)
    if isinstance(value, (int, float)):
        return _number(name, value), value
    text = "; ".join(value) if isinstance(value, tuple) else str(value or "")
    return text, text


def _is_known(row: Row, name: str) -> bool:
    return getattr(row, name) not in (None, "", ())


def _number(name: str, value: float) -> str:
    if name == "coverage":
        return f"{value:.1%}"
    return f"{value:,.2f}" if name.endswith("seconds") else f"{value:,.0f}"


def _thumbnail(row: Row, into: Output) -> str | None:
    """The thumbnail of a video in base64; None if there is none."""
    name, content = PurePosixPath(row.name), None
    if row.state != "done" or name.is_absolute() or ".." in name.parts:
        return None
    with suppress(OSError, ValueError):  # The page is useful without it.
        content = into.read(f"{name}/{THUMBNAIL}")
    return base64.b64encode(content).decode() if content else None

"""The page of a batch: one HTML file with every failure, the videos, and how they are spread."""

from __future__ import annotations

import base64
import html
import io
import os
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from colmap_av1.batch.files import absolute
from colmap_av1.batch.jobs import Row
from colmap_av1.batch.outputs import PAGE, ROWS, Output, output_at
from colmap_av1.batch.rows import read_json
from colmap_av1.batch.tasks import THUMBNAIL
from colmap_av1.errors import OptionError, cannot_write

# Rows that browsers sort at once; of more videos, failures come first.
MOST_ROWS = 2000
_QUANTILES = (0.0, 0.1, 0.25, 0.5, 0.75, 0.9, 1.0)
_SPREAD = {
    "seconds": "seconds",
    "cpu_seconds": "CPU seconds",
    "frames": "frames",
    "images": "images",
    "registered": "images with a pose",
    "tracks": "tracks",
    "points": "points",
    "coverage": "coverage",
}
_COLUMNS = {
    "name": "video",
    "state": "state",
    **_SPREAD,
    "warnings": "warnings",
    "error": "error",
}
_NUM_BARS, _BAR_HEIGHT = 24, 26
_CSS = """
body { font: 15px/1.5 system-ui, "Helvetica Neue", Arial, sans-serif; color: #1f2937;
  max-width: 1280px; margin: 2.5em auto; padding: 0 1.5em; }
h1 { font-size: 1.6em; margin: 0 0 .2em; }
h2 { font-size: 1.15em; margin: 2.2em 0 .5em; border-bottom: 1px solid #e5e7eb; }
p.about { color: #4b5563; margin: .3em 0 1em; overflow-wrap: anywhere; }
table { border-collapse: collapse; font-size: 13px; margin: .6em 0; }
th { text-align: right; font-weight: 600; border-bottom: 2px solid #9ca3af; padding: .3em .7em;
  vertical-align: bottom; }
td { text-align: right; border-bottom: 1px solid #e5e7eb; padding: .3em .7em;
  font-variant-numeric: tabular-nums; white-space: nowrap; }
td.text, th.text { text-align: left; white-space: normal; overflow-wrap: anywhere;
  min-width: 8em; max-width: 24em; }
th:first-child, td:first-child { padding-left: 0; }
#videos { width: 100%; }
#failures td.text { max-width: 60em; }
#videos th { position: sticky; top: 0; background: #fff; cursor: pointer; }
#videos th[data-order=up]::after { content: " \\25b2"; }
#videos th[data-order=down]::after { content: " \\25bc"; }
td img { width: 80px; display: block; border-radius: 3px; }
tr.failed td { background: #fef2f2; }
svg { display: block; }
footer { color: #6b7280; font-size: 12px; margin-top: 3em; }
"""
_SCRIPT = """
const table = document.getElementById("videos"), body = table.tBodies[0];
table.tHead.addEventListener("click", event => {
  const head = event.target.closest("th");
  if (!head) return;
  const down = head.dataset.order === "up", column = head.cellIndex;
  for (const other of table.tHead.rows[0].cells) delete other.dataset.order;
  head.dataset.order = down ? "down" : "up";
  const keys = new Map([...body.rows].map(row => [row, row.cells[column].dataset.key ?? ""]));
  const compare = (a, b) => {
    const x = keys.get(a), y = keys.get(b);
    if (x === "" || y === "") return (x === "") - (y === "");  // what is not known comes last
    const order = head.classList.contains("text") ? x.localeCompare(y) : x - y;
    return down ? -order : order;
  };
  body.append(...[...body.rows].sort(compare));
});
"""


@dataclass
class _Totals:
    """What is counted over all rows."""

    num_videos: int = 0
    reasons: Counter[str] = field(default_factory=Counter)
    examples: dict[str, str] = field(default_factory=dict)
    values: dict[str, list[float]] = field(default_factory=lambda: {name: [] for name in _SPREAD})
    cpu_seconds: float = 0.0
    video_seconds: float = 0.0

    def add(self, row: Row) -> None:
        self.num_videos += 1
        if row.state == "failed":
            self.reasons[row.reason] += 1
            self.examples.setdefault(row.reason, row.error)
            return
        for name, values in self.values.items():
            value = getattr(row, name)
            if value is not None:
                values.append(value)
        if row.cpu_seconds is not None and row.video_seconds is not None:
            self.cpu_seconds += row.cpu_seconds
            self.video_seconds += row.video_seconds


def write_page(output: str | os.PathLike[str], *, most_rows: int = MOST_ROWS) -> str:
    """Write `report.html` into the output of a batch: it needs no other file and no network.

    It shows the rows that `batch.json`, and those of shards, hold.

    Args:
        output: the output, a folder or URL.
        most_rows: videos that the table shows, failures first.

    Returns:
        The page's path or URL.

    Raises:
        OptionError: there is no batch, a file of it is damaged, or the page cannot be written.
    """
    place = absolute(os.fspath(output))
    into = output_at(place)
    names = [n for n in _files(into, place) if n == f"{ROWS}.json" or n.startswith(f"{ROWS}-")]
    if not names:
        raise OptionError(f"{place}: holds no {ROWS}.json: give the output of a batch")
    totals = _Totals()
    failed: list[Row] = []
    done: list[Row] = []
    for row in _rows(into, place, names):
        totals.add(row)
        shown = failed if row.state == "failed" else done
        if len(shown) < most_rows:
            shown.append(row)
    shown = [*failed, *done][:most_rows]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / PAGE
        with file.open("w", encoding="utf-8", errors="replace") as text:
            for piece in _page(place, totals, shown, into):
                text.write(piece)
        try:
            into.put(file, PAGE)
        except OSError as error:
            raise OptionError(cannot_write(Path(f"{place}/{PAGE}"), error)) from error
    return f"{place.rstrip('/')}/{PAGE}"


def _files(into: Output, place: str) -> list[str]:
    try:
        return into.files(".json")
    except OSError as error:
        raise OptionError(
            f"{place}: cannot be read: {error}: give the output of a batch"
        ) from error


def _rows(into: Output, place: str, names: Sequence[str]) -> Iterator[Row]:
    for name in names:
        try:
            content = into.read(name) or b""
            yield from read_json(io.TextIOWrapper(io.BytesIO(content), encoding="ascii"))
        except (OSError, ValueError, OverflowError, RecursionError) as error:
            raise OptionError(f"{place}/{name}: damaged: run the batch again") from error


def _page(place: str, totals: _Totals, rows: Sequence[Row], into: Output) -> Iterator[str]:
    num_failed = totals.reasons.total()
    about = f"{totals.num_videos:,} videos, {totals.num_videos - num_failed:,} done, "
    about += f"{num_failed:,} failed. "
    if totals.video_seconds > 0:
        minutes = totals.video_seconds / 60
        hours = totals.cpu_seconds / 3600 / minutes * 1000
        about += f"{minutes:,.1f} minutes of video at {hours:,.1f} CPU hours for 1,000 of them."
    yield (
        f'<!doctype html>\n<html lang="en">\n<meta charset="utf-8">\n<title>Batch</title>\n'
        f"<style>{_CSS}</style>\n<h1>Batch</h1>\n"
        f'<p class="about">{_text(place)}</p>\n<p class="about">{about}</p>\n'
    )
    if totals.reasons:
        yield _failures(totals)
    yield _spread(totals)
    shown = {name: title for name, title in _COLUMNS.items() if _is_used(name, rows)}
    part = "" if len(rows) == totals.num_videos else f": {len(rows):,} of {totals.num_videos:,}"
    yield f'<h2>Videos{part}</h2>\n<p class="about">A click on a heading sorts by it.</p>\n'
    heads = "".join(f"<th{_kind(name)}>{title}</th>" for name, title in shown.items())
    yield f'<table id="videos">\n<thead><tr><th></th>{heads}</tr></thead>\n<tbody>\n'
    for row in rows:
        cells = "".join(_cell(name, getattr(row, name)) for name in shown)
        yield f'<tr class="{_text(row.state)}"><td>{_thumbnail(row, into)}</td>{cells}</tr>\n'
    yield f"</tbody>\n</table>\n<script>{_SCRIPT}</script>\n</html>\n"


def _failures(totals: _Totals) -> str:
    lines = "".join(
        f'<tr><td class="text">{_text(reason)}</td><td>{count:,}</td>'
        f'<td class="text">{_text(totals.examples[reason])}</td></tr>\n'
        for reason, count in totals.reasons.most_common()
    )
    head = '<tr><th class="text">reason</th><th>videos</th><th class="text">the first one</th></tr>'
    return f"<h2>Failures</h2>\n<table id=failures>\n{head}\n{lines}</table>\n"


def _spread(totals: _Totals) -> str:
    heads = "".join(f"<th>{_quantile_name(q)}</th>" for q in _QUANTILES)
    lines = []
    for name, title in _SPREAD.items():
        values = np.array(totals.values[name], dtype=np.float64)
        if len(values):
            cells = "".join(f"<td>{_number(name, q)}</td>" for q in np.quantile(values, _QUANTILES))
            bars = f"<td>{_bars(values)}</td>"
            lines.append(f'<tr><td class="text">{title}</td>{cells}{bars}</tr>\n')
    if not lines:
        return ""
    head = f'<tr><th class="text">of a video</th>{heads}<th></th></tr>'
    body = "".join(lines)
    return f"<h2>Quantiles of the done ones</h2>\n<table id=quantiles>\n{head}\n{body}</table>\n"


def _bars(values: Any) -> str:
    """How values are spread from the least to the largest."""
    counts, _ = np.histogram(values, bins=_NUM_BARS)
    heights = [_BAR_HEIGHT * int(count) / int(counts.max()) for count in counts]
    bars = "".join(
        f'<rect x="{5 * i}" y="{_BAR_HEIGHT - h:.1f}" width="4" height="{h:.1f}"/>'
        for i, h in enumerate(heights)
        if h
    )
    size = f'width="{5 * _NUM_BARS}" height="{_BAR_HEIGHT}"'
    return f'<svg {size} fill="#64748b">{bars}</svg>'


def _cell(name: str, value: Any) -> str:
    if isinstance(value, tuple):
        value = "; ".join(value)
    if value is None or value == "":
        return f"<td{_kind(name)}></td>"
    words = str(value) if isinstance(value, str) else _number(name, value)
    return f'<td{_kind(name)} data-key="{_text(str(value))}">{_text(words)}</td>'


def _kind(name: str) -> str:
    return "" if name in _SPREAD else ' class="text"'


def _is_used(name: str, rows: Iterable[Row]) -> bool:
    return any(getattr(row, name) not in (None, "", ()) for row in rows)


def _number(name: str, value: float) -> str:
    if name == "coverage":
        return f"{value:.1%}"
    return f"{value:,.2f}" if name.endswith("seconds") else f"{value:,.0f}"


def _quantile_name(quantile: float) -> str:
    return {0.0: "least", 0.5: "median", 1.0: "largest"}.get(quantile, f"{quantile:.0%}")


def _thumbnail(row: Row, into: Output) -> str:
    try:
        content = into.read(f"{row.name}/{THUMBNAIL}") if row.state == "done" else None
    except OSError:  # a page without it is of use
        content = None
    if content is None:
        return ""
    return f'<img alt="" src="data:image/jpeg;base64,{base64.b64encode(content).decode()}">'


def _text(words: str) -> str:
    return html.escape(words)

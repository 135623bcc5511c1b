"""The report of a comparison: one HTML file and JSON."""

from __future__ import annotations

import base64
import dataclasses
import html
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap
from numpy.typing import NDArray

from colmap_av1.evaluate.frontends.footage import Footage
from colmap_av1.evaluate.report.pictures import (
    bar_charts,
    cost_chart,
    crop_window,
    draw_perspective,
    draw_plan,
    length_chart,
    training_chart,
    view_of,
)
from colmap_av1.evaluate.report.results import Cloud, Column, CompareReport
from colmap_av1.evaluate.report.tables import (
    Table,
    cost_table,
    lengths_table,
    milestones_table,
    models_table,
    renderings_table,
)
from colmap_av1.util.digests import package_version
from colmap_av1.util.files import whole_file

_CSS = """
body { font: 15px/1.5 system-ui, "Helvetica Neue", Arial, sans-serif; color: #1f2937;
  max-width: 1120px; margin: 2.5em auto; padding: 0 1.5em; }
h1 { font-size: 1.6em; margin: 0 0 .2em; }
h2 { font-size: 1.15em; margin: 2.2em 0 .5em; border-bottom: 1px solid #e5e7eb; }
p.about { color: #4b5563; margin: .3em 0 1em; }
table { border-collapse: collapse; font-size: 13px; margin: .6em 0; }
th { text-align: right; font-weight: 600; border-bottom: 2px solid #9ca3af; padding: .3em .7em;
  vertical-align: bottom; }
td { text-align: right; border-bottom: 1px solid #e5e7eb; padding: .3em .7em;
  font-variant-numeric: tabular-nums; white-space: nowrap; }
table.cost td:last-child, table.cost th:last-child { text-align: left; white-space: normal; }
th:first-child, td:first-child { text-align: left; padding-left: 0; }
.clouds { display: grid; grid-template-columns: repeat(auto-fill, minmax(300px, 1fr)); gap: 14px; }
.clouds.upright { grid-template-columns: repeat(auto-fill, minmax(240px, 1fr)); }
figure { margin: 0; }
figcaption { font-size: 13px; margin: .25em 0 .6em; }
figure img, .chart { width: 100%; display: block; }
figure img { border-radius: 3px; }
ul.notes { padding-left: 1.2em; }
footer { color: #6b7280; font-size: 12px; margin-top: 3em; }
"""


@dataclass(frozen=True)
class _Figure:
    """A picture, its file format by the ending of its name."""

    name: str
    caption: str
    content: bytes

    @property
    def uri(self) -> str:
        kind = {".svg": "image/svg+xml", ".png": "image/png"}[Path(self.name).suffix]
        return f"data:{kind};base64,{base64.b64encode(self.content).decode()}"


def write_report(report: CompareReport, clouds: Mapping[str, Cloud], footage: Footage) -> None:
    """Write `report.html` and `results.json`.

    The HTML file needs no other and no network.

    Args:
        report: what was measured.
        clouds: points and cameras of each column that has a model.
        footage: the images.

    Raises:
        OSError: a file cannot be written.
    """
    figures = {
        "bars": [_Figure("figures.svg", "Main figures", bar_charts(report))],
        "clouds": _cloud_figures(report, clouds, footage),
        "lengths": [_Figure("track_lengths.svg", "Track lengths", length_chart(report.columns))],
        "cost": [_Figure("cpu_time.svg", "CPU time", cost_chart(report.columns))],
    }
    curves = training_chart(report.columns)
    if curves is not None:
        figures["training"] = [_Figure("training.svg", "Renderings over time", curves)]
    figures["crops"] = _crop_figures(report.columns)
    tables = {"models": models_table(report), "cost": cost_table(report.columns)}
    tables["lengths"] = lengths_table(report.columns)
    if any(column.training is not None for column in report.columns):
        tables["renderings"] = renderings_table(report.columns)
    on_the_way = milestones_table(report.columns)
    if on_the_way is not None:
        tables["milestones"] = on_the_way
    _write(report.output / "report.html", _html(report, tables, figures).encode())
    _write(report.output / "results.json", _json(report).encode())


def _write(path: Path, content: bytes) -> None:
    with whole_file(path) as partial:
        partial.write_bytes(content)


def _json(report: CompareReport) -> str:
    def plain(value: Any) -> Any:
        """Values as JSON holds them, which has neither paths nor NaN."""
        if isinstance(value, dict):
            return {str(k): plain(v) for k, v in value.items()}
        if isinstance(value, (list, tuple)):
            return [plain(v) for v in value]
        if isinstance(value, np.ndarray):
            return plain(value.tolist())
        if isinstance(value, float) and not math.isfinite(value):
            return None
        return str(value) if isinstance(value, Path) else value

    facts = plain(dataclasses.asdict(report))
    for column, result in zip(report.columns, facts["columns"], strict=True):
        if column.cloud is not None:
            result["cloud"]["chamfer"] = column.cloud.chamfer
    facts["versions"] = _versions()
    return json.dumps(facts, indent=1) + "\n"


def _versions() -> dict[str, str]:
    return {"colmap-av1": package_version(), "pycolmap": pycolmap.__version__}


def _crop_figures(columns: Sequence[Column]) -> list[_Figure]:
    """The same part of a test image and of its renderings."""
    trained = [(c.name, c.training) for c in columns if c.training is not None]
    shared = (
        [n for n in trained[0][1].names if all(n in t.names for _, t in trained)] if trained else []
    )
    if not shared:
        return []
    name = shared[len(shared) // 2]
    first = trained[0][1]
    reference = _picture(first.references[first.names.index(name)])
    rows, cols = crop_window(reference)
    figures = [_crop("photograph", f"{name}, photograph", reference[rows, cols])]
    for column, training in trained:
        i = training.names.index(name)
        label = (
            f"{column}: {training.metrics.psnr_y[i]:.2f} dB, VMAF {training.metrics.vmaf[i]:.1f}"
        )
        figures.append(
            _crop(column.replace(" ", ""), label, _picture(training.renders[i])[rows, cols])
        )
    return figures


def _crop(name: str, caption: str, picture: NDArray[np.uint8]) -> _Figure:
    _, encoded = cv2.imencode(".png", picture)
    return _Figure(f"{name}_crop.png", caption, encoded.tobytes())


def _picture(path: Path) -> NDArray[np.uint8]:
    return np.asarray(cv2.imread(str(path), cv2.IMREAD_COLOR), dtype=np.uint8)


def _cloud_figures(
    report: CompareReport, clouds: Mapping[str, Cloud], footage: Footage
) -> list[_Figure]:
    """Each cloud from two viewpoints that are the same for all."""
    like = clouds.get(report.cloud_reference) or next(
        (cloud for cloud in clouds.values() if cloud.is_aligned), None
    )
    figures = []
    for column in report.columns:
        cloud = clouds.get(column.name)
        if cloud is None:
            continue
        model = like if like is not None and cloud.is_aligned else cloud
        drawn = {
            "view": draw_perspective(cloud, view_of(model), footage.size),
            "plan": draw_plan(cloud, model, (640, 480)),
        }
        label = f"{column.name}: {len(cloud.points):,} points"
        if like is not None and not cloud.is_aligned:
            label += ", in its own coordinates"
        for kind, picture in drawn.items():
            _, encoded = cv2.imencode(".png", picture)
            name = f"{column.name.replace(' ', '')}_{kind}.png"
            seen = {"view": "", "plan": ", from above"}[kind]
            figures.append(_Figure(name, f"{label}{seen}", encoded.tobytes()))
    return figures


def _facts(report: CompareReport) -> str:
    known = "intrinsics given and kept" if report.fixed_intrinsics else "intrinsics unknown"
    label = (
        f"{report.num_images} images of {report.num_frames} frames, "
        f"{report.size[0]}x{report.size[1]}; {known}; COLMAP's incremental mapper with the same "
        "settings for every front-end"
    )
    if report.forward_motion:
        label += ", which may start with images along its direction of motion"
    return f"{label}."


def _notes(report: CompareReport) -> list[str]:
    notes = [f"{column.name}: {column.error}" for column in report.columns if column.error]
    for column in report.columns:
        if column.num_models > 1:
            notes.append(
                f"{column.name}: the mapper made {column.num_models} models, the one with the "
                "most images is measured"
            )
        if column.model is not None and column.model.num_registered < report.num_images:
            missing = report.num_images - column.model.num_registered
            notes.append(f"{column.name}: {missing} images have no pose")
    untrained: dict[str, list[str]] = {}
    for column in report.columns:
        if column.training_error:
            untrained.setdefault(column.training_error, []).append(column.name)
    notes += [f"nothing rendered of {', '.join(names)}: {e}" for e, names in untrained.items()]
    if not report.pose_reference:
        notes.append(
            "no poses or cloud to measure against: give --reference, or compare sift-exhaustive"
        )
    return [*notes, *report.warnings]


def _html(
    report: CompareReport, tables: Mapping[str, Table], figures: Mapping[str, list[_Figure]]
) -> str:
    def table(kind: str) -> str:
        one = tables[kind]
        head = "".join(f"<th>{html.escape(cell)}</th>" for cell in one.header)
        rows = "".join(
            f"<tr>{''.join(f'<td>{html.escape(cell)}</td>' for cell in row)}</tr>"
            for row in one.rows
        )
        about = f'<p class="about">{html.escape(one.about)}</p>' if one.about else ""
        return (
            f"<h2>{html.escape(one.title)}</h2><table class='{kind}'><thead><tr>{head}</tr></thead>"
            f"<tbody>{rows}</tbody></table>{about}"
        )

    def chart(figure: _Figure) -> str:
        return f'<img class="chart" alt="{html.escape(figure.caption)}" src="{figure.uri}">'

    def grid(kind: str) -> str:
        each = "".join(
            f'<figure><img alt="{html.escape(f.caption)}" src="{f.uri}">'
            f"<figcaption>{html.escape(f.caption)}</figcaption></figure>"
            for f in (*figures["clouds"], *figures["crops"])
            if f.name.endswith(f"_{kind}.png")
        )
        upright = " upright" if kind == "view" and report.size[1] > report.size[0] else ""
        return f'<div class="clouds{upright}">{each}</div>'

    renderings = ""
    if "renderings" in tables:
        renderings = table("renderings")
        renderings += table("milestones") if "milestones" in tables else ""
        renderings += "".join(map(chart, figures.get("training", []))) + grid("crop")
    title = html.escape(f"Front-ends compared on {report.video.name}")
    notes = "".join(f"<li>{html.escape(note)}</li>" for note in _notes(report))
    versions = ", ".join(f"{name} {number}" for name, number in _versions().items())
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{title}</title><style>{_CSS}</style></head><body>"
        f'<h1>{title}</h1><p class="about">{html.escape(_facts(report))}</p>'
        + (f'<ul class="notes">{notes}</ul>' if notes else "")
        + table("models")
        + chart(figures["bars"][0])
        + "<h2>Clouds from one viewpoint</h2>"
        + '<p class="about">Behind and above the middle camera; below, from above. Red: the '
        + "camera's path.</p>"
        + grid("view")
        + grid("plan")
        + renderings
        + table("lengths")
        + chart(figures["lengths"][0])
        + table("cost")
        + chart(figures["cost"][0])
        + f"<footer>{html.escape(versions)}</footer></body></html>\n"
    )

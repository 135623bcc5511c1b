"""Writing the report of a comparison as HTML and JSON."""

from __future__ import annotations

import base64
import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

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
    published_table,
    renderings_table,
)
from colmap_av1.images.files import read_image
from colmap_av1.util.digests import package_version
from colmap_av1.util.files import whole_file
from colmap_av1.util.pages import render_page
from colmap_av1.util.plain import json_text


@dataclass(frozen=True)
class _Figure:
    """A picture of the page.

    Attributes:
        caption: the text below it.
        content: the encoded picture.
        mime: the media type of its format.
    """

    caption: str
    content: bytes
    mime: str

    @property
    def uri(self) -> str:
        return f"data:{self.mime};base64,{base64.b64encode(self.content).decode()}"


def _svg(caption: str, content: bytes) -> _Figure:
    return _Figure(caption, content, "image/svg+xml")


def _png(caption: str, picture: NDArray[np.uint8]) -> _Figure:
    _, encoded = cv2.imencode(".png", picture)
    return _Figure(caption, encoded.tobytes(), "image/png")


def write_report(report: CompareReport, clouds: Mapping[str, Cloud], footage: Footage) -> None:
    """Write `report.html`, a self-contained page, and `results.json`.

    Args:
        report: the results.
        clouds: points and cameras of each column that has a model.
        footage: the images.

    Raises:
        OSError: a file cannot be written.
    """
    charts = {
        "bars": [_svg("Main figures", bar_charts(report))],
        "lengths": [_svg("Track lengths", length_chart(report.columns))],
        "cost": [_svg("CPU time", cost_chart(report.columns))],
    }
    curves = training_chart(report.columns)
    if curves is not None:
        charts["training"] = [_svg("Renderings over time", curves)]
    grids = _cloud_figures(report, clouds, footage)
    grids["crop"] = _crop_figures(report.columns)
    tables = {"models": models_table(report)}
    if report.pose_reference or report.cloud_reference:
        tables["published"] = published_table(report)
    tables["cost"] = cost_table(report.columns)
    tables["lengths"] = lengths_table(report.columns)
    if any(column.training is not None for column in report.columns):
        tables["renderings"] = renderings_table(report.columns)
    milestones = milestones_table(report.columns)
    if milestones is not None:
        tables["milestones"] = milestones
    page = _html(report, tables, charts, grids)
    _write(report.output / "report.html", page.encode("utf-8", "replace"))
    _write(report.output / "results.json", _json(report).encode())


def _write(path: Path, content: bytes) -> None:
    with whole_file(path) as partial:
        partial.write_bytes(content)


def _json(report: CompareReport) -> str:
    facts = dataclasses.asdict(report)
    for column, result in zip(report.columns, facts["columns"], strict=True):
        if column.cloud is not None:
            result["cloud"]["chamfer"] = column.cloud.chamfer
    facts["versions"] = _versions()
    return json_text(facts)


def _versions() -> dict[str, str]:
    return {"colmap-av1": package_version(), "pycolmap": pycolmap.__version__}


def _crop_figures(columns: Sequence[Column]) -> list[_Figure]:
    """The same window of a test image and of its renderings."""
    trained = [(c.name, c.training) for c in columns if c.training is not None]
    shared = (
        [n for n in trained[0][1].names if all(n in t.names for _, t in trained)] if trained else []
    )
    if not shared:
        return []
    name = shared[len(shared) // 2]
    first = trained[0][1]
    reference = read_image(first.references[first.names.index(name)])
    rows, cols = crop_window(reference)
    figures = [_png(f"{name}, photograph", reference[rows, cols])]
    for column, training in trained:
        i = training.names.index(name)
        caption = (
            f"{column}: {training.metrics.psnr_y[i]:.2f} dB, VMAF {training.metrics.vmaf[i]:.1f}"
        )
        figures.append(_png(caption, read_image(training.renders[i])[rows, cols]))
    return figures


def _cloud_figures(
    report: CompareReport, clouds: Mapping[str, Cloud], footage: Footage
) -> dict[str, list[_Figure]]:
    """Each cloud from two viewpoints, "view" and "plan"; the same for all aligned clouds."""
    reference = clouds.get(report.cloud_reference) or next(
        (cloud for cloud in clouds.values() if cloud.is_aligned), None
    )
    figures: dict[str, list[_Figure]] = {"view": [], "plan": []}
    for column in report.columns:
        cloud = clouds.get(column.name)
        if cloud is None:
            continue
        framed = reference if reference is not None and cloud.is_aligned else cloud
        caption = f"{column.name}: {len(cloud.points):,} points"
        if reference is not None and not cloud.is_aligned:
            caption += ", in its own coordinates"
        view = draw_perspective(cloud, view_of(framed), footage.size)
        figures["view"].append(_png(caption, view))
        plan = draw_plan(cloud, framed, (640, 480))
        figures["plan"].append(_png(f"{caption}, from above", plan))
    return figures


def _facts(report: CompareReport) -> str:
    known = "intrinsics given and fixed" if report.fixed_intrinsics else "intrinsics estimated"
    facts = (
        f"{report.num_images} images of {report.num_frames} frames, "
        f"{report.size[0]}x{report.size[1]}; {known}; COLMAP's incremental mapper with the same "
        "settings for every front-end"
    )
    if report.forward_motion:
        facts += ", which may initialize with pairs of forward motion"
    return f"{facts}."


def _notes(report: CompareReport) -> list[str]:
    notes = [f"{column.name}: {column.error}" for column in report.columns if column.error]
    for column in report.columns:
        if column.num_models > 1:
            notes.append(
                f"{column.name}: the mapper created {column.num_models} models, the one with the "
                "most images is measured"
            )
        if column.model is not None and column.model.num_registered < report.num_images:
            missing = report.num_images - column.model.num_registered
            notes.append(f"{column.name}: {missing} images are not registered")
    untrained: dict[str, list[str]] = {}
    for column in report.columns:
        if column.training_error:
            untrained.setdefault(column.training_error, []).append(column.name)
    notes += [f"no renderings of {', '.join(names)}: {e}" for e, names in untrained.items()]
    if not report.pose_reference:
        notes.append("no reference poses or cloud: give --reference, or compare sift-exhaustive")
    return [*notes, *report.warnings]


def _html(
    report: CompareReport,
    tables: Mapping[str, Table],
    charts: Mapping[str, list[_Figure]],
    grids: Mapping[str, list[_Figure]],
) -> str:
    """The page, with charts and grids of pictures by the names that its template uses."""
    return render_page(
        "compare.html",
        video=report.video.name,
        facts=_facts(report),
        notes=_notes(report),
        tables=tables,
        charts=charts,
        grids=grids,
        is_upright=report.size[1] > report.size[0],
        versions=_versions(),
    )

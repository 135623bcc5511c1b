"""Tables of a comparison."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from colmap_av1.evaluate.report.results import BASELINES, Column, CompareReport
from colmap_av1.evaluate.training.splatting import Milestone, quality_after, share_of_time

_QUALITIES = {"psnr_y": ".2f", "ssim_db": ".2f", "vmaf": ".1f"}
_NONE = "-"
_LENGTH_CLASSES = (2, 3, 5, 9, 17, 33)


@dataclass(frozen=True)
class Table:
    """A table with a title and an explanation."""

    title: str
    about: str
    header: list[str]
    rows: list[list[str]]


def models_table(report: CompareReport) -> Table:
    """Points, errors, poses and clouds of each model."""
    base = next((c.model for c in report.columns if c.name == BASELINES[0]), None)
    header = ["front-end", "images", "points"]
    header += ["x SIFT exhaustive"] * (base is not None)
    header += ["coverage", "track length", "error px, mean / median"]
    header += ["ATE", "relative pose error"] * bool(report.pose_reference)
    header += ["Chamfer", "Hausdorff (95 %)"] * bool(report.cloud_reference)
    rows = []
    for column in report.columns:
        model = column.model
        if model is None:
            rows.append([column.name, *[_NONE] * (len(header) - 1)])
            continue
        row = [column.name, f"{model.num_registered} of {report.num_images}"]
        row.append(f"{model.num_points:,}")
        if base is not None:
            row.append(f"{model.num_points / base.num_points:.1f}" if base.num_points else _NONE)
        row.append(f"{model.coverage:.1%}")
        row.append(f"{model.mean_track_length:.2f}")
        row.append(f"{_number(model.mean_error)} / {_number(model.median_error)}")
        if report.pose_reference:
            row += _pose_cells(column, report)
        if report.cloud_reference:
            row += _cloud_cells(column, report)
        rows.append(row)
    return Table("Clouds and poses", _about_models(report), header, rows)


def _about_models(report: CompareReport) -> str:
    words = (
        "Coverage: share of the images' cells of 16x16 pixels that visible points project into. "
    )
    words += "Error: reprojection error of the points, as COLMAP reports it."
    if report.pose_reference:
        whose = _whose(report.pose_reference, report.is_truth)
        words += (
            f" Poses are compared with {whose}: ATE is the RMS distance of the camera centres "
            "after similarity alignment, as a share of the path's extent; the relative pose error "
            "is the RMS error of the motion between consecutive images, with translation as a "
            "share of the extent, and rotation."
        )
        if report.is_truth:
            words += " The first value of ATE is in the unit of the ground truth."
    if report.cloud_reference:
        whose = _whose(
            report.cloud_reference,
            report.is_truth and report.cloud_reference == report.pose_reference,
        )
        words += (
            f" Distances to the cloud of {whose}, as a share of the extent of its middle 90 %: "
            "Chamfer is the mean distance to the nearest point, averaged over both directions; "
            "Hausdorff is the larger of the two 95th percentiles, with the largest distance in "
            "parentheses. A cloud denser than the reference also has points where the reference "
            "has none, which increases its distances."
        )
    return words


def _whose(source: str, is_truth: bool) -> str:
    return f"the ground truth ({Path(source).name})" if is_truth else f"{source} as pseudo truth"


def _pose_cells(column: Column, report: CompareReport) -> list[str]:
    poses = column.poses
    if poses is None:
        return ["reference" if column.name == report.pose_reference else _NONE, _NONE]
    ate = f"{poses.ate / poses.extent:.3%}"
    if report.is_truth:
        ate = f"{poses.ate:.4f}, {ate}"
    relative = f"{poses.relative_translation / poses.extent:.3%}, {poses.relative_rotation:.3f}°"
    return [ate, relative]


def _cloud_cells(column: Column, report: CompareReport) -> list[str]:
    cloud = column.cloud
    if cloud is None:
        return ["reference" if column.name == report.cloud_reference else _NONE, _NONE]
    share = [value / cloud.extent for value in (cloud.chamfer, cloud.robust_hausdorff)]
    return [f"{share[0]:.2%}", f"{share[1]:.1%} ({cloud.hausdorff / cloud.extent:.1f}x)"]


def published_table(report: CompareReport) -> Table:
    """The figures of the published comparison, in the unit of the reference."""
    header = ["front-end", "images", "points", "error px", "Chamfer", "Hausdorff"]
    header += ["ATE, median", "ATE, RMS"]
    rows = []
    for column in report.columns:
        model, cloud, poses = column.model, column.cloud, column.poses
        row = [column.name, *[_NONE] * (len(header) - 1)]
        if model is not None:
            row[1:4] = [
                f"{model.num_registered}",
                f"{model.num_points:,}",
                _number(model.mean_error),
            ]
        if cloud is not None:
            row[4:6] = [_number(cloud.chamfer), _number(cloud.mean_hausdorff)]
        if poses is not None:
            row[6:] = [_number(poses.robust_median), _number(poses.robust_rms)]
        rows.append(row)
    about = (
        "Computed as in arXiv 2605.14629, in the unit of the reference. Hausdorff: mean of the "
        "largest distances of both directions. ATE: distances of the camera centres after "
        "similarity alignment by RANSAC with a threshold of 1."
    )
    return Table("Figures of the published comparison", about, header, rows)


def cost_table(columns: Sequence[Column]) -> Table:
    """CPU time, wall time and memory of each front-end."""
    stages = ("conversion", "matching", "mapping", "all tracks")
    header = ["front-end", *(f"{stage}, CPU s" for stage in (*stages, "total"))]
    header += ["peak memory", "wall time of each stage, s"]
    rows = []
    for column in columns:
        cpu = column.cpu_seconds
        row = [column.name]
        row += [f"{cpu[stage]:.1f}" if stage in cpu else _NONE for stage in stages]
        row.append(f"{sum(cpu.values()):.1f}" if cpu else _NONE)
        memory = column.peak_memory
        row.append(f"{memory / 2**20:,.0f} MB" if memory is not None else _NONE)
        row.append(", ".join(f"{k} {v:.1f}" for k, v in column.seconds.items()) or _NONE)
        rows.append(row)
    about = (
        "Motion needs a conversion to AV1 if the video has another codec; its cost is unknown if "
        "another run kept the stream. Every other stage ran in "
        "a separate process; matching includes reading or extraction, matching and "
        "verification. If the machine was running other work at the same time, compare CPU "
        "times, not wall times."
    )
    return Table("Time and memory", about, header, rows)


def lengths_table(columns: Sequence[Column]) -> Table:
    """Track lengths: the number of images that observe a point."""
    bounds = [*_LENGTH_CLASSES, math.inf]
    spans = list(itertools.pairwise(bounds))
    header = ["points observed by"]
    for low, high in spans:
        one = high == low + 1
        header.append(f"{low}" if one else f"{low}+" if high == math.inf else f"{low}-{high - 1}")
    header[-1] += " images"
    rows = []
    for column in columns:
        lengths = column.track_lengths
        counts = [sum(n for k, n in lengths.items() if low <= k < high) for low, high in spans]
        rows.append([column.name, *(f"{n:,}" if lengths else _NONE for n in counts)])
    return Table("Track lengths", "", header, rows)


def renderings_table(columns: Sequence[Column]) -> Table:
    """Renderings of trained Gaussians."""
    header = ["front-end", "PSNR-Y, dB", "SSIM, dB", "LPIPS", "VMAF", "Q", "difference of Q"]
    header += ["Gaussians", "training, s", "time to baseline PSNR-Y", "time to baseline VMAF"]
    baseline, base = _training_baseline(columns)
    rows = []
    words = ""
    for column in columns:
        training = column.training
        if training is None:
            rows.append([column.name, *[_NONE] * (len(header) - 1)])
            continue
        metrics = training.metrics
        row = [column.name, f"{metrics.psnr_y.mean():.2f}", f"{metrics.ssim_db.mean():.2f}"]
        row.append(f"{metrics.lpips.mean():.3f}" if metrics.lpips is not None else _NONE)
        row += [f"{metrics.vmaf.mean():.2f}", f"{metrics.sharpness.mean():.2f}"]
        row.append(f"{metrics.sharpness_difference.mean():.2f}")
        count = training.states[-1].num_gaussians if training.states else None
        row.append(f"{count:,}" if count is not None else _NONE)
        row.append(f"{training.seconds:.0f}")
        for quality in ("psnr_y", "vmaf"):
            share = share_of_time(training.states, base, quality) if base else None
            row.append(f"{share:.0%}" if share is not None else _NONE)
        rows.append(row)
        words = metrics.no_lpips or words
    about = (
        "Means over the test images, which are the odd ones; trained on the even ones. Q: Zhu and "
        "Milanfar's measure of sharpness, and its absolute difference to that of the photograph."
    )
    if base:
        about += (
            f" The baseline is {baseline}. Time to baseline: training time until the baseline's "
            "final PSNR-Y or VMAF is reached, as a share of the baseline's training time."
        )
    if words:
        about += f" LPIPS is not available: {words}."
    return Table("Renderings", about, header, rows)


def _training_baseline(columns: Sequence[Column]) -> tuple[str, Sequence[Milestone]]:
    """Name and milestones of the first baseline that was trained; empty without one."""
    trained = {column.name: column.training.states for column in columns if column.training}
    name = next((name for name in BASELINES if name in trained), "")
    return name, trained.get(name, ())


def milestones_table(columns: Sequence[Column]) -> Table | None:
    """Rendering quality after given iterations and training times; None without milestones."""
    trained = [(c.name, c.training.states) for c in columns if c.training and c.training.states]
    if not trained:
        return None
    stops = sorted({state.iteration for _, states in trained for state in states})
    baseline, base = _training_baseline(columns)
    times = [state.seconds for state in base if math.isfinite(state.seconds)]
    header = ["front-end", *(f"{stop:,} iterations" for stop in stops)]
    header += [f"{seconds:,.0f} s" for seconds in times]
    rows = []
    for name, states in trained:
        at = {state.iteration: state for state in states}
        row = [name, *(_qualities_cell(at.get(stop)) for stop in stops)]
        rows.append(row + [_qualities_cell_after(states, seconds) for seconds in times])
    about = "PSNR-Y in dB / SSIM in dB / VMAF, means over the test images."
    if times:
        about += (
            f" The training times are those of the milestones of {baseline}; values of other "
            "trainings are interpolated linearly between their milestones."
        )
    return Table("Renderings during training", about, header, rows)


def _qualities_cell(state: Milestone | None) -> str:
    if state is None:
        return _NONE
    return " / ".join(f"{state.mean(name):{spelling}}" for name, spelling in _QUALITIES.items())


def _qualities_cell_after(states: Sequence[Milestone], seconds: float) -> str:
    found = {name: quality_after(states, seconds, name) for name in _QUALITIES}
    if any(value is None for value in found.values()):
        return _NONE
    return " / ".join(f"{value:{_QUALITIES[name]}}" for name, value in found.items())


def _number(value: float) -> str:
    return f"{value:.3f}" if math.isfinite(value) else _NONE

"""Insert the tables of `results/*.csv` into the documents.

python examples/benchmarks/render.py
python examples/benchmarks/render.py --check

In a document, the text between `<!-- table NAME WORDS -->` and `<!-- end of table -->` is replaced
by a table. `--check` changes nothing, and fails if a document is not up to date.
"""

from __future__ import annotations

import argparse
import csv
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

BENCHMARKS = Path(__file__).resolve().parent
DOCUMENTS = tuple(BENCHMARKS.parents[1] / name for name in ("README.md", "docs/benchmarks.md"))
MARKED = re.compile(r"(<!-- table ([^\n]+) -->\n).*?(<!-- end of table -->\n)", re.DOTALL)
# Numbers of frames between two observations at which errors of tracks are measured.
SPANS = (1, 2, 4, 8, 16)
LENGTHS = ("2-3", "4-7", "8-15", "16-31", "32+")
REFERENCE = "sift-exhaustive"

# The ways to start training whose renderings are compared; the first is the baseline.
SPLAT_WAYS = (
    *("SIFT sequential", "match, map, densify", "reconstruct"),
    *("reconstruct, none added", "reconstruct --gaussians"),
)
_QUALITIES = ("psnr_y", "ssim_db", "vmaf")

Row = dict[str, str]


@dataclass(frozen=True)
class Column:
    """A column: its heading, and a function that returns its cell of a row."""

    heading: str
    cell: Callable[[Row], str]


def main() -> int:
    """Update the documents, or list those that are not up to date."""
    parser = argparse.ArgumentParser(description="Insert tables of results into the documents.")
    parser.add_argument("--check", action="store_true", help="fail instead of changing documents")
    check = parser.parse_args().check
    stale = [path for path in DOCUMENTS if rendered(path.read_text()) != path.read_text()]
    for path in stale:
        if check:
            print(
                f"{path}: not up to date: run python examples/benchmarks/render.py", file=sys.stderr
            )
        else:
            path.write_text(rendered(path.read_text()))
    return 1 if check and stale else 0


def rendered(document: str) -> str:
    """A document with its tables replaced by current ones."""

    def fill(found: re.Match[str]) -> str:
        name, *words = found[2].split()
        with (BENCHMARKS / "results" / f"{name.partition('.')[0]}.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
        return f"{found[1]}\n{TABLES[name](rows, *words)}\n{found[3]}"

    return MARKED.sub(fill, document)


def number(row: Row, name: str, spelling: str, unit: str = "") -> str:
    """A cell of a figure; "-" if it was not measured."""
    return f"{float(row[name]):{spelling}}{unit}" if row.get(name) else "-"


def figure(heading: str, name: str, spelling: str, unit: str = "") -> Column:
    """A column of one figure."""
    return Column(heading, lambda row: number(row, name, spelling, unit))


def words(heading: str, *names: str) -> Column:
    """A column of one or several words."""
    return Column(heading, lambda row: ", ".join(row[name] for name in names if row[name]))


def as_written(name: str) -> Column:
    """A column with the heading of the file; large integers get separators."""

    def cell(row: Row) -> str:
        value = row[name]
        return f"{int(value):,}" if value.isdigit() else value or "-"

    return Column(name.replace("_", " "), cell)


def share_of(row: Row, name: str, base: Row | None, spelling: str) -> str:
    """A figure's ratio to that of another row, after a comma; empty if either is missing."""
    if not row.get(name) or base is None or not base.get(name):
        return ""
    return f", {float(row[name]) / float(base[name]):{spelling}}"


def markdown(columns: Sequence[Column], rows: Iterable[Row], left: int = 1) -> str:
    """A Markdown table; columns after the first `left` are aligned to the right."""
    lines = [[column.heading for column in columns]]
    lines.append(["---"] * left + ["---:"] * (len(columns) - left))
    lines += [[column.cell(row) for column in columns] for row in rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def measured_at(rows: Sequence[Row], name: str = "", way: str = "") -> str:
    """A line with the commit and machine of the rows, by the rows' names if they differ.

    Args:
        rows: the rows.
        name: column of the rows' names.
        way: another column that is shown where rows of one name differ in their commit.
    """
    places: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        places.setdefault((row["commit"], row["machine"]), []).append(row)
    if len(places) == 1:
        ((commit, machine),) = places
        return f"Commit {commit}; {machine}.\n"

    def unique(some: Iterable[Row], column: str) -> list[str]:
        return list(dict.fromkeys(row.get(column, "") for row in some))

    def label(own: Sequence[Row]) -> str:
        names = unique(own, name)
        others = unique((row for some in places.values() if some is not own for row in some), name)
        if not own[0].get(way) or set(names).isdisjoint(others):
            return ", ".join(names)
        ways = ", ".join(unique(own, way))
        return ways if set(names) >= set(others) else f"{', '.join(names)} by {ways}"

    spelled = (f"{label(own)}: commit {c}; {m}" for (c, m), own in places.items())
    return ". ".join(spelled) + ".\n"


def tracks(rows: list[Row], sequence: str) -> str:
    """Tracks of the front-ends on a sequence, and the models mapped from them."""
    rows = [row for row in rows if row["sequence"] == sequence]
    first = rows[0]
    about = (
        f"{first['num_images']} images of {first['num_frames']} frames; intrinsics "
        f"{first['intrinsics']}; {first['measured_against']}."
    )
    tables = [about, "", markdown(track_columns(rows), rows)]
    if any(row.get("registered") for row in rows):
        tables.append(markdown(model_columns(rows), rows))
    return "\n".join([*tables, measured_at(rows, "frontend")])


def by_span(row: Row, name: str) -> str:
    """Errors in pixels at all spans, in one cell."""
    cells = [number(row, f"{name}_{span}", ".2f") for span in SPANS]
    return "-" if set(cells) == {"-"} else " / ".join(cells)


def track_columns(rows: Sequence[Row]) -> list[Column]:
    """The columns that describe tracks."""
    spans = " / ".join(map(str, SPANS))
    columns = [
        words("tracks", "frontend"),
        figure("tracks", "tracks", ",.0f"),
        *(figure(f"length {length}", f"tracks_{length}", ",.0f") for length in LENGTHS),
        figure("keypoints per image", "keypoints_per_image", ",.0f"),
        Column(
            "coverage (minimum)",
            lambda row: f"{number(row, 'covered', '.0%')} ({number(row, 'least_covered', '.0%')})",
        ),
        Column(f"epipolar px at {spans} frames", lambda row: by_span(row, "epipolar_px")),
    ]
    if any(row.get("exact_px_1") for row in rows):
        heading = f"exact px at {spans} frames: median"
        columns.append(Column(heading, lambda row: by_span(row, "exact_px")))
        columns.append(Column("90 %", lambda row: by_span(row, "exact_px_of_90")))
    return columns


def model_columns(rows: Sequence[Row]) -> list[Column]:
    """The columns that describe models and their cost, compared with those of the reference."""
    base = next((row for row in rows if row["frontend"] == REFERENCE), None)

    def took(row: Row, name: str) -> str:
        seconds = number(row, f"{name}_cpu_s", ".1f")
        return seconds if seconds == "-" else f"{seconds} ({number(row, f'{name}_s', '.1f')})"

    def ate(row: Row) -> str:
        if not row.get("ate"):
            return "-"
        return f"{number(row, 'ate', '.4f')} ({number(row, 'ate_of_extent', '.2%')})"

    def error(row: Row, name: str) -> str:
        mean = number(row, f"{name}_mean", ".3f")
        return mean if mean == "-" else f"{mean} / {number(row, f'{name}_median', '.3f')}"

    def points(row: Row, name: str) -> str:
        base_points = None if base is None else {name: base["points"]}
        times = share_of(row, name, base_points, ".1f")
        return number(row, name, ",.0f") + (f"{times}x" if times else "")

    def images(row: Row) -> str:
        known = row.get("registered", "") not in ("", "0")
        return f"{row['registered']} of {row['num_images']}" if known else "no model"

    return [
        words("models", "frontend"),
        Column("images", images),
        Column("ATE (share of extent)", ate),
        figure("rotation", "rotation_deg", ".3f", "°"),
        Column("error px mean / median", lambda row: error(row, "error_px")),
        Column("points", lambda row: points(row, "points")),
        Column("all tracks: points", lambda row: points(row, "all_tracks_points")),
        Column("their error px", lambda row: error(row, "all_tracks_error_px")),
        Column(
            "front-end CPU s (wall)",
            lambda row: took(row, "frontend") + share_of(row, "frontend_cpu_s", base, ".1%"),
        ),
        figure("memory", "peak_memory_mb", ".0f", " MB"),
        Column("mapper CPU s (wall)", lambda row: took(row, "mapper")),
        Column("all tracks CPU s (wall)", lambda row: took(row, "all_tracks")),
    ]


def dense_points(rows: list[Row]) -> str:
    """Points of dense models and the errors of their depths."""

    def points(row: Row) -> str:
        base = {"points": row["points_of_model"]}
        times = share_of(row, "points", base, ".1f")
        return number(row, "points", ",.0f") + (f"{times}x" if times else "")

    columns = [
        words("sequence, tracks", "sequence", "tracks"),
        Column("points", points),
        figure("observations per point", "observations_per_point", ".1f"),
        figure("error px", "error_px", ".3f"),
        figure("depth error, median", "depth_error", ".2%"),
        figure("> 5 %", "above_5_percent", ".1%"),
        figure("> 10 %", "above_10_percent", ".1%"),
        figure("checked", "checked", ",.0f"),
        figure("CPU s", "cpu_s", ".1f"),
    ]
    return f"{markdown(columns, rows)}\n{measured_at(rows, 'sequence')}"


# Largest error of camera centres, in per cent of their extent, of a model that is not bent.
STRAIGHT = 0.5


# Ways of `phone_to_folder.py`: from the file, from the AV1 stream, and SIFT for comparison.
FROM_FILE, FROM_STREAM, SIFT_FROM_FILE = "reconstruct", "reconstruct from AV1", "SIFT sequential"
MATCH_PYCOLMAP, MATCH_COLMAP = "match, pycolmap", "match, COLMAP"
# With COLMAP's settings for videos.
MATCH_MAP, SIFT_MAP = "match, map", "SIFT, map"


def phone_to_folder(rows: list[Row]) -> str:
    """Cost and models of all ways; the cost of SIFT excludes mapping if it was not mapped."""
    by_way = {(row["clip"], row["way"]): row for row in rows}
    ways = {
        SIFT_FROM_FILE: "SIFT, pycolmap",
        SIFT_MAP: "SIFT, `map`",
        MATCH_MAP: "`match`, `map`",
        MATCH_PYCOLMAP: "`match`, pycolmap",
        MATCH_COLMAP: "`match`, COLMAP 3.8",
        FROM_FILE: "`reconstruct`",
    }

    def is_matched_only(row: Row) -> bool:
        return row["way"] == SIFT_FROM_FILE and not row["registered"]

    def way(row: Row) -> str:
        return "SIFT, not mapped" if is_matched_only(row) else ways[row["way"]]

    def compared(row: Row, sift: Row, name: str, spelling: str) -> str:
        times = f"{float(sift[name]) / float(row[name]):.1f}x less"
        return f"{number(row, name, spelling)}, {'over ' * is_matched_only(sift)}{times}"

    def less(heading: str, name: str, spelling: str) -> Column:
        def cell(row: Row) -> str:
            sift = by_way.get((row["clip"], SIFT_FROM_FILE))
            if row["way"] == SIFT_FROM_FILE or sift is None or not row.get(name):
                return number(row, name, spelling)
            return compared(row, sift, name, spelling)

        return Column(heading, cell)

    def is_first(row: Row) -> bool:
        return row["way"] == SIFT_FROM_FILE or (row["clip"], SIFT_FROM_FILE) not in by_way

    def from_stream(row: Row) -> str:
        sift, ours = (by_way.get((row["clip"], way)) for way in (SIFT_FROM_FILE, FROM_STREAM))
        if row["way"] != FROM_FILE or sift is None or ours is None:
            return ""
        return compared(ours, sift, "cpu_s", ".0f")

    def long_range(row: Row) -> str:
        return f"{number(row, 'long_range', '.2f')} / {number(row, 'long_range_90', '.2f')}"

    columns = [
        Column("clip", lambda row: f"`{row['clip']}`" if is_first(row) else ""),
        Column("model", way),
        Column("images", lambda row: f"{row['registered'] or '-'} of {row['images'] or '-'}"),
        figure("points", "points", ",.0f"),
        figure("reprojection error", "error_px", ".3f", " px"),
        figure("error of camera centres", "ate_of_extent", ".2%"),
        Column("long-range epipolar px", long_range),
        less("seconds", "seconds", ".0f"),
        less("CPU seconds", "cpu_s", ".0f"),
        Column("from AV1", from_stream),
        figure("memory", "memory_mb", ",.0f", " MB"),
    ]
    shown = sorted(
        (row for row in rows if row["way"] in ways),
        key=lambda row: (
            [r["clip"] for r in rows].index(row["clip"]),
            list(ways).index(row["way"]),
        ),
    )
    return f"{markdown(columns, shown, left=2)}\n{measured_at(shown, 'clip', 'way')}"


def summary(rows: list[Row], *clips: str) -> str:
    """A row for each clip with the figures of SIFT, `match` and `reconstruct`.

    Errors of camera centres are relative to true poses.
    """
    whole = {(row["clip"], row["way"]): row for row in rows}

    def each(heading: str, name: str, spelling: str) -> Column:
        def cell(line: Row) -> str:
            figures = [
                number(whole[line["clip"], way], name, spelling)
                for way in (SIFT_FROM_FILE, MATCH_MAP, FROM_FILE)
            ]
            return " / ".join(figures) if whole[line["clip"], FROM_FILE][name] else "-"

        return Column(heading, cell)

    columns = [
        Column(
            "clip",
            lambda row: f"`{row['clip']}`, {whole[row['clip'], FROM_FILE]['images']} images",
        ),
        each("CPU time in s", "cpu_s", ".0f"),
        each("3D points", "points", ",.0f"),
        each("camera position error", "ate_of_extent", ".2%"),
    ]
    return markdown(columns, [{"clip": clip} for clip in clips])


def phone_to_folder_steps(rows: list[Row]) -> str:
    """CPU seconds of every step."""
    clips = list(dict.fromkeys(row["clip"] for row in rows))
    by_way = {(row["clip"], row["way"]): row for row in rows}

    def of_step(way: str) -> Callable[[Row], str]:
        return lambda row: number(by_way.get((row["clip"], way), {}), "cpu_s", ".1f")

    ways = dict.fromkeys(row["way"] for row in rows)
    steps = [way for way in ways if way not in _WHOLE and not way.startswith(STAGE)]
    columns = [words("clip", "clip"), *(Column(step, of_step(step)) for step in steps)]
    whole = [row for row in rows if not row["way"].startswith(STAGE)]
    table = markdown(columns, [{"clip": clip} for clip in clips])
    return f"{table}\n{measured_at(whole, 'clip', 'way')}"


_WHOLE = (FROM_FILE, SIFT_FROM_FILE, SIFT_MAP, MATCH_MAP, MATCH_PYCOLMAP, MATCH_COLMAP)
# Prefix of ways that are stages of `reconstruct`.
STAGE = "stage: "
_NOTABLE = 0.05  # Smallest CPU time in seconds of a stage in the table.


def phone_to_folder_stages(rows: list[Row]) -> str:
    """CPU seconds of every stage of `reconstruct` that takes a notable time."""
    staged = [row for row in rows if row["way"].startswith(STAGE)]
    clips = list(dict.fromkeys(row["clip"] for row in staged))
    by_way = {(row["clip"], row["way"]): row for row in rows}

    def of_clip(clip: str) -> Callable[[Row], str]:
        return lambda row: number(by_way.get((clip, row["way"]), {}), "cpu_s", ".1f")

    ways = dict.fromkeys(row["way"] for row in staged if float(row["cpu_s"]) >= _NOTABLE)
    columns = [
        Column("stage", lambda row: row["way"].removeprefix(STAGE)),
        *(Column(clip, of_clip(clip)) for clip in clips),
    ]
    shown = [{"way": way} for way in (*ways, FROM_STREAM)]
    return f"{markdown(columns, shown)}\n{measured_at(staged, 'clip', 'way')}"


def jerks(rows: list[Row]) -> str:
    """Models of clips whose camera jerks, by sequence and way."""
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in sorted(rows, key=lambda row: (row["sequence"], row["way"])):
        groups.setdefault((row["sequence"], row["way"]), []).append(row)

    def errors(own: list[Row]) -> list[float]:
        return sorted(float(row["ate"]) for row in own if row["ate"])

    def warned(row: Row) -> bool:
        return bool(row["warnings"])

    def straight(row: Row) -> bool:
        return bool(row["ate"]) and float(row["ate"]) <= STRAIGHT

    def whole(row: Row) -> bool:
        return row["registered"] == row["images"]

    def count(heading: str, test: Callable[[Row], bool]) -> Column:
        return Column(heading, lambda row: str(sum(map(test, groups[key_of(row)]))))

    def key_of(row: Row) -> tuple[str, str]:
        return row["sequence"], row["way"]

    def error(heading: str, place: float) -> Column:
        def cell(row: Row) -> str:
            found = errors(groups[key_of(row)])
            return f"{found[int(place * (len(found) - 1))]:.2f} %" if found else ""

        return Column(heading, cell)

    columns = [
        words("sequence, way", "sequence", "way"),
        count("clips", lambda _: True),
        count("whole and straight", lambda row: whole(row) and straight(row)),
        count("of these, warned", lambda row: whole(row) and straight(row) and warned(row)),
        count("parts straight, warned", lambda row: not whole(row) and straight(row)),
        count("bent or none, warned", lambda row: not straight(row) and warned(row)),
        count("bent, not warned", lambda row: not straight(row) and not warned(row)),
        error("median error of centres", 0.5),
        error("largest", 1.0),
    ]
    firsts = [own[0] for own in groups.values()]
    return f"{markdown(columns, firsts)}\n{measured_at(rows, 'way')}"


def read_motion(rows: list[Row], threads: str) -> str:
    """Times of reading motion and of decoding: CPU time of one thread, wall time of more."""
    rows = [row for row in rows if row["threads"] == threads]
    gain = [figure("gain", "gain", ".2f")] if threads != "1" else []
    parse = [figure("parse", "parse_ms", ".3f")] if threads == "1" else []

    def ratio(row: Row) -> str:
        return f"{float(row['dav1d_ms']) / float(row['read_motion_ms']):.2f}"

    columns = [
        words("clip", "clip"),
        figure("Mbit", "megabits", ".1f"),
        figure("read_motion", "read_motion_ms", ".3f"),
        figure("dav1d", "dav1d_ms", ".3f"),
        Column("ratio", ratio),
        *gain,
        *parse,
    ]
    return f"{markdown(columns, rows)}\n{measured_at(rows, 'clip', 'way')}"


def dav1d_profile(rows: list[Row]) -> str:
    """Shares of dav1d's time in per cent, and what a reader that only parses could gain."""
    parts = ("symbols", "coefficients", "modes", "prediction", "pictures")
    columns = [
        words("clip", "clip"),
        *(figure(part, part, ".1f") for part in parts),
        Column("at most", lambda row: f"{100 / (100 - float(row['pictures'])):.2f}"),
    ]
    return f"{markdown(columns, rows)}\n{measured_at(rows, 'clip', 'way')}"


def verification(rows: list[Row]) -> str:
    """Verification of pairs, compared with COLMAP's."""

    def ratio(row: Row) -> str:
        return f"{float(row['colmap_cpu_s']) / float(row['cpu_s']):.1f}x"

    columns = [
        words("clip", "clip"),
        figure("pairs", "pairs", ".0f"),
        figure("matches", "matches", ",.0f"),
        figure("ours, CPU s", "cpu_s", ".2f"),
        figure("COLMAP, CPU s", "colmap_cpu_s", ".2f"),
        Column("ratio", ratio),
        figure("same config", "same_config", ".1%"),
        figure("inliers", "inliers", ".1%"),
        figure(">= 0.98", "inliers_of_98", ".1%"),
        figure("COLMAP with itself: config", "colmap_same_config", ".1%"),
        figure("inliers", "colmap_inliers", ".1%"),
        figure(">= 0.98", "colmap_inliers_of_98", ".1%"),
    ]
    return f"{markdown(columns, rows)}\n{measured_at(rows, 'clip', 'way')}"


def encoders(rows: list[Row]) -> str:
    """Cost of conversions, and the models made from the streams."""

    def pair(heading: str, first: str, second: str, spelling: str) -> Column:
        def cell(row: Row) -> str:
            return f"{number(row, first, spelling)} / {number(row, second, spelling)}"

        return Column(heading, cell)

    columns = [
        words("clip", "clip"),
        Column("encoder, speed", lambda row: f"{row['encoder']} {row['speed']}"),
        words("quality", "quality"),
        figure("CPU s", "cpu_per_megapixel", ".2f"),
        figure("kB per frame", "kb_per_frame", ".1f"),
        figure("tracks", "tracks_of_4", ",.0f"),
        pair("epipolar px at 1 / 8 frames", "epipolar_1", "epipolar_8", ".2f"),
        Column("registered", lambda row: f"{row['registered']} of {row['images']}"),
        figure("points", "points", ",.0f"),
        figure("error px", "error", ".3f"),
        figure("ATE", "ate", ".4f"),
        pair("long-range epipolar px", "long_range", "long_range_90", ".2f"),
    ]
    return f"{markdown(columns, rows)}\n{measured_at(rows, 'clip', 'way')}"


def rolling_shutter(rows: list[Row]) -> str:
    """Models of clips with a rolling shutter, with and without the estimated read-out time."""

    def both(heading: str, name: str, spelling: str) -> Column:
        def cell(row: Row) -> str:
            pair = (number(row, f"{name}_{how}", spelling) for how in ("none", "estimate"))
            return " / ".join(pair)

        return Column(heading, cell)

    columns = [
        words("clip", "clip"),
        figure("read-out", "read_out_ms", ".0f", " ms"),
        Column(
            "found",
            lambda row: number(row, "found_ms", ".1f", " ms") if row["found_ms"] else "none",
        ),
        both("reprojection error, px", "error_px", ".3f"),
        both("camera centres, mm", "ate_mm", ".1f"),
        both("CPU seconds", "cpu_s", ".1f"),
    ]
    return f"{markdown(columns, rows)}\n{measured_at(rows, 'clip', 'way')}"


def movers(rows: list[Row]) -> str:
    """Models of a scene that people walk through: means over encodings, and the range of ATE."""
    of_cases: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        of_cases.setdefault((row["people"], row["moving"]), []).append(row)
    cases = list(of_cases.values())
    without = min(mean(own, "ate_mm") for own in cases if own[0]["people"] == "0%")

    def average(name: str, spelling: str, unit: str = "") -> list[str]:
        return [f"{mean(own, name):{spelling}}{unit}" if own[0].get(name) else "-" for own in cases]

    def spread(own: list[Row]) -> str:
        ate = [float(row["ate_mm"]) for row in own]
        return f"{min(ate):.2f} to {max(ate):.2f} mm"

    cells = {
        "people cover": [own[0]["people"] for own in cases],
        "`--moving`": [own[0]["moving"] for own in cases],
        "encodings": [str(len(own)) for own in cases],
        "images": average("registered", ".0f"),
        "ATE": average("ate_mm", ".2f", " mm"),
        "ATE / ATE without people": [f"{mean(own, 'ate_mm') / without:.2f}" for own in cases],
        "ATE from, to": [spread(own) for own in cases],
        "points": average("points", ",.0f"),
        "points on people": average("points_on_people", ".2%"),
        "at most": [f"{max(float(row['points_on_people']) for row in own):.2%}" for own in cases],
        "IoU of masks": average("iou", ".2f"),
        "people masked": average("covered", ".1%"),
        "static masked": average("static_lost", ".1%"),
        "CPU s": average("cpu_s", ".1f"),
    }
    made = [dict(zip(cells, row, strict=True)) for row in zip(*cells.values(), strict=True)]
    return (
        f"{markdown([words(heading, heading) for heading in cells], made, left=2)}\n"
        f"{measured_at(rows, 'people')}"
    )


def mean(rows: list[Row], name: str) -> float:
    """The mean of a figure."""
    return sum(float(row[name]) for row in rows) / len(rows)


def loops(rows: list[Row]) -> str:
    """Models of a clip with loops, and of a clip that repeats itself without loops."""
    columns = [
        words("clip, way", "clip", "way"),
        words("images", "images"),
        words("registered", "registered"),
        figure("ATE", "ate", ".4f", " m"),
        figure("of the path", "ate_of_path", ".4f", " %"),
        words("verified pairs", "pairs"),
        words("false", "false"),
        words("far apart in time", "far_pairs"),
        words("false", "far_false"),
        figure("CPU s", "cpu_s", ".0f"),
    ]
    return f"{markdown(columns, rows)}\n{measured_at(rows, 'clip', 'way')}"


def walks(rows: list[Row]) -> str:
    """Models of walks with fast turns."""
    columns = [
        words("walk", "walk"),
        words("way", "way"),
        words("images", "images"),
        words("registered", "registered"),
        words("camera centres", "errors"),
    ]
    return f"{markdown(columns, rows)}\n{measured_at(rows, 'walk', 'way')}"


def altered(rows: list[Row]) -> str:
    """Models of altered clips, see `altered.py`."""
    columns = [
        Column("clip", lambda row: f"`{row['clip']}`"),
        words("alteration", "alteration"),
        words("way", "way"),
        Column("images", lambda row: f"{row['registered'] or 0} of {row['images'] or '-'}"),
        figure("points", "points", ",.0f"),
        figure("reprojection error", "error_px", ".3f", " px"),
        figure("error of camera centres", "ate_of_extent", ".2%"),
        figure("CPU s", "cpu_s", ".1f"),
    ]
    return f"{markdown(columns, rows, left=3)}\n{measured_at(rows, 'clip', 'alteration')}"


def one_model(rows: list[Row]) -> str:
    """Models of cut, several, fast and long videos."""

    def links_share(row: Row) -> str:
        return f"{float(row['links_cpu_s']) / float(row['cpu_s']):.0%}"

    def long_range(row: Row) -> str:
        return f"{float(row['long_range']):.2f} / {float(row['long_range_90']):.2f}"

    columns = [
        words("case", "case"),
        words("images", "images"),
        words("registered", "registered"),
        figure("distance to SIFT's centres / extent", "centres_off", ".2%"),
        Column("long-range epipolar px", long_range),
        words("revisits", "revisits"),
        words("links between videos", "between"),
        figure("CPU s", "cpu_s", ".0f"),
        Column("links", links_share),
    ]
    return f"{markdown(columns, rows)}\n{measured_at(rows, 'case')}"


def splats(rows: list[Row]) -> str:
    """Renderings of Gaussians trained in all ways, means over the seeds.

    A share is the CPU time until the final quality of SIFT's training is reached, interpolated
    linearly between milestones, divided by the CPU time of that training.
    """
    lines: list[Row] = []
    for clip in dict.fromkeys(row["clip"] for row in rows):
        curves = {
            way: _curves([r for r in rows if (r["clip"], r["way"]) == (clip, way)])
            for way in SPLAT_WAYS
        }
        for way, own in curves.items():
            if not own:
                continue
            line: Row = {"clip": clip, "way": way, "commit": own[-1]["commit"]}
            line |= {name: own[-1][name] for name in ("gaussians", *_QUALITIES, "machine")}
            line["points"] = own[0]["gaussians"]
            for name in ("psnr_y", "vmaf"):
                line[f"{name}_share"] = _share_of_time(own, curves[SPLAT_WAYS[0]], name)
            lines.append(line)
    columns = [
        words("clip, way", "clip", "way"),
        figure("points", "points", ",.0f"),
        figure("PSNR-Y", "psnr_y", ".2f", " dB"),
        figure("SSIM", "ssim_db", ".2f", " dB"),
        figure("VMAF", "vmaf", ".1f"),
        words("SIFT's PSNR-Y after", "psnr_y_share"),
        words("SIFT's VMAF after", "vmaf_share"),
    ]
    return f"{markdown(columns, lines)}\n{measured_at(rows, 'clip', 'way')}"


def _curves(rows: list[Row]) -> list[Row]:
    """Means over the seeds at each number of iterations, in order."""
    counts = sorted({int(row["iterations"]) for row in rows})
    means: list[Row] = []
    for count in counts:
        own = [row for row in rows if int(row["iterations"]) == count]
        names = ("cpu_s", "gaussians", *_QUALITIES)
        means.append(own[0] | {name: str(mean(own, name)) for name in names})
    return means


def _share_of_time(own: list[Row], base: list[Row], name: str) -> str:
    """CPU time until the final quality of `base` is reached, as a share of its CPU time."""
    if not base or own[0]["way"] == base[0]["way"]:
        return "-"
    aim, spent = float(base[-1][name]), float(base[-1]["cpu_s"])
    reached = [float(row[name]) for row in own]
    first = next((i for i, value in enumerate(reached) if value >= aim), None)
    if first is None:
        return "never"
    at = float(own[first]["cpu_s"])
    if first > 0:
        before = float(own[first - 1]["cpu_s"])
        rise = reached[first] - reached[first - 1]
        at -= (at - before) * (reached[first] - aim) / rise
    return f"{at / spent:.2f}"


def plain(rows: list[Row]) -> str:
    """A table with the columns of the file, under their names there."""
    names = [name for name in rows[0] if name not in ("commit", "machine")]
    columns = [as_written(name) for name in names]
    return f"{markdown(columns, rows)}\n{measured_at(rows, names[0])}"


TABLES: dict[str, Callable[..., str]] = {
    "tracks": tracks,
    "dense_points": dense_points,
    "phone_to_folder": phone_to_folder,
    "phone_to_folder.summary": summary,
    "phone_to_folder.steps": phone_to_folder_steps,
    "phone_to_folder.stages": phone_to_folder_stages,
    "altered": altered,
    "jerks": jerks,
    "loops": loops,
    "read_motion": read_motion,
    "dav1d_profile": dav1d_profile,
    "verification": verification,
    "encoders": encoders,
    "large_pictures": plain,
    "movers": movers,
    "read_memory": plain,
    "rolling_shutter": rolling_shutter,
    "splats": splats,
    "one_model": one_model,
    "walks": walks,
    "long_video": plain,
    "image_pairs": plain,
    "appended": plain,
    "camera_model": plain,
    "comparison": plain,
}


if __name__ == "__main__":
    sys.exit(main())

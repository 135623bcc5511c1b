"""The page of a batch: one file without references, with all failures and figures."""

from __future__ import annotations

import html.parser
import json
import re
from pathlib import Path

import pytest

from colmap_av1 import OptionError, write_page
from colmap_av1.batch.rows import Row, json_of
from colmap_av1.cli import main

JPEG = b"\xff\xd8\xff\xe0 a small picture"


class Cells(html.parser.HTMLParser):
    """The cells and sort keys of the tables of a page, and the addresses that it refers to."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tables: dict[str, list[list[str]]] = {}
        self.keys: list[list[str | None]] = []
        self.links: list[str] = []
        self._table = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        if tag == "table":
            self._table = given["id"] or ""
            self.tables[self._table] = []
        if tag == "tr":
            self.tables[self._table].append([])
            self.keys.append([])
        if tag in ("td", "th"):
            self.tables[self._table][-1].append("")
            self.keys[-1].append(given.get("data-key"))
        self.links += [given[n] or "" for n in ("src", "href") if n in given]

    def handle_endtag(self, tag: str) -> None:
        if tag == "table":
            self._table = ""

    def handle_data(self, data: str) -> None:
        if self._table and self.tables[self._table] and self.tables[self._table][-1]:
            self.tables[self._table][-1][-1] += data.strip()


def write_rows(out: Path, rows: list[Row], name: str = "batch.json", time: float = 0.0) -> None:
    out.mkdir(exist_ok=True)
    (out / name).write_bytes(json_of(rows, {"task": "reconstruct", "time": time}))


def test_page_shows_results_and_failures_of_all_shards(tmp_path: Path) -> None:
    done = [
        Row(
            f"v{i}",
            f"/in/v{i}.mp4",
            "done",
            seconds=i + 0.5,
            cpu_seconds=2.0 * i,
            video_seconds=60.0,
            points=1000 * i,
            coverage=i / 10,
        )
        for i in range(1, 6)
    ]
    damaged = Row("<b>&", "/in/b.mp4", "failed", "damaged", error="<script>alert(1)</script>")
    killed = Row("c", "/in/c.mp4", "failed", "killed", error="its process was ended by SIGKILL")
    out = tmp_path / "out"
    write_rows(out, [*done[:3], damaged], "batch-1-of-2.json")
    write_rows(out, [*done[3:], killed], "batch-2-of-2.json")
    (out / "v2").mkdir()
    (out / "v2" / "thumbnail.jpg").write_bytes(JPEG)
    assert main(["batch", "report", "--output", str(out), "--quiet"]) == 0
    text = " ".join((out / "report.html").read_text().split())
    page = Cells(text)
    assert "<script>alert" not in text
    assert [link.partition(",")[0] for link in page.links] == ["data:image/jpeg;base64"]
    assert not re.search(r"https?:|url\(|@import", text)
    assert "5 done, 2 failed" in text
    # 30 seconds of CPU time for 5 minutes are 1.67 hours for 1,000 minutes.
    assert "1.7 CPU hours" in text
    assert page.tables["failures"][1:] == [
        ["damaged", "1", "<script>alert(1)</script>"],
        ["killed", "1", "its process was ended by SIGKILL"],
    ]
    quantiles = {row[0]: row[1:-1] for row in page.tables["quantiles"][1:]}
    assert quantiles["points"][3] == "3,000"
    assert quantiles["coverage"][::3] == ["10.0%", "30.0%", "50.0%"]
    assert quantiles["seconds"][-1] == "5.50"
    heads, *rows = page.tables["videos"]
    assert [row[1] for row in rows] == ["<b>&", "c", "v1", "v2", "v3", "v4", "v5"]
    points = heads.index("points")
    assert [row[points] for row in rows] == ["", "", *(f"{i},000" for i in range(1, 6))]
    assert page.keys[-1][points] == "5000"


def test_video_in_several_tables_counts_once(tmp_path: Path) -> None:
    """One run was one of two shards, and the other run had all videos."""
    half = [Row("a", "/a", "done"), Row("b", "/b", "failed")]
    every = [Row(n, f"/{n}", "done") for n in "abc"]
    for time, num_failed in ((1.0, 0), (3.0, 1)):
        write_rows(tmp_path, half, "batch-1-of-2.json", time)
        write_rows(tmp_path, every, time=2.0)
        write_page(tmp_path)
        text = " ".join((tmp_path / "report.html").read_text().split())
        assert f"3 videos, {3 - num_failed} done, {num_failed} failed" in text


def test_page_of_many_videos_shows_failures_first(tmp_path: Path) -> None:
    rows = [Row(f"v{i:03}", f"/v{i}", "done", points=i) for i in range(300)]
    rows[250] = Row("v250", "/v250", "failed", "damaged", error="x")
    write_rows(tmp_path, rows)
    write_page(tmp_path, most_rows=10)
    page = Cells((tmp_path / "report.html").read_text())
    assert [row[1] for row in page.tables["videos"][1:]] == [
        "v250",
        *(f"v{i:03}" for i in range(9)),
    ]
    assert {row[0]: row[-2] for row in page.tables["quantiles"]}["points"] == "299"


@pytest.mark.parametrize("name", ["../secret", "{root}/secret", "a\0b", "a\ud800"])
def test_thumbnails_outside_the_output_are_not_shown(name: str, tmp_path: Path) -> None:
    out = tmp_path / "out"
    (tmp_path / "secret").mkdir()
    (tmp_path / "secret" / "thumbnail.jpg").write_bytes(JPEG)
    write_rows(out, [Row(name.format(root=tmp_path), "/x", "done", points=1)])
    write_page(out)
    assert "base64" not in (out / "report.html").read_text()


def row_text(field: str, value: object) -> str:
    """The JSON text of one row with a changed value."""
    facts = {**vars(Row("x", "/x", "done")), field: value}
    return json.dumps({"rows": [facts]})


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, r"batch\.json"),
        ('{"rows": [\n  {"name": "x"', "damaged"),
        ('{"rows": [\n  {"name": "x"}]\n}', "damaged"),
        (row_text("state", "<script>alert(1)</script>"), "damaged"),
        (row_text("seconds", "<script>"), "damaged"),
        (row_text("points", [1]), "damaged"),
        (row_text("points", 10**400), "damaged"),
        ("[]", "damaged"),
        ('{"rows": [\n  {"name": ' + "[" * 100_000, "damaged"),
    ],
)
def test_missing_or_damaged_tables_are_errors(
    content: str | None, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if content is not None:
        (tmp_path / "batch.json").write_text(content)
    with pytest.raises(OptionError, match=message):
        write_page(tmp_path)
    assert main(["batch", "report", "--output", str(tmp_path)]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert main(["batch", "report", "--output", str(tmp_path / "none")]) == 2
    assert "batch.json" in capsys.readouterr().err

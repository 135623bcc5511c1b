"""Documents and scripts only name existing options, and links and tables are valid."""

from __future__ import annotations

import argparse
import importlib.util
import re
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest
from conftest import PROJECT

from colmap_av1.cli.commands import COMMANDS
from colmap_av1.cli.options import underscored
from colmap_av1.cli.program import make_parser

GUIDE = sorted((PROJECT / "docs").glob("*.md"))
DOCUMENTS = [PROJECT / "README.md", *GUIDE, *sorted((PROJECT / "examples").rglob("*.md"))]
SCRIPTS = sorted((PROJECT / "examples").rglob("*.sh"))
PROGRAM = re.compile(r"(?:^|[\s`'(])(?:colmap-av1|python -m colmap_av1) ([a-z]+)([^`\n]*)")
# Scripts in examples/pipelines pass arguments after the video and the folder to `match`.
PIPELINE = re.compile(r"[\w/]*(?:pipelines/)?\w+\.sh([^`\n]*)")


def commands() -> dict[str, argparse.ArgumentParser]:
    """The parser of each command."""
    _, parsers = make_parser(list(COMMANDS))
    return dict(parsers)


def code_of(path: Path) -> str:
    """A script, or the code in a Markdown file, with one line per command."""
    text = path.read_text().replace("\\\n", " ")
    if path.suffix == ".sh":
        return text
    blocks = re.findall(r"^```\w*\n(.*?)^```", text, flags=re.DOTALL | re.MULTILINE)
    outside = re.sub(r"^```\w*\n.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    # Inline code may be broken over two lines.
    inline = [" ".join(piece.split()) for piece in re.findall(r"`([^`]+)`", outside)]
    return "\n".join([*blocks, *inline])


def named_options(rest: str) -> list[str]:
    """The options among the arguments of a command."""
    return [
        underscored(o) for o in re.findall(r"(?<!\S)--\w[\w.-]*", re.split(r"[#|&;>]", rest)[0])
    ]


def uses(path: Path) -> list[tuple[str, str]]:
    """Each option that a document gives to a command: (command, option)."""
    code = code_of(path)
    found = [(m[1], o) for m in PROGRAM.finditer(code) for o in named_options(m[2])]
    return found + [("match", o) for m in PIPELINE.finditer(code) for o in named_options(m[1])]


@pytest.mark.parametrize("path", [*DOCUMENTS, *SCRIPTS], ids=lambda p: str(p.relative_to(PROJECT)))
def test_options_in_documents_exist(path: Path) -> None:
    known = commands()
    unknown = [
        f"{command} {option}"
        for command, option in uses(path)
        if command not in known or option not in known[command]._option_string_actions
    ]
    assert unknown == []


def test_options_in_documents_are_found() -> None:
    """Otherwise the test of existing options would test nothing."""
    assert ("match", "--num_images") in uses(PROJECT / "README.md")
    assert ("match", "--on_existing") in uses(PROJECT / "docs" / "databases.md")
    assert ("match", "--every") in uses(PROJECT / "examples" / "pipelines" / "README.md")
    assert ("match", "--camera_model") in uses(PROJECT / "examples/pipelines/nerfstudio.sh")
    assert ("export", "--output") in uses(PROJECT / "examples" / "pipelines" / "hloc.sh")
    assert all(uses(script) for script in SCRIPTS)


def test_links_between_documents_are_valid() -> None:
    for path in DOCUMENTS:
        for target, anchor in re.findall(r"\]\(([\w./]*)(?:#([\w-]+))?\)", path.read_text()):
            file = path.parent / target if target else path
            assert file.exists(), f"{path}: {target}"
            if anchor:
                headings = re.findall(r"^#+ (.*)$", file.read_text(), flags=re.MULTILINE)
                slugs = [re.sub(r"[^\w -]", "", h.lower()).replace(" ", "-") for h in headings]
                assert anchor in slugs, f"{path}: {target}#{anchor}"


def test_guide_builds_without_warnings(tmp_path: Path) -> None:
    for package in ("mkdocs", "material", "mkdocstrings"):
        pytest.importorskip(package, reason="the guide needs pip install '.[docs]'")
    # `python -m mkdocs` would import the source folder here, which holds no compiled core.
    mkdocs = Path(sysconfig.get_path("scripts")) / "mkdocs"
    command = [mkdocs, "build", "--strict", "--site-dir", tmp_path]
    done = subprocess.run(command, cwd=PROJECT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "python" / "index.html").read_text()
    assert 'id="colmap_av1.tracks.tracks.Tracks"' in page


def test_tables_match_the_results() -> None:
    """The documents contain the tables that `render.py` makes from the CSV files."""
    script = PROJECT / "examples" / "benchmarks" / "render.py"
    command = [sys.executable, script, "--check"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_results_replace_those_of_the_same_clip(tmp_path: Path) -> None:
    source = PROJECT / "examples" / "benchmarks" / "results.py"
    spec = importlib.util.spec_from_file_location("benchmark_results", source)
    assert spec is not None
    assert spec.loader is not None
    results = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(results)
    file = tmp_path / "new" / "figures.csv"
    results.save(file, [{"clip": "a", "px": 1 / 3}, {"clip": "b", "px": None}], ["clip"])
    results.save(file, [{"clip": "b", "px": float("nan"), "pairs": 7}], ["clip"])
    rows = results.read_rows(file)
    assert [[*row.values()][:3] for row in rows] == [["a", "0.333333", ""], ["b", "", "7"]]
    assert all(row["commit"] and row["machine"].endswith(results.machine()) for row in rows)


def test_options_named_without_a_command_exist() -> None:
    """They are options of some command or of a script in examples."""
    known = {o for parser in commands().values() for o in parser._option_string_actions}
    scripts = [p.read_text() for p in (PROJECT / "examples").rglob("*.*") if p.suffix == ".py"]
    # The page about trainers names options of the trainers.
    for path in (p for p in DOCUMENTS if p.name != "trainers.md"):
        outside = re.sub(r"^```\w*\n.*?^```", "", path.read_text(), flags=re.DOTALL | re.MULTILINE)
        for piece in re.findall(r"`(--\w[^`]*)`", outside):
            for option in named_options(piece):
                of_script = any(f'"{option}"' in text for text in scripts)
                assert option in known or of_script, f"{path}: {option}"

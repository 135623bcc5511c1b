"""Documents and scripts name options that exist."""

from __future__ import annotations

import argparse
import re
from pathlib import Path

import pytest
from conftest import PROJECT

from colmap_av1.cli.options import underscored
from colmap_av1.cli.program import _make_parser

DOCUMENTS = [PROJECT / "README.md", *sorted((PROJECT / "examples").rglob("*.md"))]
SCRIPTS = sorted((PROJECT / "examples").rglob("*.sh"))
PROGRAM = re.compile(r"(?:^|[\s`'(])(?:colmap-av1|python -m colmap_av1) ([a-z]+)([^`\n]*)")
# Scripts of examples/pipelines hand what comes after the video and a folder to `match`.
PIPELINE = re.compile(r"[\w/]*(?:pipelines/)?\w+\.sh([^`\n]*)")


def commands() -> dict[str, argparse.ArgumentParser]:
    """The parser of each command."""
    _, parsers = _make_parser()
    return dict(parsers)


def code_of(path: Path) -> str:
    """A script, or the code of a Markdown file; a line for each command."""
    text = path.read_text().replace("\\\n", " ")
    if path.suffix == ".sh":
        return text
    blocks = re.findall(r"^```\w*\n(.*?)^```", text, flags=re.DOTALL | re.MULTILINE)
    outside = re.sub(r"^```\w*\n.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    # Code within a paragraph may be broken over two lines.
    inline = [" ".join(piece.split()) for piece in re.findall(r"`([^`]+)`", outside)]
    return "\n".join([*blocks, *inline])


def named_options(rest: str) -> list[str]:
    """The options among the words after a command, up to the end of it."""
    return [
        underscored(o) for o in re.findall(r"(?<!\S)--\w[\w.-]*", re.split(r"[#|&;>]", rest)[0])
    ]


def uses(path: Path) -> list[tuple[str, str]]:
    """Each option that a document gives to a command: (command, option)."""
    code = code_of(path)
    found = [(m[1], o) for m in PROGRAM.finditer(code) for o in named_options(m[2])]
    return found + [("match", o) for m in PIPELINE.finditer(code) for o in named_options(m[1])]


@pytest.mark.parametrize("path", [*DOCUMENTS, *SCRIPTS], ids=lambda p: str(p.relative_to(PROJECT)))
def test_options_exist(path: Path) -> None:
    known = commands()
    unknown = [
        f"{command} {option}"
        for command, option in uses(path)
        if command not in known or option not in known[command]._option_string_actions
    ]
    assert unknown == []


def test_options_are_found() -> None:
    """What the other test looks at is there."""
    assert len(uses(PROJECT / "README.md")) > 20
    assert ("match", "--every") in uses(PROJECT / "examples" / "pipelines" / "README.md")
    assert ("match", "--camera_model") in uses(PROJECT / "examples/pipelines/nerfstudio.sh")
    assert ("export", "--output") in uses(PROJECT / "examples" / "pipelines" / "hloc.sh")
    assert all(uses(script) for script in SCRIPTS)


def test_loose_options_of_documents_exist() -> None:
    """Options that a text names alone are those of some command, or of a script beside it."""
    known = {o for parser in commands().values() for o in parser._option_string_actions}
    scripts = [p.read_text() for p in (PROJECT / "examples").rglob("*.*") if p.suffix == ".py"]
    for path in DOCUMENTS:
        outside = re.sub(r"^```\w*\n.*?^```", "", path.read_text(), flags=re.DOTALL | re.MULTILINE)
        for piece in re.findall(r"`(--\w[^`]*)`", outside):
            for option in named_options(piece):
                of_script = any(f'"{option}"' in text for text in scripts)
                assert option in known or of_script, f"{path}: {option}"

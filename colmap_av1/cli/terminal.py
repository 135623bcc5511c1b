"""What the command line prints: progress, summaries, warnings."""

from __future__ import annotations

import contextlib
import io
import os
import sys
import warnings
from argparse import Namespace
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from colmap_av1.cli.reports import Rows
from colmap_av1.util.remote import without_secrets
from colmap_av1.util.texts import on_one_line

if TYPE_CHECKING:
    from colmap_av1.util.progress import Progress

PROGRAM = "colmap-av1"

# Paths of files that exist while a command runs, and the names that replace them in texts.
_NAMES: dict[str, str] = {}


class StreamError(Exception):
    """Standard output cannot be written; the cause is the system's error."""


def show_as(path: str, name: str) -> None:
    """Replace a path by a name in all texts from now on, also after the file is gone."""
    _NAMES[path] = name


def renamed(text: str) -> str:
    """The text with the names of `show_as`."""
    for path, name in _NAMES.items():
        text = text.replace(path, name)
    return text


def as_shown(text: str) -> str:
    """The text on one line, with the names of `show_as`."""
    return on_one_line(renamed(text))


@contextmanager
def progress_bars(quiet: bool) -> Iterator[Progress]:
    """Progress bars on standard error if it is a terminal, one for each stage."""
    if quiet or not sys.stderr.isatty():
        yield lambda *_: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as ProgressBars

    columns = (
        TextColumn("{task.description:12}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
    )
    with ProgressBars(*columns, console=Console(stderr=True)) as progress:
        tasks: dict[str, Any] = {}

        def report(stage: str, done: int, total: int | None) -> None:
            if stage not in tasks:
                tasks[stage] = progress.add_task(stage, total=total, rate="")
            speed = progress.tasks[tasks[stage]].speed
            rate = f"{speed:.1f}/s" if speed else ""
            progress.update(tasks[stage], completed=done, total=total, rate=rate)

        yield report


def print_summary(rows: Rows) -> None:
    """Print rows as a table on a terminal, and otherwise as lines of name, tab and value."""
    rows = [(as_shown(name), as_shown(value)) for name, value in rows]
    if not sys.stdout.isatty():
        print_text("".join(f"{name}\t{value}\n" for name, value in rows))
        return
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(show_header=False)
    for name, value in rows:
        table.add_row(Text(name), Text(value))  # brackets are not markup
    with _writing():
        Console().print(table)


def print_result(namespace: Namespace, rows: Rows, warnings: Sequence[str] = ()) -> None:
    """Print the warnings, and a summary unless --quiet is given."""
    for warning in warnings:
        print_warning(warning)
    if not namespace.quiet:
        print_summary(rows)


def print_text(text: str) -> None:
    """Write to standard output.

    Raises:
        StreamError: it cannot be written, or its reader has closed it.
    """
    with _writing():
        sys.stdout.write(text)


@contextmanager
def _writing() -> Iterator[None]:
    try:
        yield
        sys.stdout.flush()
    except OSError as error:
        _silence(sys.stdout)
        raise StreamError from error


def print_note(message: object) -> None:
    """Print a line to standard error."""
    _print_line(f"{PROGRAM}: {message}")


def print_warning(message: object) -> None:
    """Print a warning as a line to standard error."""
    _print_line(f"{PROGRAM}: warning: {message}")


def print_error(message: object) -> None:
    """Print an error as a line to standard error."""
    _print_line(f"{PROGRAM}: error: {message}")


def _print_line(text: str) -> None:
    try:
        # File names may contain any character.
        print(as_shown(without_secrets(text)), file=sys.stderr, flush=True)
    except OSError:  # nowhere left to report it
        _silence(sys.stderr)


def _silence(stream: Any) -> None:
    """Discard what a stream has buffered, which Python would fail to write at exit."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def allow_any_file_name() -> None:
    """Let standard output take any file name; names that are not valid text as their bytes."""
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
        is_unicode = sys.stdout.encoding.lower().startswith("utf")
        sys.stdout.reconfigure(errors="surrogateescape" if is_unicode else "backslashreplace")


@contextmanager
def warnings_as_lines() -> Iterator[None]:
    """Print the warnings of the body as lines."""
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_, **__: print_warning(message)
        yield

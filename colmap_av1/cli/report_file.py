"""The report of a command, or its error, as a JSON file for other programs."""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from colmap_av1.cli.terminal import renamed
from colmap_av1.errors import OptionError, WriteError, writing
from colmap_av1.util.cpus import cpu_seconds
from colmap_av1.util.files import check_creatable, whole_file
from colmap_av1.util.plain import json_text

# Options that name the outputs of commands.
_OUTPUTS = ("database", "output", "gaussians", "keep_stream")


def write_report_json(namespace: argparse.Namespace, report: Any, **others: Any) -> None:
    """Write the report of a command on videos, and other values by name, if requested."""
    if namespace.report_json is None:
        return
    from colmap_av1.video.container import read_file

    given = namespace.video
    durations = [read_file(video).duration for video in (given if type(given) is list else [given])]
    known = [duration for duration in durations if duration is not None]
    facts = {
        "report": dataclasses.asdict(report),
        "video_seconds": sum(known) if len(known) == len(durations) else None,
        "cpu_seconds": cpu_seconds(),
        **others,
    }
    _write(namespace.report_json, facts)


@contextmanager
def failure_as_json(namespace: argparse.Namespace) -> Iterator[None]:
    """Write the reason if the body fails, if requested.

    Raises:
        OptionError: the file for the report cannot be created, or exists and is not a report.
    """
    path = getattr(namespace, "report_json", None)
    if path is not None:
        given = vars(namespace).items()
        _check_report(Path(path), [v for k, v in given if k.rpartition(".")[2] in _OUTPUTS])
    try:
        yield
    except Exception as error:
        if path is not None:
            from colmap_av1.util.failures import failure_of

            failure = dataclasses.asdict(failure_of(error))
            with suppress(WriteError):  # the error itself is reported in any case
                _write(path, {"failure": failure, "cpu_seconds": cpu_seconds()})
        raise


def _check_report(path: Path, outputs: Iterable[str | None]) -> None:
    """Check that a report can be written to a file, which it may create or replace.

    Raises:
        OptionError: the file cannot be created, exists and is not a report, or is one of the
            `outputs` of the command or lies in one.
    """
    check_creatable(path)
    for output in outputs:
        if output is not None and path.resolve().is_relative_to(Path(output).resolve()):
            raise OptionError(f"{path}: lies in the output {output}: give another file")
    if not os.path.lexists(path):
        return
    found: object = None
    if path.is_file():
        with suppress(OSError, ValueError, RecursionError), path.open("rb") as file:
            start = file.read(1)
            found = json.loads(start + file.read()) if start == b"{" else None
    if not (isinstance(found, dict) and "cpu_seconds" in found):
        raise OptionError(f"{path}: exists and is not a report: give another file")


def _write(path: str, facts: dict[str, Any]) -> None:
    with writing(Path(path)):
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        with whole_file(Path(path)) as partial:
            partial.write_text(json_text(facts, renamed))

"""The report of a command, or its error, as a JSON file for other programs."""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from colmap_av1.util.cpus import cpu_seconds
from colmap_av1.util.files import whole_file
from colmap_av1.util.plain import plain


def write_report_json(namespace: argparse.Namespace, report: Any) -> None:
    """Write the report of a command on videos, if requested."""
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
    }
    _write(namespace.report_json, facts)


@contextmanager
def failure_as_json(namespace: argparse.Namespace) -> Iterator[None]:
    """Write the reason if the body fails, if requested."""
    try:
        yield
    except Exception as error:
        path = getattr(namespace, "report_json", None)
        if path is not None:
            from colmap_av1.util.failures import failure_of

            failure = dataclasses.asdict(failure_of(error))
            with suppress(OSError):  # the error itself is reported in any case
                _write(path, {"failure": failure, "cpu_seconds": cpu_seconds()})
        raise


def _write(path: str, facts: dict[str, Any]) -> None:
    with whole_file(Path(path)) as partial:
        partial.write_text(json.dumps(plain(facts), indent=1, allow_nan=False) + "\n")

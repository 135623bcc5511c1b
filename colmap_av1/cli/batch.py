"""The command `batch`."""

from __future__ import annotations

import argparse

import colmap_av1
from colmap_av1.cli.options import add_options, add_options_of_any, given, given_of_any
from colmap_av1.cli.parser import Parser
from colmap_av1.cli.reports import batch_rows
from colmap_av1.cli.terminal import print_result
from colmap_av1.errors import OptionError
from colmap_av1.options import BatchOptions
from colmap_av1.options.batch import TASK_OPTIONS

_SOME_FAILED = 1


def add_arguments(command: Parser) -> None:
    """Add the arguments to the parser of the command."""
    command.add_argument(
        "verb", nargs="?", choices=("report",), help="write report.html into the output of a batch"
    )
    command.add_argument(
        "--inputs",
        nargs="+",
        metavar="PATH",
        help="paths or URLs of videos, folders, quoted patterns, or lists (on each line a path or "
        "URL, optionally followed by a tab and a name, or '# ' and a comment)",
    )
    command.add_argument(
        "--output",
        "--output_path",
        required=True,
        metavar="PATH",
        help="folder or URL for batch.csv, batch.json and a folder for each video",
    )
    command.add_argument("--task", choices=tuple(TASK_OPTIONS), help="the task for each video")
    command.add_argument(
        "--models",
        metavar="PATH",
        help="densify: folder or URL that contains a model for each video, under its name",
    )
    add_options(command, BatchOptions)
    add_options_of_any(command, *TASK_OPTIONS.values())


def run(namespace: argparse.Namespace) -> int | None:
    """Run a batch or make its page, and return the exit status."""
    if namespace.verb == "report":
        print_result(namespace, [("report", colmap_av1.write_page(namespace.output))])
        return None
    if namespace.inputs is None or namespace.task is None:
        missing = "inputs" if namespace.inputs is None else "task"
        raise OptionError(f"nothing to do: give --{missing} (see colmap-av1 batch --help)")
    task = given_of_any(namespace, TASK_OPTIONS[namespace.task], f"the task {namespace.task}")
    options = given(namespace, BatchOptions)
    from colmap_av1.cli.batch_progress import batch_progress

    with batch_progress(namespace.quiet) as (on_start, on_progress):
        report = colmap_av1.run_batch(
            namespace.inputs,
            namespace.output,
            task,
            models=namespace.models,
            options=options,
            on_start=on_start,
            on_progress=on_progress,
        )
    print_result(namespace, batch_rows(report), report.warnings)
    return _SOME_FAILED if report.failed else None

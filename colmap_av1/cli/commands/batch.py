"""The subcommand `batch`."""

from __future__ import annotations

import argparse
from typing import Any

from colmap_av1.batch.page import write_page
from colmap_av1.batch.run import run_batch
from colmap_av1.batch.tasks import TASKS
from colmap_av1.cli.batch_progress import batch_progress
from colmap_av1.cli.commands.shared import add_command, add_output, add_quiet, print_result
from colmap_av1.cli.options import add_options, add_options_of_any, given, given_of_any
from colmap_av1.cli.reports import batch_rows
from colmap_av1.errors import OptionError
from colmap_av1.options import BatchOptions

_SOME_FAILED = 1


def add_batch(commands: Any) -> None:
    """Add `batch`."""
    command = add_command(
        commands,
        "batch",
        _run,
        "do one task on many videos, on this machine or a cluster; 'batch report' makes a page",
        "[report] --inputs PATH ... --output PATH --task TASK",
        full_help=True,
    )
    command.add_argument(
        "verb", nargs="?", choices=("report",), help="write report.html into the output of a batch"
    )
    command.add_argument(
        "--inputs",
        nargs="+",
        metavar="PATH",
        help="lists (a path or URL on each line, and if wanted a tab and a name), quoted patterns, "
        "folders, tar files and videos; paths or URLs",
    )
    add_output(command, "folder or URL for a folder of each video, batch.csv and batch.json")
    command.add_argument("--task", choices=tuple(TASKS), help="what is done with each video")
    command.add_argument(
        "--models",
        metavar="PATH",
        help="of densify: folder or URL with a model for each video, under its name",
    )
    add_options(command, BatchOptions)
    add_options_of_any(command, *(task.kind for task in TASKS.values()))
    add_quiet(command)


def _run(namespace: argparse.Namespace) -> int | None:
    if namespace.verb == "report":
        print_result(namespace, [("report", write_page(namespace.output))])
        return None
    if namespace.inputs is None or namespace.task is None:
        missing = "inputs" if namespace.inputs is None else "task"
        raise OptionError(f"nothing to do: give --{missing} (see colmap-av1 batch --help)")
    task = given_of_any(namespace, TASKS[namespace.task].kind, f"the task {namespace.task}")
    options = given(namespace, BatchOptions)
    with batch_progress(namespace.quiet) as (hear, watch):
        report = run_batch(
            *(namespace.inputs, namespace.output, task),
            models=namespace.models,
            options=options,
            hear=hear,
            watch=watch,
        )
    print_result(namespace, batch_rows(report), report.warnings)
    return _SOME_FAILED if report.failed else None

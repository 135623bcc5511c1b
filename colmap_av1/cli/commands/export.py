"""The subcommand `export`."""

from __future__ import annotations

import argparse
from typing import Any

from colmap_av1.cli.commands.shared import (
    OTHERS_TOO,
    add_command,
    add_database,
    add_output,
    add_overwrite,
    add_quiet,
    print_result,
)
from colmap_av1.cli.options import add_options, given
from colmap_av1.cli.terminal import progress_bars
from colmap_av1.interop.hloc import export_hloc
from colmap_av1.options import ExportOptions


def add_export(commands: Any) -> None:
    """Add `export`."""
    command = add_command(
        commands,
        "export",
        _run,
        "write a database's features and matches for hloc",
        "--database PATH --output PATH",
    )
    add_database(command)
    add_output(command, "folder for the files")
    add_overwrite(command, OTHERS_TOO)
    add_options(command, ExportOptions)
    add_quiet(command)


def _run(namespace: argparse.Namespace) -> None:
    options = given(namespace, ExportOptions)
    with progress_bars(namespace.quiet) as report:
        num_images, num_pairs = export_hloc(
            *(namespace.database, namespace.output, options, report),
            overwrite=namespace.overwrite,
        )
    rows = [("images", str(num_images)), ("pairs", str(num_pairs))]
    print_result(namespace, [*rows, ("output", namespace.output)])

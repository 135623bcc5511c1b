"""The subcommand `map`."""

from __future__ import annotations

import argparse
from typing import Any

from colmap_av1.cli.commands.shared import (
    ONLY_MODELS,
    add_command,
    add_database,
    add_output,
    add_overwrite,
    add_quiet,
    print_result,
)
from colmap_av1.cli.options import add_options, given
from colmap_av1.cli.reports import map_rows
from colmap_av1.cli.terminal import progress_bars
from colmap_av1.map import map_database
from colmap_av1.options import MapOptions, PlaceOptions


def add_map(commands: Any) -> None:
    """Add `map`."""
    command = add_command(
        commands,
        "map",
        _run,
        "make a model of a COLMAP database with one of COLMAP's mappers",
        "--database PATH --image_path PATH --output PATH",
    )
    add_database(command)
    command.add_argument(
        "--image_path", required=True, metavar="PATH", help="folder of the database's images"
    )
    add_output(command, "new folder for the models; 0 is the one with the most images")
    add_overwrite(command, ONLY_MODELS)
    add_options(command, MapOptions, PlaceOptions)
    add_quiet(command)


def _run(namespace: argparse.Namespace) -> None:
    options = given(namespace, MapOptions)
    with progress_bars(namespace.quiet) as report:
        result = map_database(
            namespace.database,
            namespace.image_path,
            namespace.output,
            options=options,
            place=given(namespace, PlaceOptions),
            progress=report,
            overwrite=namespace.overwrite,
        )
    print_result(namespace, map_rows(result), result.warnings)

"""The subcommand `check`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from colmap_av1.check.database import check
from colmap_av1.check.model import check_model
from colmap_av1.cli.commands.shared import add_command, add_images, add_quiet, print_result
from colmap_av1.cli.reports import check_rows, model_rows
from colmap_av1.cli.terminal import progress_bars
from colmap_av1.errors import OptionError
from colmap_av1.geometry.colmap_model import read_model

_FAILED_CHECK = 1


def add_check(commands: Any) -> None:
    """Add `check`."""
    command = add_command(
        commands,
        "check",
        _run,
        "report what COLMAP's mappers will make of a database, or whether a model holds together",
        "{--database PATH | --model PATH --image_path PATH}",
    )
    command.add_argument("--database", "--database_path", metavar="PATH", help="a COLMAP database")
    command.add_argument(
        "--model",
        "--model_path",
        metavar="PATH",
        help="folder of a COLMAP model: pictures of places seen again are held against its poses, "
        "and with --database the matches it was mapped from",
    )
    add_images(command, "folder of the model's images")
    command.add_argument(
        "--strict",
        action="store_true",
        help="exit with status 1 if the mappers cannot use the database, it is damaged, or the "
        "model bends",
    )
    add_quiet(command)


def _run(namespace: argparse.Namespace) -> int:
    if namespace.database is None and namespace.model is None:
        raise OptionError("nothing to check: give --database, or --model with --image_path")
    if (namespace.model is None) != (namespace.image_path is None):
        raise OptionError("a model is checked by its pictures: give both --model and --image_path")
    good = True
    if namespace.database is not None:
        result = check(namespace.database)
        print_result(namespace, check_rows(result))
        good = result.mappable and not result.damaged
    if namespace.model is not None:
        good = _check_model(namespace) and good
    return 0 if good or not namespace.strict else _FAILED_CHECK


def _check_model(namespace: argparse.Namespace) -> bool:
    """Print what a model is like; whether it holds together."""
    model = read_model(namespace.model)
    database = None if namespace.database is None else Path(namespace.database)
    with progress_bars(namespace.quiet) as report:
        found = check_model(
            model,
            image_path=Path(namespace.image_path),
            database=database,
            progress=report,
        )
    print_result(namespace, model_rows(found), found.warnings)
    return not found.warnings

"""The subcommand `check`."""

from __future__ import annotations

import argparse
from typing import Any

from colmap_av1.cli.commands.shared import add_command, add_database
from colmap_av1.cli.reports import check_rows
from colmap_av1.cli.terminal import print_summary
from colmap_av1.database.check import check

_FAILED_CHECK = 1


def add_check(commands: Any) -> None:
    """Add `check`."""
    command = add_command(
        commands,
        "check",
        _run,
        "report what COLMAP's mappers will make of a database",
        "--database PATH",
    )
    add_database(command)
    command.add_argument(
        "--strict",
        action="store_true",
        help="exit with status 1 if the mappers cannot use the database",
    )


def _run(namespace: argparse.Namespace) -> int:
    result = check(namespace.database)
    print_summary(check_rows(result))
    return _FAILED_CHECK if namespace.strict and not result.mappable else 0

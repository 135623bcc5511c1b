"""The parser of a command: short and full help, and errors that name the nearest option."""

from __future__ import annotations

import argparse
import difflib
from collections.abc import Sequence
from typing import Any, NoReturn

from colmap_av1.cli.terminal import PROGRAM

BAD_INPUT = 2


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, and whose help may leave out what few users need.

    Attributes:
        rare: options that --help leaves out where there is --help-all.
    """

    def __init__(self, *, full_help: bool = False, **how: Any) -> None:
        super().__init__(add_help=False, allow_abbrev=False, **how)
        self.rare: list[argparse.Action] = []
        self._full_help = full_help
        self.add_argument("-h", "--help", action=_Help, nargs=0, help="show this help and exit")
        if full_help:
            text = "show the help of all options and exit"
            self.add_argument("--help-all", action=_FullHelp, nargs=0, help=text)
            # As words come, with '_' for '-'.
            self.add_argument("--help_all", action=_FullHelp, nargs=0, help=argparse.SUPPRESS)

    def short_help(self) -> str:
        """Help without the rare options where there is --help-all."""
        if self._full_help:
            for action in self.rare:
                action.help = argparse.SUPPRESS
            self.epilog = f"--help-all shows all options. {self.epilog or ''}"
        return self.format_help()

    def error(self, message: str) -> NoReturn:
        """Exit with a line that says what is wrong."""
        self.exit(BAD_INPUT, f"{PROGRAM}: error: {message} (see {self.prog} --help)\n")

    def refuse_unknown(self, words: Sequence[str]) -> None:
        """Exit on an unknown option, and name the one nearest to it."""
        known = self._option_string_actions
        for word in words:
            name = word.partition("=")[0]
            if name.startswith("--") and name != "--" and name not in known:
                near = difflib.get_close_matches(name, known, n=1)
                meant = f": did you mean {near[0]}?" if near else ""
                self.error(f"there is no option {name}{meant}")


class _Help(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> NoReturn:
        print(parser.short_help() if isinstance(parser, Parser) else parser.format_help(), end="")
        parser.exit()


class _FullHelp(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> NoReturn:
        parser.print_help()
        parser.exit()

"""The parser of a command: short and full help, and errors that suggest the nearest option."""

from __future__ import annotations

import argparse
import difflib
import re
from collections.abc import Sequence
from typing import Any, NoReturn

from colmap_av1.cli.terminal import print_error, print_text

BAD_INPUT = 2
_PATH = "PATH"
# The negative numbers that argparse does not take for options.
_NUMBER = re.compile(r"-\d+|-\d*\.\d+")


class Parser(argparse.ArgumentParser):
    """A parser with errors of one line, and with short help that omits rare options.

    Attributes:
        rare: options that --help omits if there is --help-all.
    """

    def __init__(self, *, full_help: bool = False, **how: Any) -> None:
        super().__init__(add_help=False, allow_abbrev=False, **how)
        self.rare: list[argparse.Action] = []
        self._full_help = full_help
        self.add_argument("-h", "--help", action=_Help, nargs=0, help="show this help and exit")
        # A command without rare options accepts --help-all, but does not show it.
        text = "show the help of all options and exit" if full_help else argparse.SUPPRESS
        self.add_argument("--help-all", action=_FullHelp, nargs=0, help=text)
        # The command line replaces '-' in option names by '_' before parsing.
        self.add_argument("--help_all", action=_FullHelp, nargs=0, help=argparse.SUPPRESS)

    def short_help(self) -> str:
        """Help, without the rare options if there is --help-all."""
        if self._full_help:
            for action in self.rare:
                action.help = argparse.SUPPRESS
            self.epilog = f"--help-all shows all options. {self.epilog or ''}"
        return self.format_help()

    def error(self, message: str) -> NoReturn:
        """Exit with a message of one line."""
        print_error(f"{message} (see {self.prog} --help)")
        self.exit(BAD_INPUT)

    def refuse_unknown(self, words: Sequence[str]) -> None:
        """Exit on an unknown option, with the nearest one, or on a value that looks like one."""
        known = self._option_string_actions
        for word, following in zip(words, [*words, ""][1:], strict=True):
            name = word.partition("=")[0]
            takes_one = word in known and known[word].nargs is None
            if takes_one and _like_an_option(following) and following not in known:
                self.error(f"a value that begins with '-' needs '=': give {word}={following}")
            if name.startswith("--") and name != "--" and name not in known:
                near = difflib.get_close_matches(name, known, n=1)
                meant = f": did you mean {near[0]}?" if near else ""
                self.error(f"there is no option {name}{meant}")

    def refuse_empty(self, namespace: argparse.Namespace) -> None:
        """Exit if a path is empty. An unset shell variable would otherwise mean this folder."""
        for action in self._actions:
            value = getattr(namespace, action.dest, None) if action.metavar == _PATH else None
            if "" in (value if isinstance(value, list) else [value]):
                self.error(f"{action.option_strings[0]} is empty: give a path")


def _like_an_option(word: str) -> bool:
    """Whether argparse takes a word for an option, not for a value."""
    return word.startswith("-") and not word.startswith("--") and not _NUMBER.fullmatch(word)


class _Help(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> NoReturn:
        print_text(parser.short_help() if isinstance(parser, Parser) else parser.format_help())
        parser.exit()


class _FullHelp(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> NoReturn:
        print_text(parser.format_help())
        parser.exit()

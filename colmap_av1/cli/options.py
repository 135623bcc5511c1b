"""Options dataclasses as options of the command line."""

from __future__ import annotations

import argparse
import dataclasses
import inspect
import re
import types
import typing
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeVar

from colmap_av1.options import CameraOptions, VerifyOptions

_Options = TypeVar("_Options")
_Number = TypeVar("_Number", int, float)

# Prefix of the namespace entries that are fields of options.
_OPTION = "option."

# Options under other names than their fields', and COLMAP's prefixes, which are accepted.
_SPELLINGS = {"seed": ("--random_seed",)}
# Options whose value is a file.
_FILES = ("frame_list", "keep_stream")
_PREFIXES: dict[type, str] = {CameraOptions: "ImageReader", VerifyOptions: "TwoViewGeometry"}
# Whole numbers are 32 bits wide where they are used; squares of others fit, too.
_LARGEST = 2**31 - 1


def add_options(
    command: argparse.ArgumentParser, kinds: dict[type, str], *, without: Sequence[str] = ()
) -> None:
    """Add an option for each field of some options dataclasses, in groups of the given titles.

    The field's comment is the help text. Fields that hold further options are left out; a name
    that several kinds have, such as num_threads, is one option for all of them. What is not
    given on the command line does not appear in the namespace.

    Args:
        command: the subcommand.
        kinds: title of each dataclass's group.
        without: fields that the subcommand has no use for.
    """
    added: set[str] = set(without)
    for kind, title in kinds.items():
        group = command.add_argument_group(title)
        hints = typing.get_type_hints(kind)
        comments = _field_comments(kind)
        for field in dataclasses.fields(kind):
            if dataclasses.is_dataclass(field.default) or field.name in added:
                continue
            added.add(field.name)
            names = [*_SPELLINGS.get(field.name, ()), f"--{field.name}"]
            parse, metavar = _value_parser(hints[field.name])
            default = _spell(field.default)
            how: dict[str, Any] = {"nargs": "?", "const": True} if hints[field.name] is bool else {}
            how |= {"dest": f"{_OPTION}{field.name}", "type": parse, "default": argparse.SUPPRESS}
            group.add_argument(
                *names,
                metavar="PATH" if field.name in _FILES else metavar,
                help=f"{comments.get(field.name, '')} [{default}]".strip().replace("%", "%%"),
                **how,
            )
            if kind in _PREFIXES:  # accepted, but no reading for help
                prefixed = f"--{_PREFIXES[kind]}.{field.name}"
                command.add_argument(prefixed, help=argparse.SUPPRESS, **how)


def given(namespace: argparse.Namespace, kind: type[_Options], **more: Any) -> _Options:
    """The options of a kind, with those given on the command line in place of defaults."""
    names = typing.get_type_hints(kind)
    given = {
        k.removeprefix(_OPTION): v for k, v in vars(namespace).items() if k.startswith(_OPTION)
    }
    # `refine` is an option and, in MatchOptions, the kind of options that has it.
    return kind(**{k: v for k, v in given.items() if k in names and k not in more}, **more)


def underscored(word: str) -> str:
    """The word with '_' for '-' in an option's name; its value stays as it is."""
    if not word.startswith("--") or word == "--":
        return word
    name, equals, value = word[2:].partition("=")
    return f"--{name.replace('-', '_')}{equals}{value}"


def _field_comments(kind: type) -> dict[str, str]:
    """The comment above each field of a class; none where its source is not installed."""
    try:
        lines = inspect.getsource(kind).splitlines()
    except OSError:
        return {}
    comments: dict[str, str] = {}
    comment: list[str] = []
    for line in map(str.strip, lines):
        if line.startswith("#"):
            comment.append(line.lstrip("# "))
            continue
        field = re.match(r"(\w+):", line)
        if field and comment:
            comments[field[1]] = " ".join(comment).replace("None", "none")
        comment = []
    return comments


def _value_parser(hint: Any) -> tuple[Callable[[str], Any], str]:
    """Parser and placeholder for the values of a field's type."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (types.UnionType, typing.Union):
        (inner,) = (a for a in arguments if a is not type(None))
        parse, metavar = _value_parser(inner)
        return (lambda word: None if word.lower() == "none" else parse(word)), metavar
    if origin is tuple:
        parse, metavar = _value_parser(arguments[0])
        return (lambda words: tuple(parse(word) for word in words.split(","))), f"{metavar},..."
    if origin is typing.Literal:
        return str, "|".join(arguments)
    if hint is bool:
        return _parse_bool, "0|1"
    parsers: dict[Any, tuple[Callable[[str], Any], str]] = {
        int: (partial(_parse_number, int, "whole number"), "N"),
        float: (partial(_parse_number, float, "number"), "X"),
        str: (str, "TEXT"),
    }
    return parsers[hint]


def _parse_number(kind: type[_Number], what: str, word: str) -> _Number:
    try:
        value = kind(word)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{word}' is no {what}") from None
    if abs(value) > _LARGEST:
        raise argparse.ArgumentTypeError(f"{word} is too large: give {_LARGEST} at most")
    return value


def _parse_bool(word: str) -> bool:
    values = {"1": True, "true": True, "yes": True, "0": False, "false": False, "no": False}
    if word.lower() not in values:
        raise argparse.ArgumentTypeError(f"'{word}' is neither 0 nor 1")
    return values[word.lower()]


def _spell(value: Any) -> str:
    if isinstance(value, bool):
        return str(int(value))
    if isinstance(value, tuple):
        return ",".join(map(str, value))
    return "none" if value is None else str(value)

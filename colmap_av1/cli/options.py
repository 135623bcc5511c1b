"""Options dataclasses as command-line options."""

from __future__ import annotations

import argparse
import dataclasses
import typing
from collections.abc import Callable, Collection, Iterator
from functools import partial
from typing import Any, TypeVar

from colmap_av1.cli.parser import Parser
from colmap_av1.errors import OptionError
from colmap_av1.options.fields import (
    Options,
    declared_of,
    field_types,
    is_path,
    members_of,
    unused_in,
)
from colmap_av1.options.words import word_of

_Options = TypeVar("_Options", bound=Options)
_Number = TypeVar("_Number", int, float)

# Prefix in a namespace for options that several dataclasses share.
_ANY = "any."


def add_options(command: Parser, *kinds: type[Options]) -> None:
    """Add an option for each field of options dataclasses and of the dataclasses they contain.

    Each dataclass is a group with its title; only --help-all shows fields that are not common.
    Options that are not given on the command line do not appear in the namespace.

    Args:
        command: the subcommand.
        kinds: the dataclasses.

    Raises:
        argparse.ArgumentError: two fields have the same name.
    """
    for kind in kinds:
        for part in _parts(kind(), kind.__name__, frozenset()):
            group = command.add_argument_group(part.options.title)
            for field in part.fields:
                _add_option(command, group, part.options, field, f"{part.name}.{field.name}")


def given(namespace: argparse.Namespace, kind: type[_Options]) -> _Options:
    """The options of a kind: those given on the command line, and defaults.

    Raises:
        OptionError: a value is invalid.
    """
    return _with_given(kind(), kind.__name__, vars(namespace))


def add_options_of_any(command: Parser, *kinds: type[Options]) -> None:
    """Add the options of several dataclasses, of which one is used; shared options are added once.

    See `given_of_any`.

    Args:
        command: the subcommand.
        kinds: the dataclasses.
    """
    added: set[str] = set()
    for kind in kinds:
        for part in _parts(kind(), kind.__name__, frozenset()):
            fields = [field for field in part.fields if field.name not in added]
            if fields:
                group = command.add_argument_group(part.options.title)
            for field in fields:
                _add_option(command, group, part.options, field, f"{_ANY}{field.name}")
                added.add(field.name)


def given_of_any(namespace: argparse.Namespace, kind: type[_Options], what: str) -> _Options:
    """Like `given`, for options added by `add_options_of_any`.

    Args:
        namespace: the parsed arguments.
        kind: the dataclass that is used.
        what: name of its use, for messages.

    Raises:
        OptionError: a value is invalid, or an option belongs to another dataclass.
    """
    options = kind()
    left = {k.removeprefix(_ANY): v for k, v in vars(namespace).items() if k.startswith(_ANY)}
    values = {
        f"{part.name}.{field.name}": left.pop(field.name)
        for part in _parts(options, kind.__name__, frozenset())
        for field in part.fields
        if field.name in left
    }
    if left:
        raise OptionError(f"{what} has no option '{next(iter(left))}': leave it out")
    return _with_given(options, kind.__name__, values)


def underscored(word: str) -> str:
    """The word with '-' replaced by '_' in an option's name, but not in its value."""
    if not word.startswith("--") or word == "--":
        return word
    name, equals, value = word[2:].partition("=")
    return f"--{name.replace('-', '_')}{equals}{value}"


@dataclasses.dataclass(frozen=True)
class _Part:
    """Options within those of the command: their path, and the fields that the command has."""

    options: Options
    name: str
    fields: list[dataclasses.Field[Any]]


def _parts(options: Options, name: str, unused: Collection[str]) -> Iterator[_Part]:
    """The options and all options that they contain, except unused ones; the outer ones first."""
    used = [f for f in dataclasses.fields(typing.cast(Any, options)) if f.name not in unused]
    parts = [f for f in used if isinstance(getattr(options, f.name), Options)]
    yield _Part(options, name, [f for f in used if f not in parts])
    for field in parts:
        part = getattr(options, field.name)
        yield from _parts(part, f"{name}.{field.name}", unused_in(field, unused))


def _add_option(
    command: Parser, group: Any, options: Options, field: dataclasses.Field[Any], dest: str
) -> None:
    declared = declared_of(field)
    hint = field_types(type(options))[field.name]
    names = [*declared.spellings, field.name]
    parse, metavar = _value_parser(hint)
    how: dict[str, Any] = {"nargs": "?", "const": True} if bool in members_of(hint) else {}
    how |= {"dest": dest, "type": parse, "default": argparse.SUPPRESS}
    about = declared.help.replace("None", "none")
    text = f"{about} [{word_of(getattr(options, field.name))}]"
    action = group.add_argument(
        *(f"--{name}" for name in names), metavar=metavar, help=text.replace("%", "%%"), **how
    )
    if not declared.common:
        command.rare.append(action)
    if declared.colmap:  # accepted, but not shown in help
        command.add_argument(f"--{declared.colmap}", help=argparse.SUPPRESS, **how)


def _with_given(options: _Options, name: str, values: dict[str, Any]) -> _Options:
    changes = {}
    for field in dataclasses.fields(typing.cast(Any, options)):
        path, value = f"{name}.{field.name}", getattr(options, field.name)
        if isinstance(value, Options):
            changes[field.name] = _with_given(value, path, values)
        elif path in values:
            changes[field.name] = values[path]
    return typing.cast(_Options, dataclasses.replace(typing.cast(Any, options), **changes))


def _value_parser(hint: Any) -> tuple[Callable[[str], Any], str]:
    """Parser and placeholder of values of a field's type."""
    members = [member for member in members_of(hint) if member is not type(None)]
    if type(None) in members_of(hint):
        parse, metavar = _value_parser(typing.Union[tuple(members)])  # noqa: UP007 - made here
        return (lambda word: None if word.lower() == "none" else parse(word)), metavar
    if is_path(members):
        return str, "PATH"
    arguments = typing.get_args(hint)
    if typing.get_origin(hint) is tuple:
        parse, metavar = _value_parser(arguments[0])
        return (lambda words: tuple(parse(word) for word in words.split(","))), f"{metavar},..."
    if typing.get_origin(hint) is typing.Literal:
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
        return kind(word)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{word}' is not a {what}") from None


def _parse_bool(word: str) -> bool:
    values = {"1": True, "true": True, "yes": True, "0": False, "false": False, "no": False}
    if word.lower() not in values:
        raise argparse.ArgumentTypeError(f"'{word}' is neither 0 nor 1")
    return values[word.lower()]

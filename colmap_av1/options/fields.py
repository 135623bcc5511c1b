"""Declare option fields with help and bounds, and check their values."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import math
import os
import types
import typing
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any, ClassVar, TypeVar, cast

from colmap_av1.errors import OptionError

_Value = TypeVar("_Value")

# Key in a field's metadata.
_DECLARED = "declared"
# Largest magnitude of a number: integers are stored in 32 bits, and squares of floats do not
# overflow.
_LARGEST = 2**31 - 1
_KINDS = {bool: "True or False", int: "a whole number", float: "a number", str: "a text"}
_MANY = {int: "whole numbers", str: "texts"}


@dataclass(frozen=True)
class Declared:
    """What an option field declares in addition to its type.

    Attributes:
        help: description of the option, one line of any length.
        least: smallest value, also of the numbers in a tuple.
        most: largest value.
        above: exclusive lower bound.
        below: exclusive upper bound.
        unit: unit of numbers, such as "pixels", for messages.
        among: the only allowed values.
        common: whether most users need the option.
        spellings: further names on the command line.
        colmap: COLMAP's name, such as ImageReader.camera_model, which is accepted as well.
        unused: paths of fields of this part that have no effect here.
    """

    help: str = ""
    least: float | None = None
    most: float | None = None
    above: float | None = None
    below: float | None = None
    unit: str = ""
    among: tuple[int, ...] = ()
    common: bool = False
    spellings: tuple[str, ...] = ()
    colmap: str = ""
    unused: frozenset[str] = frozenset()


def option(
    default: _Value,
    help: str,
    *,
    least: float | None = None,
    most: float | None = None,
    above: float | None = None,
    below: float | None = None,
    unit: str = "",
    among: tuple[int, ...] = (),
    common: bool = False,
    spellings: tuple[str, ...] = (),
    colmap: str = "",
) -> _Value:
    """Declare a field of an options dataclass, see `Declared`."""
    declared = Declared(
        help,
        least,
        most,
        above,
        below,
        unit,
        among,
        common=common,
        spellings=spellings,
        colmap=colmap,
    )
    return dataclasses.field(default=default, metadata={_DECLARED: declared})


def part(default: _Value, *, unused: Collection[str] = ()) -> _Value:
    """Declare a field that holds further options.

    Args:
        default: the default options.
        unused: names of options that have no effect here, "name" or "part.name".
    """
    declared = Declared(unused=frozenset(unused))
    return dataclasses.field(default=default, metadata={_DECLARED: declared})


class Options:
    """Base class of the options dataclasses. Values are checked on construction.

    Attributes:
        title: title of the group in help texts.

    Raises:
        OptionError: a value has the wrong type or is out of bounds.
    """

    title: ClassVar[str] = ""

    def __init_subclass__(cls) -> None:
        # The help of the fields is part of the docstring, for `help()` and the documentation.
        fields = [
            f"    {name}: {declared.help or f'see `{type(field.default).__name__}`'}"
            for name, field in vars(cls).items()
            if isinstance(field, dataclasses.Field) and (declared := declared_of(field))
        ]
        text = inspect.cleandoc(cls.__doc__ or "")
        cls.__doc__ = "\n".join([text, "", "Attributes:", *fields]) if fields else text

    def __post_init__(self) -> None:
        hints = field_types(type(self))
        for field in dataclasses.fields(cast(Any, self)):
            hint = hints[field.name]
            value = _plain(getattr(self, field.name), hint)
            if not _fits(value, hint, declared_of(field)):
                wanted = _wanted(value, hint, declared_of(field))
                found = type(value).__name__ if isinstance(value, Options) else repr(value)
                raise OptionError(f"{field.name} is {found}: give {wanted}")
            object.__setattr__(self, field.name, value)


def declared_of(field: dataclasses.Field[Any]) -> Declared:
    """What a field declares."""
    found = field.metadata.get(_DECLARED, Declared())
    assert isinstance(found, Declared)
    return found


def unused_in(field: dataclasses.Field[Any], unused: Collection[str]) -> frozenset[str]:
    """The paths of the options that a part of other options lacks.

    Args:
        field: the field of the part.
        unused: paths of the options that the other options lack, such as "match.images".
    """
    start = f"{field.name}."
    below = {path.removeprefix(start) for path in unused if path.startswith(start)}
    return declared_of(field).unused | below


def field_types(kind: type) -> Mapping[str, Any]:
    """The types of a dataclass's fields, by name."""
    return _known_types(kind)


@functools.cache  # called hundreds of times per command line
def _known_types(kind: type) -> Mapping[str, Any]:
    return types.MappingProxyType(typing.get_type_hints(kind))


def members_of(hint: Any) -> tuple[Any, ...]:
    """The members of a union type; for other types, the type itself."""
    if typing.get_origin(hint) in (types.UnionType, typing.Union):
        return typing.get_args(hint)
    return (hint,)


def is_path(members: Collection[Any]) -> bool:
    """Whether any of the types is a path."""
    return any(typing.get_origin(member) is os.PathLike for member in members)


def _plain(value: Any, hint: Any) -> Any:
    """The value, with numbers of other types, such as NumPy's, as int or float.

    Digests and command lines are made from plain numbers only.
    """
    members = members_of(hint)
    for kind in (int, float):
        if kind in members and _is_of(value, kind):
            return kind(value) if abs(value) <= _LARGEST else value  # a float may overflow
    for member in members:
        if typing.get_origin(member) is tuple and isinstance(value, tuple):
            return tuple(_plain(v, typing.get_args(member)[0]) for v in value)
    return value


def _fits(value: Any, hint: Any, declared: Declared) -> bool:
    return any(_fits_one(value, member, declared) for member in members_of(hint))


def _fits_one(value: Any, hint: Any, declared: Declared) -> bool:
    if typing.get_origin(hint) is typing.Literal:
        return isinstance(value, str) and value in typing.get_args(hint)
    if typing.get_origin(hint) is tuple:
        inner = typing.get_args(hint)[0]
        return isinstance(value, tuple) and all(_fits(v, inner, declared) for v in value)
    if not _is_of(value, hint):
        return False
    return hint not in (int, float) or _is_within(value, declared)


def _is_of(value: Any, hint: Any) -> bool:
    """Whether a value has a plain type; a bool does not count as a number."""
    if hint in (int, float):
        wide: Any = Integral if hint is int else Real
        return isinstance(value, wide) and not isinstance(value, bool)
    return isinstance(value, typing.get_origin(hint) or hint)


def _is_within(value: float, declared: Declared) -> bool:
    return (
        abs(value) <= _LARGEST  # false for NaN
        and (declared.least is None or value >= declared.least)
        and (declared.most is None or value <= declared.most)
        and (declared.above is None or value > declared.above)
        and (declared.below is None or value < declared.below)
        and (not declared.among or value in declared.among)
    )


def _wanted(value: Any, hint: Any, declared: Declared) -> str:
    """Describe the values that are accepted in place of `value`."""
    members = members_of(hint)
    first = members[0]
    none = ", or None" if type(None) in members else ""
    if typing.get_origin(first) is typing.Literal:
        return ", ".join(typing.get_args(first)) + none
    if typing.get_origin(first) is tuple:
        inner = typing.get_args(first)[0]
        bounds = _bounds(declared)
        return f"a tuple of {_MANY[inner]}{bounds and f', {bounds} each'}{none}"
    if is_path(members):
        return f"a path{none}"
    if first not in (int, float):
        return _KINDS.get(first, getattr(first, "__name__", str(first))) + none
    bounds = _bounds(declared)
    if not _is_of(value, first):
        return f"{_KINDS[first]}{bounds and f', {bounds}'}{none}"
    if _LARGEST < abs(value) < math.inf:
        bounds = f"{_LARGEST} at most"
    return (bounds or f"a finite {_KINDS[first].removeprefix('a ')}") + none


def _bounds(declared: Declared) -> str:
    """Describe the bounds of a number; empty if there are none."""
    unit, least, most = declared.unit, declared.least, declared.most
    if declared.among:
        *others, last = map(str, declared.among)
        return f"{', '.join(others)} or {last}{unit and f' {unit}'}"
    if least is not None and most is not None:
        return f"{unit and f'{unit} from '}{least} to {most}"
    if least is not None and declared.below is not None:
        return f"{unit and f'{unit} '}from {least} to below {declared.below}"
    if least is not None:
        return f"{least} or more{unit and f' {unit}'}"
    if declared.above is not None:
        return f"{unit or 'a number'} above {declared.above}"
    return ""

"""What a field of options declares beside its type, and the check of its value."""

from __future__ import annotations

import dataclasses
import functools
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

# Key of a field's metadata.
_DECLARED = "declared"
# Whole numbers are 32 bits wide where they are used; squares of others fit, too.
_LARGEST = 2**31 - 1
_KINDS = {bool: "True or False", int: "a whole number", float: "a number", str: "a text"}
_MANY = {int: "whole numbers", str: "texts"}


@dataclass(frozen=True)
class Declared:
    """What a field says beside its type.

    Attributes:
        help: what the value does, a line of any length.
        least: smallest value, or number in a tuple.
        most: largest value.
        above: values are larger than this.
        below: values are smaller than this.
        unit: what numbers count, such as "pixels", for messages.
        among: the only values.
        common: one of the options that most users need.
        spellings: further names on the command line.
        unused: paths of the fields of a part that the options have no use for.
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
) -> _Value:
    """A field of an options dataclass; see `Declared`."""
    declared = Declared(
        help, least, most, above, below, unit, among, common=common, spellings=spellings
    )
    return dataclasses.field(default=default, metadata={_DECLARED: declared})


def part(default: _Value, *, unused: Collection[str] = ()) -> _Value:
    """A field that holds further options.

    Args:
        default: these.
        unused: those among them that have no effect here, "name" or "part.name".
    """
    declared = Declared(unused=frozenset(unused))
    return dataclasses.field(default=default, metadata={_DECLARED: declared})


class Options:
    """Base of the options dataclasses: values that cannot work are refused when one is made.

    Attributes:
        title: what the options are about, as help titles them.
        colmap_prefix: COLMAP's name of the group, as in --ImageReader.camera_model.

    Raises:
        OptionError: a value is of another type, or out of its bounds.
    """

    title: ClassVar[str] = ""
    colmap_prefix: ClassVar[str] = ""

    def __post_init__(self) -> None:
        hints = field_types(type(self))
        for field in dataclasses.fields(cast(Any, self)):
            hint, value = hints[field.name], getattr(self, field.name)
            if not _fits(value, hint, declared_of(field)):
                wanted = _wanted(value, hint, declared_of(field))
                found = type(value).__name__ if isinstance(value, Options) else repr(value)
                raise OptionError(f"{field.name} is {found}: give {wanted}")


def declared_of(field: dataclasses.Field[Any]) -> Declared:
    """What a field declares."""
    found = field.metadata.get(_DECLARED, Declared())
    assert isinstance(found, Declared)
    return found


def field_types(kind: type) -> Mapping[str, Any]:
    """The types of a dataclass's fields, by name."""
    return _known_types(kind)


@functools.cache  # a command line asks some hundred times
def _known_types(kind: type) -> Mapping[str, Any]:
    return types.MappingProxyType(typing.get_type_hints(kind))


def members_of(hint: Any) -> tuple[Any, ...]:
    """The types that a type stands for: those of a union, or itself."""
    if typing.get_origin(hint) in (types.UnionType, typing.Union):
        return typing.get_args(hint)
    return (hint,)


def is_path(members: Collection[Any]) -> bool:
    """Whether paths are among some types."""
    return any(typing.get_origin(member) is os.PathLike for member in members)


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
    """Whether a value is of a plain type; a bool is no number."""
    if hint in (int, float):
        wide: Any = Integral if hint is int else Real
        return isinstance(value, wide) and not isinstance(value, bool)
    return isinstance(value, typing.get_origin(hint) or hint)


def _is_within(value: float, declared: Declared) -> bool:
    return (
        math.isfinite(value)
        and abs(value) <= _LARGEST
        and (declared.least is None or value >= declared.least)
        and (declared.most is None or value <= declared.most)
        and (declared.above is None or value > declared.above)
        and (declared.below is None or value < declared.below)
        and (not declared.among or value in declared.among)
    )


def _wanted(value: Any, hint: Any, declared: Declared) -> str:
    """What to give in place of a value."""
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
    if math.isfinite(value) and abs(value) > _LARGEST:
        bounds = f"{_LARGEST} at most"
    return (bounds or f"a finite {_KINDS[first].removeprefix('a ')}") + none


def _bounds(declared: Declared) -> str:
    """The bounds of a number in words; empty where there are none."""
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

"""Arguments of the functions that other programs call: a wrong one is told by its name."""

from __future__ import annotations

import functools
import inspect
import os
import types
import typing
from collections.abc import Callable, Sequence
from numbers import Integral, Real
from typing import Any, ParamSpec, TypeVar

from colmap_av1.errors import OptionError

_P = ParamSpec("_P")
_R = TypeVar("_R")
# NumPy's numbers are numbers, too.
_NUMBERS: dict[type, type] = {int: Integral, float: Real}


def checks_arguments(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Check paths, options and plain values that a function is given against its annotations.

    The function then raises TypeError for an argument of another type, and OptionError for a path
    that no file can have.
    """
    signature = inspect.signature(function)
    kinds: dict[str, tuple[Any, ...]] = {}

    @functools.wraps(function)
    def checked(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        if not kinds:
            hints = typing.get_type_hints(function)
            kinds.update({name: _members(hints[name]) for name in signature.parameters})
        for name, value in signature.bind(*args, **kwargs).arguments.items():
            _check(function.__name__, name, value, kinds[name])
        return function(*args, **kwargs)

    return checked


def _members(hint: Any) -> tuple[Any, ...]:
    if typing.get_origin(hint) in (types.UnionType, typing.Union):
        return typing.get_args(hint)
    return (hint,)


def _check(function: str, name: str, value: Any, kinds: tuple[Any, ...]) -> None:
    if value is None and type(None) in kinds:
        return
    origins = {typing.get_origin(kind) for kind in kinds} - {None}
    if origins == {os.PathLike, Sequence}:
        several = isinstance(value, Sequence) and not isinstance(value, str | bytes)
        for one in value if several else [value]:
            _check_path(function, name, one)
        return
    if os.PathLike in origins and (len(origins) == 1 or isinstance(value, str | os.PathLike)):
        _check_path(function, name, value)
        return
    if origins:
        return  # functions, sequences and the like
    plain = tuple(kind for kind in kinds if isinstance(kind, type) and kind is not type(None))
    if plain and not isinstance(value, tuple(_NUMBERS.get(kind, kind) for kind in plain)):
        wanted = " or ".join(kind.__name__ for kind in plain)
        raise TypeError(f"{function}: {name} is {_named(value)}: give {wanted}")


def _check_path(function: str, name: str, value: Any) -> None:
    try:
        text = os.fspath(value)
    except TypeError:
        text = None
    if not isinstance(text, str):
        raise TypeError(f"{function}: {name} is {_named(value)}: give a path, str or PathLike")
    if "\0" in text:
        raise OptionError(f"{name} {text!r} is no path, it has a zero byte: give another")


def _named(value: Any) -> str:
    return f"of type {type(value).__name__}"

"""Convert options to words of a command line."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Collection
from typing import Any, cast

from colmap_av1.options.fields import Options, declared_of, field_types, is_path, members_of


def words_of(options: Options) -> list[str]:
    """Convert options to command-line words, without those that have their default value.

    Paths become absolute. Fields without a command-line option are left out.
    """
    return _words(options, type(options)(), frozenset())


def _words(options: Options, default: Options, unused: Collection[str]) -> list[str]:
    words = []
    for field in dataclasses.fields(cast(Any, options)):
        value, usual = getattr(options, field.name), getattr(default, field.name)
        if field.name in unused:
            continue
        if isinstance(value, Options):
            start = f"{field.name}."
            below = {path.removeprefix(start) for path in unused if path.startswith(start)}
            words += _words(value, usual, below | declared_of(field).unused)
        elif value != usual:
            hint = field_types(type(options))[field.name]
            words.append(f"--{field.name}={_spell(value, hint)}")
    return words


def _spell(value: object, hint: object) -> str:
    if value is None:
        return "none"
    if isinstance(value, bool):
        return str(int(value))
    if isinstance(value, tuple):
        return ",".join(map(str, value))
    if is_path(members_of(hint)):
        return os.path.abspath(cast("str | os.PathLike[str]", value))
    return str(value)

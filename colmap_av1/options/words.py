"""Convert options to words of a command line."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Collection
from typing import Any, cast

from colmap_av1.options.fields import Options, field_types, is_path, members_of, unused_in


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
            words += _words(value, usual, unused_in(field, unused))
        elif value != usual:
            hint = field_types(type(options))[field.name]
            if value is not None and is_path(members_of(hint)):
                value = os.path.abspath(value)
            words.append(f"--{field.name}={word_of(value)}")
    return words


def word_of(value: object) -> str:
    """The value of an option as it is written on a command line."""
    if value is None:
        return "none"
    if isinstance(value, bool):
        return str(int(value))
    if isinstance(value, float) and value.is_integer():
        return str(int(value))
    if isinstance(value, tuple):
        return ",".join(map(word_of, value))
    return str(value)

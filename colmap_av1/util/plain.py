"""Convert values to JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping


def json_text(value: object, spell: Callable[[str], str] = str) -> str:
    """A value as the text of a JSON file; see `plain`."""
    return json.dumps(plain(value, spell), indent=1, allow_nan=False) + "\n"


def plain(value: object, spell: Callable[[str], str] = str) -> object:
    """Convert a value for JSON: NaN and infinity become None, keys and paths become strings.

    Args:
        value: dictionaries, sequences, NumPy arrays, numbers, strings, paths.
        spell: applied to strings that are values, not keys.
    """
    if isinstance(value, Mapping):
        return {str(key): plain(item, spell) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item, spell) for item in value]
    if hasattr(value, "tolist"):  # NumPy arrays and numbers
        return plain(value.tolist(), spell)
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, (bool, int)) else spell(str(value))

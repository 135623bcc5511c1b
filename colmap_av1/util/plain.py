"""Values as JSON holds them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping


def plain(value: object, spell: Callable[[str], str] = str) -> object:
    """A value as JSON holds it: NaN and infinity become None, keys and paths become texts.

    Args:
        value: dictionaries, sequences, NumPy's arrays, numbers, texts, paths.
        spell: what becomes of a text that is a value.
    """
    if isinstance(value, Mapping):
        return {str(key): plain(item, spell) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item, spell) for item in value]
    if hasattr(value, "tolist"):  # NumPy's arrays and numbers
        return plain(value.tolist(), spell)
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, (bool, int)) else spell(str(value))

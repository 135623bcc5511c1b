"""One finding in a database."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

Severity = Literal["error", "warning", "note"]


@dataclass(frozen=True)
class Finding:
    """One finding in a database that matters for mapping it.

    Attributes:
        severity: "error": mappers stop or find nothing; "warning": a part is lost, or some
            program stops; "note": nothing is wrong.
        text: one line.
        damage: no program writes such values: the file is damaged, or parts of several are mixed.
    """

    severity: Severity
    text: str
    damage: bool = False


def some(names: Sequence[str], what: str) -> str:
    """A count and an example, such as "3 images (a.png, ...)"."""
    plural = "s" if len(names) > 1 else ""
    # A name may hold anything, line breaks too.
    first = names[0] if names[0].isprintable() and names[0] else repr(names[0])
    return f"{len(names)} {what}{plural} ({first}{', ...' if plural else ''})"

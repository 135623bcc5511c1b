"""Failures are classified by reason, and by whether another attempt may succeed."""

from __future__ import annotations

import errno
import sqlite3

import pytest

from colmap_av1 import BitstreamError, ModelError, NotAv1Error
from colmap_av1.util.failures import failure_of


@pytest.mark.parametrize(
    ("error", "reason", "transient"),
    [
        (OSError(errno.ENOSPC, "no space left", "/disk/x"), "reading or writing", True),
        (OSError(errno.EACCES, "no permission", "/disk/x"), "reading or writing", False),
        (sqlite3.OperationalError("database or disk is full"), "reading or writing", True),
        (MemoryError(), "memory", True),
        (NotAv1Error("x"), "not AV1", False),
        (BitstreamError("x"), "damaged", False),
        (KeyError("x"), "defect", False),
    ],
)
def test_failures_are_classified(error: Exception, reason: str, transient: bool) -> None:
    found = failure_of(error)
    assert (found.reason, found.transient) == (reason, transient)
    wrapped = ModelError("cannot be written")
    wrapped.__cause__ = error
    assert failure_of(wrapped).transient == transient

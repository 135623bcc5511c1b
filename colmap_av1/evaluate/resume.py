"""Results kept in a folder, so that a run that was stopped goes on where it was."""

from __future__ import annotations

import functools
import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import colmap_av1


def kept(folder: Path, key: Any, work: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """What `work` returned, from its last run where that had the same key.

    Args:
        folder: emptied before `work` runs; what it leaves there is kept beside `result.json`.
        key: everything the result depends on; told apart by its `repr`.
        work: returns what JSON can hold.
    """
    path = folder / "result.json"
    name = repr(key)
    if path.is_file():
        try:
            before = json.loads(path.read_text())
        except ValueError:
            before = {}
        if before.get("key") == name:
            result: dict[str, Any] = before["result"]
            return result
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    result = work()
    partial = path.with_suffix(".partial")
    partial.write_text(json.dumps({"key": name, "result": result}, indent=1))
    partial.replace(path)
    return result


def content_of(path: Path) -> str:
    """Digest of a file's content."""
    with path.open("rb") as file:
        digest = hashlib.sha256()
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


@functools.cache
def own_code() -> str:
    """Digest of this package's code but for its metrics: results of other code are not its."""
    root = Path(colmap_av1.__file__).parent
    files = [p for p in root.rglob("*") if p.suffix in (".py", ".so", ".pyd")]
    return hashlib.sha256("".join(content_of(p) for p in sorted(files)).encode()).hexdigest()

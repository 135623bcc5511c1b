"""Stages of a long run that are kept in a folder, so that a later run goes on after them."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from colmap_av1.errors import ModelError, OptionError, cannot_write
from colmap_av1.util.files import only_run, remove_leftovers

_FOLDER = ".stages"


@dataclass(frozen=True)
class Kept:
    """A finished stage.

    Attributes:
        facts: what the stage told, as JSON holds it.
        key: what its result depends on, digested.
        resumed: it was finished by an earlier run.
    """

    facts: dict[str, Any]
    key: str
    resumed: bool


@contextmanager
def open_stages(output: Path, command: str) -> Iterator[Path]:
    """The folder of the stages in an output folder, both made where they are missing.

    Args:
        output: the output folder.
        command: the command whose output it is.

    Raises:
        OptionError: the output folder holds something else, cannot be made, or another run
            works in it.
    """
    stages = output / _FOLDER
    with ExitStack() as running:
        try:
            if output.exists() and not output.is_dir():
                raise OptionError(f"{output}: is a file: give a folder")
            if output.is_dir() and not stages.is_dir() and any(output.iterdir()):
                raise OptionError(
                    f"{output}: is not empty and not the output of an earlier run: give another "
                    "folder"
                )
            stages.mkdir(parents=True, exist_ok=True)
            if not os.access(output, os.W_OK | os.X_OK):
                raise PermissionError(None, "no permission")
            lock = stages / f"{command}.lock"
            other = next((p.stem for p in stages.glob("*.lock") if p != lock), None)
            if other is not None:
                raise OptionError(f"{output}: is the output of {other}: give another folder")
            alone = running.enter_context(only_run(lock))
        except OSError as error:
            raise OptionError(cannot_write(output, error)) from error
        if not alone:
            raise OptionError(
                f"{output}: another run is at work in it: wait for its end, or give another folder"
            )
        remove_leftovers(output)
        yield stages


def run_stage(
    stages: Path,
    name: str,
    depends_on: Sequence[Any],
    *,
    into: Path,
    products: Sequence[str],
    make: Callable[[Path], dict[str, Any]],
) -> Kept:
    """Run a stage, unless an earlier run finished it with the same input.

    What it makes appears under its name when it is complete, never in part.

    Args:
        stages: the folder of the stages.
        name: name of the stage.
        depends_on: everything the result depends on; told apart by its `repr`.
        into: folder that gets the products.
        products: files and folders that the stage makes.
        make: makes the products in the given folder and returns facts that JSON can hold.

    Raises:
        ModelError: something cannot be written.
    """
    key = hashlib.sha256(repr(depends_on).encode()).hexdigest()
    record = stages / f"{name}.json"
    if record.is_file() and all((into / product).exists() for product in products):
        try:
            before = json.loads(record.read_text())
        except ValueError:
            before = {}
        if before.get("key") == key:
            return Kept(before["facts"], key, resumed=True)
    partial = stages / f"{name}.partial"
    try:
        _remove(partial)
        partial.mkdir()
        facts = make(partial)
        record.unlink(missing_ok=True)
        for product in products:
            _remove(into / product)
            (partial / product).replace(into / product)
        text = json.dumps({"key": key, "facts": facts}, indent=1)
        (partial / record.name).write_text(text)
        (partial / record.name).replace(record)
    except OSError as error:
        if error.filename is not None and stages.parent not in Path(error.filename).parents:
            raise  # of what is read
        raise ModelError(
            f"{into}: cannot be written: {error.strerror or error}: the stages before are kept, "
            "run the same command again once that is mended"
        ) from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return Kept(facts, key, resumed=False)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)

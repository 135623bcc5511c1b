"""Stages of a long run that are kept in a folder, so that a later run resumes after them.

A stage's record is written when all it makes is there: a key of what the result depends on, the
result, and the digests of the products. A later run takes over the stage where the key is the
same and the products are as recorded. All else is made again, damaged records and products too.
Files of a user among the products stay.
The key holds options and inputs by their content, and this package's code and version.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import cattrs

from colmap_av1.errors import ModelError, OptionError, cannot_write
from colmap_av1.util.digests import (
    code_digest,
    digest_of,
    file_record,
    is_as_recorded,
    package_version,
)
from colmap_av1.util.files import only_run, remove_leftovers, whole_file
from colmap_av1.util.memory import give_back_free_memory

_FOLDER = ".stages"
WHOLE_PACKAGE = (".",)

_Result = TypeVar("_Result")
_Found_co = TypeVar("_Found_co", covariant=True)


@dataclass(frozen=True)
class Kept(Generic[_Found_co]):
    """A finished stage.

    Attributes:
        result: what the stage found.
        digest: identifies the result and the products: what later stages depend on.
        resumed: an earlier run finished the stage.
    """

    result: _Found_co
    digest: str
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
        for folder in (output, stages):
            remove_leftovers(folder)
        yield stages


def run_stage(
    stages: Path,
    name: str,
    depends_on: Sequence[Any],
    kind: type[_Result],
    *,
    into: Path,
    products: Sequence[str],
    make: Callable[[Path], _Result],
) -> Kept[_Result]:
    """Run a stage, unless an earlier run finished it with the same input.

    What it makes appears under its name when it is complete, never in part; what was there until
    then stays. Only files of an earlier run are replaced.

    Args:
        stages: the folder of the stages.
        name: name of the stage.
        depends_on: everything the result depends on but the code, see `digest_of`.
        kind: the dataclass of the result; its fields are of types that JSON can hold, or such
            dataclasses.
        into: folder that gets the products.
        products: files and folders that the stage makes.
        make: makes the products in the given folder and returns the result.

    Raises:
        ModelError: something cannot be written.
        OptionError: a file of a user is in the way.
    """
    key = _stage_key(depends_on)
    record = stages / f"{name}.json"
    finished = _finished(record, key, into, kind)
    if finished is not None:
        return finished
    partial = stages / f"{name}.partial"
    try:
        _remove(partial)
        partial.mkdir()
        give_back_free_memory()  # what earlier stages had
        result = make(partial)
        made = _put_in_place(record, partial, into, products)
        return _record(record, key, result, kind, into=into, products=made)
    except OSError as error:
        if error.filename is not None and stages.parent not in Path(error.filename).parents:
            raise  # of what is read
        raise ModelError(
            f"{into}: cannot be written: {error.strerror or error}: the stages before are kept, "
            "run the same command again once that is fixed"
        ) from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def run_stage_in(
    folder: Path,
    depends_on: Sequence[Any],
    make: Callable[[], dict[str, Any]],
    *,
    products: Sequence[Path],
    made_by: Sequence[str] = WHOLE_PACKAGE,
    timed: bool = False,
) -> Kept[dict[str, Any]]:
    """Run a stage that has a folder to itself, unless an earlier run finished it.

    What it makes is made in its place, for programs that write down where their output lies.

    Args:
        folder: emptied before the stage is run; gets `result.json` beside what the stage leaves.
        depends_on: everything the result depends on but the code, see `digest_of`.
        make: makes the products and returns a result that JSON can hold.
        products: files and folders that later stages read, in the folder or elsewhere.
        made_by: folders of this package whose code changes the result, see `code_digest`: where
            other programs make it, not those that only make what it depends on.
        timed: the result says how long it took, so that the number of threads counts.

    Raises:
        OSError: something cannot be written.
    """
    key = _stage_key(depends_on, made_by=made_by, timed=timed)
    record = folder / "result.json"
    finished = _finished(record, key, folder, dict[str, Any])
    if finished is not None:
        return finished
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return _record(record, key, make(), dict[str, Any], into=folder, products=products)


def _stage_key(
    depends_on: Sequence[Any], *, made_by: Sequence[str] = WHOLE_PACKAGE, timed: bool = False
) -> str:
    code = [code_digest(*made_by)]
    if tuple(made_by) == WHOLE_PACKAGE:
        code.append(package_version())
    return digest_of([code, *depends_on], timed=timed)


def _finished(record: Path, key: str, into: Path, kind: type[_Result]) -> Kept[_Result] | None:
    """The stage as recorded; None where it is another, or the record or a product is damaged."""
    body = _read_record(record)
    if body is None or body["key"] != key:
        return None
    if not all(is_as_recorded(into / name, file) for name, file in body["files"].items()):
        return None
    return _kept(body, kind, resumed=True)


def _read_record(record: Path) -> dict[str, Any] | None:
    """The record of a stage; None where there is none, or it is damaged."""
    try:
        body = json.loads(record.read_text())
    except (OSError, ValueError, RecursionError):
        return None
    if not isinstance(body, dict) or body.pop("digest", None) != _json_digest(body):
        return None
    return body


def _write_record(record: Path, body: dict[str, Any]) -> None:
    if record.is_dir():
        shutil.rmtree(record)
    with whole_file(record) as partial:
        partial.write_text(json.dumps({**body, "digest": _json_digest(body)}, indent=1))


def _put_in_place(record: Path, made: Path, into: Path, products: Sequence[str]) -> list[Path]:
    """Put products in their places, where those of an earlier run make room; their files there.

    The record lists the files of both until a new one is written, so that a run that is killed
    meanwhile leaves none that the next one takes for a user's.
    """
    body = _read_record(record)
    listed = [] if body is None else body["files"]
    earlier = {
        name
        for name in listed
        if _is_inside(into, name) and any(Path(name).is_relative_to(p) for p in products)
    }
    files = [path.relative_to(made) for product in products for path in _files_of(made / product)]
    new = {path.as_posix() for path in files}
    if body is not None:  # else nothing says whose the files are that have the new ones' names
        theirs = [n for n in new - earlier if _is_inside(into, n) and (into / n).is_file()]
        if theirs:
            raise OptionError(
                f"{into / min(theirs)}: is in the way and not of an earlier run: move it away"
            )
    _write_record(record, {"key": "", "result": None, "files": dict.fromkeys({*listed, *new})})
    for name in sorted(earlier):
        _remove_one(into / name)
        _remove_empty((into / name).parent, into)
    for product in products:
        place = into / product
        if place.is_symlink() or (made / product).is_file():
            _remove_one(place)
        if not place.exists():
            (made / product).replace(place)
    for path in files:
        if (made / path).exists():  # not moved with its folder
            (into / path).parent.mkdir(parents=True, exist_ok=True)
            (made / path).replace(into / path)
    return [into / path for path in files]


def _is_inside(folder: Path, name: str) -> bool:
    """Whether a recorded name leads nowhere else: a record may be of another origin."""
    return (folder / name).parent.resolve().is_relative_to(folder.resolve())


def _remove_one(path: Path) -> None:
    """Remove a file, a link or an empty folder, if it is there."""
    if path.is_dir() and not path.is_symlink():
        path.rmdir()
    else:
        path.unlink(missing_ok=True)


def _remove_empty(folder: Path, root: Path) -> None:
    """Remove a folder and those above it, below a root, that hold nothing."""
    while folder != root and root in folder.parents:
        try:
            folder.rmdir()
        except OSError:
            return
        folder = folder.parent


def remove_products(output: Path, stages: Path) -> None:
    """Remove what the stages of an earlier run made in a folder, and their records.

    Raises:
        OSError: something cannot be removed.
    """
    for record in stages.glob("*.json"):
        files = (_read_record(record) or {"files": {}})["files"]
        for name, file in files.items():
            path = output / name
            if file is not None and _is_inside(output, name) and is_as_recorded(path, file):
                path.unlink()
                _remove_empty(path.parent, output)
    shutil.rmtree(stages)
    _remove_empty(output, output.parent)


def _record(
    record: Path,
    key: str,
    result: _Result,
    kind: type[_Result],
    *,
    into: Path,
    products: Sequence[Path],
) -> Kept[_Result]:
    files = {
        path.relative_to(into).as_posix() if path.is_relative_to(into) else str(path.absolute()): (
            file_record(path)
        )
        for product in products
        for path in _files_of(product)
    }
    # Read back, so that this run goes on from what a later run will read.
    plain = {"key": key, "result": cattrs.unstructure(result), "files": files}
    body = json.loads(json.dumps(plain))
    _write_record(record, body)
    return _kept(body, kind, resumed=False)


def _files_of(product: Path) -> list[Path]:
    if not product.is_dir():
        return [product]
    return sorted(path for path in product.rglob("*") if path.is_file())


def _kept(body: dict[str, Any], kind: type[_Result], *, resumed: bool) -> Kept[_Result]:
    contents = {name: file["digest"] for name, file in body["files"].items()}
    identity = {"key": body["key"], "result": body["result"], "contents": contents}
    return Kept(cattrs.structure(body["result"], kind), _json_digest(identity), resumed)


def _json_digest(body: Any) -> str:
    return hashlib.sha256(json.dumps(body, sort_keys=True).encode()).hexdigest()


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)

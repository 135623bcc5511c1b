"""Keep the finished stages of a long run in a folder, so that a later run resumes after them.

When the products of a stage are complete, a record is written: a key of everything the result
depends on, the result, and the digests of the products. A later run uses a stage with the same key
and unchanged products. All other stages run again, including those with damaged records or
products. A user's files among the products are not touched.

The key is made from the options, the content of the inputs, and this package's code and version.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar, get_args

import cattrs
import numpy as np

from colmap_av1.errors import OptionError, WriteError, writing
from colmap_av1.util.digests import (
    code_digest,
    digest_of,
    file_record,
    is_as_recorded,
    library_versions,
    package_version,
)
from colmap_av1.util.files import STAGES, only_run, remove_leftovers, whole_file
from colmap_av1.util.memory import give_back_free_memory

WHOLE_PACKAGE = (".",)

_Result = TypeVar("_Result")
_Found_co = TypeVar("_Found_co", covariant=True)


def _is_array(kind: Any) -> bool:
    return kind is np.ndarray or getattr(kind, "__origin__", None) is np.ndarray


# Results with fields that JSON lacks: arrays (their type is `NDArray[...]`) and None.
_CONVERTER = cattrs.Converter()
_CONVERTER.register_unstructure_hook_func(_is_array, lambda array: array.tolist())
_CONVERTER.register_structure_hook_func(
    _is_array, lambda values, kind: np.array(values, get_args(get_args(kind)[1])[0])
)
_CONVERTER.register_structure_hook(type(None), lambda value, _: value)


@dataclass(frozen=True)
class Kept(Generic[_Found_co]):
    """A finished stage.

    Attributes:
        result: the result of the stage.
        digest: digest of the result and the products, on which later stages depend.
        resumed: whether an earlier run finished the stage.
    """

    result: _Found_co
    digest: str
    resumed: bool


@contextmanager
def open_stages(output: Path, command: str) -> Iterator[Path]:
    """The folder of the stages in an output folder; both are created if missing.

    Args:
        output: the output folder.
        command: the command that writes the output.

    Raises:
        OptionError: the output folder contains something else, or another run is writing to it.
        WriteError: it cannot be created.
    """
    stages = output / STAGES
    with ExitStack() as running:
        with writing(output):
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
        if not alone:
            raise OptionError(
                f"{output}: another run is writing to it: wait for its end, or give another folder"
            )
        for folder in (output, stages):
            remove_leftovers(folder)
        yield stages


@contextmanager
def writing_stages(output: Path) -> Iterator[None]:
    """Raise `WriteError` if a file in an output cannot be written. Errors of inputs pass.

    Args:
        output: the output of a command that resumes.
    """
    try:
        yield
    except OSError as error:
        if error.filename is not None and output not in Path(error.filename).parents:
            raise  # An input cannot be read.
        raise WriteError(
            f"{output}: cannot be written: {error.strerror or error}: fix that and run the same "
            "command again"
        ) from error


def run_stage(
    stages: Path,
    name: str,
    depends_on: Sequence[Any],
    kind: type[_Result],
    *,
    products: Sequence[str],
    make: Callable[[Path], _Result],
    into: Path | None = None,
) -> Kept[_Result]:
    """Run a stage, unless an earlier run finished it with the same input.

    The products appear under their names only when they are complete. Until then earlier products
    stay. Only files of an earlier run are replaced or removed.

    Args:
        stages: the folder of the stages.
        name: name of the stage.
        depends_on: everything that the result depends on, except the code of this package and
            the versions of libraries, see `digest_of`.
        kind: dataclass of the result; its fields have types that JSON can hold, or are arrays or
            such dataclasses.
        products: files and folders that the stage writes.
        make: writes the products to the given folder and returns the result.
        into: folder for the products; None: the folder of the stages.

    Raises:
        WriteError: a file cannot be written.
        OptionError: a user's file is in the way.
    """
    into = into or stages
    key = _stage_key(depends_on)
    record = stages / f"{name}.json"
    finished = _finished(record, key, into, kind)
    if finished is not None:
        return finished
    partial = stages / f"{name}.partial"
    try:
        with writing_stages(stages.parent):
            _remove(partial)
            partial.mkdir()
            give_back_free_memory()  # memory that earlier stages have freed
            result = make(partial)
            made = _put_in_place(record, partial, into, products)
            return _record(record, key, result, kind, into=into, products=made)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def run_stage_in(
    folder: Path,
    depends_on: Sequence[Any],
    kind: Any,
    make: Callable[[], _Result],
    *,
    products: Sequence[Path],
    made_by: Sequence[str] = WHOLE_PACKAGE,
    timed: bool = False,
) -> Kept[_Result]:
    """Run a stage that has its own folder, unless an earlier run finished it.

    The products are written in their final place, for programs that record the path of their
    output.

    Args:
        folder: emptied before the stage runs; contains `result.json` and the output of the stage.
        depends_on: everything except the code that the result depends on, see `digest_of`.
        kind: type of the result, as in `run_stage`; also None, a tuple or an optional type.
        make: writes the products and returns the result.
        products: files and folders that later stages read, in the folder or elsewhere.
        made_by: folders of this package whose code changes the result, see `code_digest`. If other
            programs make the result, folders whose code only makes their input are not listed.
        timed: the result contains run times, so the number of threads counts.

    Raises:
        OSError: a file cannot be written.
    """
    key = _stage_key(depends_on, made_by=made_by, timed=timed)
    record = folder / "result.json"
    finished: Kept[_Result] | None = _finished(record, key, folder, kind)
    if finished is not None:
        return finished
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return _record(record, key, make(), kind, into=folder, products=products)


def _stage_key(
    depends_on: Sequence[Any], *, made_by: Sequence[str] = WHOLE_PACKAGE, timed: bool = False
) -> str:
    code: list[Any] = [code_digest(*made_by)]
    if tuple(made_by) == WHOLE_PACKAGE:
        code += [package_version(), library_versions()]
    return digest_of([code, *depends_on], timed=timed)


def _finished(record: Path, key: str, into: Path, kind: type[_Result]) -> Kept[_Result] | None:
    """The recorded stage; None if its key differs, or the record or a product is damaged."""
    body = _read_record(record)
    if body is None or body["key"] != key:
        return None
    if not all(is_as_recorded(into / name, file) for name, file in body["files"].items()):
        return None
    with suppress(cattrs.BaseValidationError, TypeError, ValueError, KeyError):
        return _kept(body, kind, resumed=True)
    return None


def _read_record(record: Path) -> dict[str, Any] | None:
    """The record of a stage; None if it is missing or damaged."""
    try:
        body = json.loads(record.read_text())
    except (OSError, ValueError, RecursionError):
        return None
    if not isinstance(body, dict) or body.pop("digest", None) != _json_digest(body):
        return None
    return body if _is_record(body) else None


def _is_record(body: dict[str, Any]) -> bool:
    """Whether a record has the expected fields and types."""
    files = body.get("files")
    return (
        {"key", "result"} <= body.keys()
        and isinstance(files, dict)
        and not any("\0" in name for name in files)
        and all(file is None or _is_file_record(file) for file in files.values())
    )


def _is_file_record(file: object) -> bool:
    return isinstance(file, dict) and file.keys() == {"bytes", "times", "digest"}


def _write_record(record: Path, body: dict[str, Any]) -> None:
    if record.is_dir():
        shutil.rmtree(record)
    with whole_file(record) as partial:
        partial.write_text(json.dumps({**body, "digest": _json_digest(body)}, indent=1))


def _put_in_place(record: Path, made: Path, into: Path, products: Sequence[str]) -> list[Path]:
    """Move products into place, remove those of an earlier run, and return the new files.

    Until the new record is written, the old record lists the files of both runs. If this run is
    killed, the next run therefore knows that none of the files is a user's.
    """
    body = _read_record(record)
    listed = [] if body is None else body["files"]
    earlier = {name for name in listed if _is_inside(into, name)}
    files = [path.relative_to(made) for product in products for path in _files_of(made / product)]
    new = {path.as_posix() for path in files}
    if body is not None:  # without a record it is unknown whose the existing files are
        theirs = [n for n in new - earlier if _is_inside(into, n) and (into / n).is_file()]
        if theirs:
            raise OptionError(
                f"{into / min(theirs)}: is in the way and not from an earlier run: move it away"
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
        if (made / path).exists():  # it was not moved with its folder
            (into / path).parent.mkdir(parents=True, exist_ok=True)
            (made / path).replace(into / path)
    return [into / path for path in files]


def _is_inside(folder: Path, name: str) -> bool:
    """Whether a recorded name lies inside the folder; a manipulated record may lead elsewhere."""
    return (folder / name).parent.resolve().is_relative_to(folder.resolve())


def _remove_one(path: Path) -> None:
    """Remove a file, a link or an empty folder, if it exists."""
    if path.is_dir() and not path.is_symlink():
        path.rmdir()
    else:
        path.unlink(missing_ok=True)


def _remove_empty(folder: Path, root: Path) -> None:
    """Remove a folder and its parents below a root, as far as they are empty."""
    while folder != root and root in folder.parents:
        try:
            folder.rmdir()
        except OSError:
            return
        folder = folder.parent


def remove_products(output: Path, stages: Path) -> None:
    """Remove the products of the stages of an earlier run from a folder, and their records.

    Raises:
        OSError: a file cannot be removed.
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
    # The record is parsed again, so that this run continues with the values a later run will read.
    plain = {"key": key, "result": _CONVERTER.unstructure(result), "files": files}
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
    return Kept(_CONVERTER.structure(body["result"], kind), _json_digest(identity), resumed)


def _json_digest(body: Any) -> str:
    return hashlib.sha256(json.dumps(body, sort_keys=True).encode()).hexdigest()


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)

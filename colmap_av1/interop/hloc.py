"""Export and import of features and matches in hloc's files.

The layout is that of hloc (Sarlin et al., "From Coarse to Fine: Robust Hierarchical
Localization at Large Scale", CVPR 2019; https://github.com/cvg/Hierarchical-Localization):
`extract_features.py` and `match_features.py` write it, `utils/io.py` reads it. In hloc, pixel
centres have integer coordinates; it adds 0.5 when it writes a COLMAP database.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from colmap_av1.database.file import is_new, open_unaltered
from colmap_av1.database.reading import image_ids_from_pair_id, matches_from_row, read_keypoints
from colmap_av1.errors import DatabaseError, HlocError, writing
from colmap_av1.options import ExportOptions
from colmap_av1.util.arrays import Ints
from colmap_av1.util.files import check_new_file, remove_leftovers, whole_file
from colmap_av1.util.hdf5 import new_hdf5
from colmap_av1.util.progress import Progress, no_progress

FEATURES, MATCHES, PAIRS = "features.h5", "matches.h5", "pairs.txt"

# Separator of the two image names of a pair. Nested groups use the first; files of hloc's first
# versions have one group for both names, with the second.
_SEPARATOR, _OLD_SEPARATOR = "/", "_"
_NO_MATCH = -1
# Upper bound on the compression ratio of HDF5's filters, which zeros reach.
_DENSEST = 1100
# Exceptions that h5py raises for a damaged file.
_HDF5_ERRORS = (OSError, RuntimeError, KeyError, ValueError, TypeError, OverflowError, MemoryError)
# Writes a dataset, by its name, to an open file.
_Write = Callable[..., h5py.Dataset]


@dataclass(frozen=True)
class HlocMatches:
    """Features and matches of hloc's files, as plain arrays.

    Attributes:
        names: names of the images, in alphabetical order.
        sizes: int64 [n, 2] width and height of each image in pixels; 0 if not stored.
        keypoints: float32 [k, 2] for each image, positions in pixels (x right, y down), origin
            at the top-left corner: the first pixel's centre is (0.5, 0.5), as in COLMAP.
        pairs: int32 [m, 2] indices of images.
        matches: uint32 [k, 2] for each pair, indices of matching keypoints.
        scores: float32 [k] for each pair, the score of each match; 1 if not stored.
    """

    names: list[str]
    sizes: Ints
    keypoints: list[NDArray[np.float32]]
    pairs: NDArray[np.int32]
    matches: list[NDArray[np.uint32]]
    scores: list[NDArray[np.float32]]


def export_hloc(
    database: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    options: ExportOptions = ExportOptions(),
    progress: Progress = no_progress,
    overwrite: bool = False,
) -> tuple[int, int]:
    """Export keypoints and matches of a COLMAP database to hloc's files.

    `features.h5` has a group for each image, named after it, with `keypoints` and
    `image_size`. `matches.h5` has a group for each pair. Its `matches0` gives, for each keypoint of
    the first image, the index of the matching keypoint of the second image or -1;
    `matching_scores0` is 1 for each match. `pairs.txt` lists the pairs. The database is not
    changed, and the files appear only when all of them are complete.

    Args:
        database: the database file.
        output: folder of the files; created if it is missing.
        options: which matches are written.
        progress: called with the stage's name, the number of items done and their total.
        overwrite: replace existing files of these names.

    Returns:
        The numbers of images and of pairs.

    Raises:
        DatabaseError: the file is missing, unreadable, not a COLMAP database, has no keypoints, or
            holds something that hloc's layout cannot represent.
        OptionError: a file exists and `overwrite` is not set.
        WriteError: the folder cannot be written.

    Examples:
        >>> from colmap_av1 import export_hloc
        >>> export_hloc("my.db", "my_hloc")
        (10, 45)
    """
    path, folder = Path(database), Path(output)
    if is_new(path):
        raise DatabaseError(f"{path}: no such file, or empty: give the path of a COLMAP database")
    for name in (FEATURES, MATCHES, PAIRS):
        check_new_file(folder / name, [path], overwrite=overwrite)
    with open_unaltered(path) as connection:
        names = dict(connection.execute("SELECT image_id, name FROM images").fetchall())
        _check_names(path, sorted(names.values()))
        with _complete_files(folder) as (features, matches, pairs):
            counts = _write_features(connection, path, features, progress)
            if not any(counts.values()):
                raise DatabaseError(f"{path}: has no keypoints: match its images first")
            num_pairs = _write_pairs(
                connection, path, matches, pairs, names=names, counts=counts,
                options=options, progress=progress,
            )  # fmt: skip
    return len(counts), num_pairs


def _check_names(path: Path, names: Sequence[str]) -> None:
    seen: dict[str, str] = {}
    for name in names:
        if len(name.split()) != 1:
            raise DatabaseError(
                f"{path}: image name {name!r} has a space, which hloc's pairs.txt cannot "
                "represent: rename the image"
            )
        other = seen.setdefault(_pair_part(name), name)
        if other != name:
            raise DatabaseError(
                f"{path}: hloc cannot distinguish images {other!r} and {name!r} in its pairs: "
                "rename one"
            )


def _pair_part(name: str) -> str:
    """An image's name as hloc writes it in the name of a pair."""
    return name.replace("/", "-")


@contextlib.contextmanager
def _complete_files(folder: Path) -> Iterator[tuple[_Write, _Write, Any]]:
    """Open the three files for writing; they appear under their names only if all succeed."""
    made = [parent for parent in (folder, *folder.parents) if not parent.exists()]
    names = (FEATURES, MATCHES, PAIRS)
    complete = False
    try:
        with writing(folder), contextlib.ExitStack() as files:
            folder.mkdir(parents=True, exist_ok=True)
            for name in names:
                remove_leftovers(folder, name)
            partial = [files.enter_context(whole_file(folder / name)) for name in names]
            with (
                new_hdf5(partial[0]) as features,
                new_hdf5(partial[1]) as matches,
                open(partial[2], "w", encoding="utf-8", newline="\n") as pairs,
            ):
                yield features, matches, pairs
        complete = True
    finally:
        if not complete:
            with contextlib.suppress(OSError):
                for parent in made:
                    parent.rmdir()


def _write_features(
    connection: Any, path: Path, write: _Write, progress: Progress
) -> dict[int, int]:
    """Write all images; returns the number of keypoints of each image, by its id."""
    rows = connection.execute(
        "SELECT image_id, name, COALESCE(width, 0), COALESCE(height, 0) FROM images "
        "LEFT JOIN cameras USING (camera_id) ORDER BY name"
    ).fetchall()
    counts = {}
    for done, (image_id, name, width, height) in enumerate(rows, 1):
        xy = read_keypoints(connection, path, image_id)[:, :2]
        counts[image_id] = len(xy)
        write(f"{name}/keypoints", _to_hloc(xy)).attrs["uncertainty"] = 1.0
        write(f"{name}/image_size", np.array([width, height], dtype=np.int64))
        progress("images", done, len(rows))
    return counts


def _to_hloc(xy: NDArray[np.float32]) -> NDArray[Any]:
    """Positions in hloc's convention, which convert back to exactly the same ones.

    They are float32 unless that would lose precision, close to the left or top edge.
    """
    half = np.float32(0.5)
    moved: NDArray[Any] = xy - half
    if not np.array_equal(moved + half, xy):
        moved = xy.astype(np.float64) - 0.5
    return moved


def _write_pairs(
    connection: Any,
    path: Path,
    write: _Write,
    pairs: Any,
    *,
    names: dict[int, str],
    counts: dict[int, int],
    options: ExportOptions,
    progress: Progress,
) -> int:
    table = "two_view_geometries" if options.verified else "matches"
    pair_ids = connection.execute(
        f"SELECT pair_id FROM {table} WHERE rows > 0 ORDER BY pair_id"
    ).fetchall()
    for done, (pair_id,) in enumerate(pair_ids, 1):
        i, j = image_ids_from_pair_id(pair_id)
        num_rows, data = connection.execute(
            f"SELECT rows, data FROM {table} WHERE pair_id = ?", (pair_id,)
        ).fetchone()
        found = matches_from_row(path, pair_id, num_rows, data)
        if (found >= [counts.get(i, 0), counts.get(j, 0)]).any():
            raise DatabaseError(
                f"{path}: images {i} and {j} match keypoints that do not exist: "
                "run 'colmap-av1 check' for a full list of problems"
            )
        if len(np.unique(found[:, 0])) != len(found):
            raise DatabaseError(
                f"{path}: a keypoint of {names[i]!r} matches several of {names[j]!r}, which "
                "hloc's layout cannot represent: match these images again"
            )
        narrow = counts[j] <= np.iinfo(np.int16).max
        matches0 = np.full(counts[i], _NO_MATCH, dtype=np.int16 if narrow else np.int32)
        matches0[found[:, 0]] = found[:, 1]
        group = f"{_pair_part(names[i])}{_SEPARATOR}{_pair_part(names[j])}"
        write(f"{group}/matches0", matches0)
        write(f"{group}/matching_scores0", (matches0 != _NO_MATCH).astype(np.float16))
        pairs.write(f"{names[i]} {names[j]}\n")
        progress("pairs", done, len(pair_ids))
    return len(pair_ids)


def read_hloc(features: str | os.PathLike[str], matches: str | os.PathLike[str]) -> HlocMatches:
    """Read features and matches from files in hloc's layout.

    The pair names of current and of the first versions of hloc are supported. A pair that is
    stored in both directions is read once, in the alphabetical order of the names.

    Args:
        features: file with `keypoints` in the group of each image.
        matches: file with `matches0` in the group of each pair.

    Raises:
        HlocError: a file is missing, is not an HDF5 file, has no keypoints or no matches, or the
            pairs do not fit the images.

    Examples:
        >>> from colmap_av1 import read_hloc
        >>> found = read_hloc("my_hloc/features.h5", "my_hloc/matches.h5")
        >>> i, j = found.pairs[0]
        >>> found.names[i], found.names[j]
        ('frame_000000.png', 'frame_000006.png')
        >>> in_i, in_j = found.matches[0].T
        >>> found.keypoints[i][in_i].shape == found.keypoints[j][in_j].shape
        True
    """
    features, matches = Path(features), Path(matches)
    with _open_hloc(features) as file:
        names = sorted(_groups_with(file, "keypoints"))
        if not names:
            raise HlocError(f"{features}: has no keypoints: give the features file of hloc")
        keypoints = [_from_hloc(features, name, file[name]["keypoints"]) for name in names]
        sizes = np.array([_size_of(features, name, file[name]) for name in names], dtype=np.int64)
    rows: dict[tuple[int, int], tuple[NDArray[np.uint32], NDArray[np.float32]]] = {}
    with _open_hloc(matches) as file:
        index = _index_of_pair_parts(features, names)
        groups = sorted(_groups_with(file, "matches0"))
        if not groups:
            raise HlocError(f"{matches}: has no matches: give the matches file of hloc")
        for group in groups:
            i, j = _split_pair(matches, group, index)
            if (j, i) in rows:
                continue
            counts = (len(keypoints[i]), len(keypoints[j]))
            rows[i, j] = _read_pair(matches, group, file[group], counts)
    return HlocMatches(
        names=names,
        sizes=sizes,
        keypoints=keypoints,
        pairs=np.array(sorted(rows), dtype=np.int32).reshape(-1, 2),
        matches=[rows[pair][0] for pair in sorted(rows)],
        scores=[rows[pair][1] for pair in sorted(rows)],
    )


@contextlib.contextmanager
def _open_hloc(path: Path) -> Iterator[h5py.File]:
    if not path.is_file():
        raise HlocError(f"{path}: no such file: give a .h5 file of hloc")
    try:
        with h5py.File(path, "r", libver="latest") as file:
            yield file
    except PermissionError as error:
        raise HlocError(f"{path}: permission denied: change its permissions") from error
    except _HDF5_ERRORS as error:
        raise HlocError(f"{path}: not an HDF5 file, or damaged: create it again") from error


def _values(path: Path, group: h5py.Group, name: str) -> NDArray[Any]:
    """A numeric dataset of a group; refused if its declared size is impossible for the file."""
    dataset = group[name]
    if not isinstance(dataset, h5py.Dataset) or dataset.dtype.kind not in "fiu":
        raise HlocError(f"{path}: '{name}' of {group.name!r} is not numeric: create it again")
    # A damaged or malicious file can declare any size, or refer to another file's content.
    held = dataset.id.get_storage_size() * _DENSEST
    if dataset.nbytes > held or dataset.is_virtual or dataset.external:
        raise HlocError(
            f"{path}: '{name}' of {group.name!r} declares {dataset.nbytes} bytes, which the file "
            "does not hold: create it again"
        )
    return np.asarray(dataset[()])


def _groups_with(file: h5py.File, dataset: str) -> list[str]:
    """Names of the groups that hold a dataset of the given name."""
    found: list[str] = []

    def visit(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and name.endswith(f"/{dataset}"):
            found.append(name[: -len(dataset) - 1])

    file.visititems(visit)
    return found


def _size_of(path: Path, name: str, group: h5py.Group) -> tuple[int, int]:
    """Width and height of an image; 0 if not stored."""
    if "image_size" not in group:
        return (0, 0)
    size = _values(path, group, "image_size")
    if size.shape != (2,) or not ((size >= 0) & (size <= np.iinfo(np.int32).max)).all():
        raise HlocError(
            f"{path}: the image_size of {name!r} is not a width and height: create it again"
        )
    return int(size[0]), int(size[1])


def _from_hloc(path: Path, name: str, dataset: h5py.Dataset) -> NDArray[np.float32]:
    if dataset.ndim != 2 or dataset.shape[1] < 2 or dataset.dtype.kind not in "fiu":
        raise HlocError(
            f"{path}: the keypoints of {name!r} are {dataset.dtype} {list(dataset.shape)}, not "
            "rows of x and y: give the features file of hloc"
        )
    # hloc stores half precision: convert before adding, to keep the fraction.
    xy = _values(path, dataset.parent, "keypoints")[:, :2].astype(np.float64) + 0.5
    found = xy.astype(np.float32)
    if not np.isfinite(found).all():
        raise HlocError(
            f"{path}: image {name!r} has keypoints that are not finite numbers: extract its "
            "features again"
        )
    return found


def _index_of_pair_parts(path: Path, names: Sequence[str]) -> dict[str, int]:
    index: dict[str, int] = {}
    for i, name in enumerate(names):
        other = index.setdefault(_pair_part(name), i)
        if other != i:
            raise HlocError(
                f"{path}: images {names[other]!r} and {name!r} have the same name in pairs: "
                "rename one"
            )
    return index


def _split_pair(path: Path, group: str, index: dict[str, int]) -> tuple[int, int]:
    """Indices of the two images that the name of a pair's group refers to."""
    splits = []
    for separator in (_SEPARATOR, _OLD_SEPARATOR):
        words = group.split(separator)
        for k in range(1, len(words)):
            ends = separator.join(words[:k]), separator.join(words[k:])
            if ends[0] in index and ends[1] in index:
                splits.append((index[ends[0]], index[ends[1]]))
    if len(splits) != 1:
        fault = "names no two images" if not splits else "is ambiguous for the images"
        raise HlocError(f"{path}: pair {group!r} {fault} of the features file: match it again")
    return splits[0]


def _read_pair(
    path: Path, name: str, group: h5py.Group, counts: tuple[int, int]
) -> tuple[NDArray[np.uint32], NDArray[np.float32]]:
    matches0 = _values(path, group, "matches0")
    if matches0.shape != (counts[0],) or matches0.dtype.kind not in "iu":
        raise HlocError(
            f"{path}: pair {name!r} has {matches0.dtype} {list(matches0.shape)} matches for "
            f"{counts[0]} keypoints: match it again"
        )
    first = np.flatnonzero(matches0 != _NO_MATCH)
    second = matches0[first].astype(np.int64)
    if np.any((second < 0) | (second >= counts[1])):
        raise HlocError(
            f"{path}: pair {name!r} matches keypoints that do not exist: match it again"
        )
    scores = np.ones(len(first), dtype=np.float32)
    if "matching_scores0" in group:
        stored = _values(path, group, "matching_scores0")
        if stored.shape != matches0.shape:
            raise HlocError(
                f"{path}: pair {name!r} has {list(stored.shape)} scores for {len(matches0)} "
                "matches: match it again"
            )
        scores = stored[first].astype(np.float32)
    return np.stack([first, second], axis=1).astype(np.uint32), scores

"""Front-ends that fill a COLMAP database, behind one interface: images or video in, rows out."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import pycolmap

from colmap_av1.database.hloc import HlocMatches, read_hloc
from colmap_av1.errors import EvaluationError, HlocError, OptionError
from colmap_av1.evaluate.frontends.footage import Footage, frame_list
from colmap_av1.evaluate.frontends.learned import PROGRAM, extract_and_match
from colmap_av1.evaluate.frontends.measure import run_measured
from colmap_av1.evaluate.resume import content_of, kept, own_code
from colmap_av1.images.camera import make_camera
from colmap_av1.match import match
from colmap_av1.options import (
    ImageOptions,
    LearnedOptions,
    MatchOptions,
)
from colmap_av1.util.progress import Clock

Preset = Literal["sparse", "default", "dense"]


@dataclass(frozen=True)
class FrontendRun:
    """A database and what it took to fill it.

    Attributes:
        name: the front-end.
        database: the COLMAP database.
        seconds: wall time of each stage.
        cpu_seconds: CPU time of all stages together.
        peak_memory: largest resident memory in bytes; None where the system does not tell.
    """

    name: str
    database: Path
    seconds: dict[str, float]
    cpu_seconds: float
    peak_memory: int | None


@dataclass(frozen=True)
class Frontend:
    """One way to fill a database.

    Attributes:
        run: fills the given database, which does not exist yet, from the footage, and returns
            the wall time of each stage. Called in a process of its own.
        depends_on: what a result depends on beside name, video, frames and camera.
    """

    run: Callable[[Footage, Path], dict[str, float]]
    depends_on: Callable[[Footage], tuple[str, ...]]


def run_frontend(
    name: str, footage: Footage, folder: Path, frontend: Frontend | None = None
) -> FrontendRun:
    """Fill a database and measure what it takes; a finished run is not repeated.

    Args:
        name: one of FRONTENDS, or the name of `frontend`.
        footage: video and images.
        folder: gets `database.db`, `log.txt` and the figures.
        frontend: the front-end, where it is none of FRONTENDS.

    Raises:
        OptionError: there is no such front-end.
        ColmapAv1Error: the front-end refuses the footage.
        EvaluationError: it failed.
    """
    if frontend is None:
        if name not in FRONTENDS:
            raise OptionError(f"front-end '{name}': give one of {', '.join(FRONTENDS)}")
        frontend = FRONTENDS[name]
    run = frontend.run
    database = folder / "database.db"

    def work() -> dict[str, Any]:
        measured = run_measured(run, footage, database, log=folder / "log.txt")
        return {
            "seconds": measured.result,
            "cpu_seconds": measured.cpu_seconds,
            "peak_memory": measured.peak_memory,
        }

    camera = replace(footage.camera, camera_model=_camera_model(footage))
    given = (content_of(footage.video), footage.frames, camera)
    result = kept(folder, (name, *given, *frontend.depends_on(footage)), work)
    if not database.is_file():
        raise EvaluationError(f"{folder}: its database is gone: remove the folder, run again")
    return FrontendRun(name, database, **result)


def _match(options: MatchOptions, footage: Footage, database: Path) -> dict[str, float]:
    images = ImageOptions(frame_list=frame_list(footage, database.with_name("frames.txt")))
    options = replace(options, camera=footage.camera, images=images, on_existing="error")
    folder = footage.image_path if footage.existed else None
    return match(database, footage.video, image_path=folder, options=options).seconds


def _camera_model(footage: Footage) -> str:
    """COLMAP's name of the camera model of images whose focal length no front-end tells."""
    return str(make_camera(footage.camera, *footage.size, footage.pixel_aspect).model_name)


def _list_images(footage: Footage, database: Path) -> None:
    """Make a database of the images, as COLMAP does."""
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = _camera_model(footage)
    reader.camera_params = footage.camera.camera_params or ""
    pycolmap.Database.open(database).close()
    # Threads of the extraction would number the images in the order in which they finish.
    mode = pycolmap.CameraMode.SINGLE
    pycolmap.import_images(
        database, footage.image_path, mode, image_names=footage.names, options=reader
    )


def _sift(pairing: Callable[[Path], None], footage: Footage, database: Path) -> dict[str, float]:
    clock = Clock()
    pycolmap.set_random_seed(0)
    _list_images(footage, database)
    with clock.measure("extraction"):
        pycolmap.extract_features(database, footage.image_path, footage.names)
    with clock.measure("matching"):
        pairing(database)
    return clock.seconds


def _learned(
    features: str, options: LearnedOptions, footage: Footage, database: Path
) -> dict[str, float]:
    files = database.with_name("features.h5"), database.with_name("matches.h5")
    names = footage.names[:: options.learned_every]
    seconds = extract_and_match(features, footage.image_path, names, files, options)
    return {**seconds, **_import(files, names, footage, database)}


def _import_all(files: tuple[Path, Path], footage: Footage, database: Path) -> dict[str, float]:
    return _import(files, footage.names, footage, database)


def _import(
    files: tuple[Path, Path], names: Sequence[str], footage: Footage, database: Path
) -> dict[str, float]:
    """Fill a database from files in hloc's layout, which hold the named images at least."""
    clock = Clock()
    pycolmap.set_random_seed(0)
    with clock.measure("import"):
        found = read_hloc(*files)
        missing = next((name for name in names if name not in found.names), None)
        if missing is not None:
            raise HlocError(
                f"{files[0]}: lacks image '{missing}': extract the features of the images in "
                f"{footage.image_path}"
            )
        _list_images(footage, database)
        pairs = _write_hloc(found, set(names), database)
    with clock.measure("verification"):
        listing = database.with_name("pairs.txt")
        listing.write_text("".join(f"{a} {b}\n" for a, b in pairs))
        pycolmap.verify_matches(database, listing)
    return clock.seconds


def _write_hloc(found: HlocMatches, names: set[str], database: Path) -> list[tuple[str, str]]:
    """Write keypoints and matches of some images; returns the pairs."""
    pairs = []
    with pycolmap.Database.open(database) as rows:
        ids = {image.name: image.image_id for image in rows.read_all_images()}
        for name, xy in zip(found.names, found.keypoints, strict=True):
            if name in names:
                rows.write_keypoints(ids[name], xy)
        for (i, j), between in zip(found.pairs, found.matches, strict=True):
            pair = found.names[i], found.names[j]
            if names.issuperset(pair):
                rows.write_matches(ids[pair[0]], ids[pair[1]], between)
                pairs.append(pair)
    return pairs


def own_frontend(
    refine: Literal["none", "lk"], preset: Preset, options: MatchOptions | None = None
) -> Frontend:
    """This package's `match`, with the given refinement and preset in some options."""
    options = options if options is not None else MatchOptions()
    given = replace(
        options,
        refine=replace(options.refine, refine=refine),
        density=replace(options.density, preset=preset),
    )
    return Frontend(partial(_match, given), lambda _: (repr(given), own_code()))


def _sift_frontend(pairing: Callable[[Path], None]) -> Frontend:
    return Frontend(
        partial(_sift, pairing), lambda footage: (pycolmap.__version__, _content_of_images(footage))
    )


def learned_frontend(features: str, options: LearnedOptions | None = None) -> Frontend:
    """Learned features and LightGlue, see `learned`."""
    given = options if options is not None else LearnedOptions()
    return Frontend(
        partial(_learned, features, given),
        lambda footage: (
            repr(given),
            content_of(PROGRAM),
            pycolmap.__version__,
            _content_of_images(footage),
        ),
    )


def imported_frontend(features: Path, matches: Path) -> Frontend:
    """What other programs wrote in hloc's layout, verified by COLMAP."""
    return Frontend(
        partial(_import_all, (features, matches)),
        lambda footage: (
            *(content_of(path) if path.is_file() else None for path in (features, matches)),
            pycolmap.__version__,
            _content_of_images(footage),
        ),
    )


def _content_of_images(footage: Footage) -> str:
    digests = [content_of(footage.image_path / name) for name in footage.names]
    return hashlib.sha256("".join(digests).encode()).hexdigest()


def _pair_sequentially(database: Path) -> None:
    pycolmap.match_sequential(database)


def _pair_exhaustively(database: Path) -> None:
    pycolmap.match_exhaustive(database)


def make_frontends(
    match: MatchOptions | None = None, learned: LearnedOptions | None = None
) -> dict[str, Frontend]:
    """All front-ends by their names.

    Args:
        match: options of this package's; refinement and preset are those of the name.
        learned: options of the learned ones.
    """
    return {
        # What a mapper gets from the bitstream alone; `-refined` after a look at the pictures.
        "av1": own_frontend("none", "default", match),
        "av1-sparse": own_frontend("none", "sparse", match),
        "av1-dense": own_frontend("none", "dense", match),
        "av1-refined": own_frontend("lk", "default", match),
        "av1-refined-sparse": own_frontend("lk", "sparse", match),
        "av1-refined-dense": own_frontend("lk", "dense", match),
        "sift-sequential": _sift_frontend(_pair_sequentially),
        "sift-exhaustive": _sift_frontend(_pair_exhaustively),
        "disk-lightglue": learned_frontend("disk", learned),
        "aliked-lightglue": learned_frontend("aliked", learned),
    }


FRONTENDS = make_frontends()

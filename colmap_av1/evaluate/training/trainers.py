"""Running trainers of 3D Gaussians on the model of a front-end, and measuring their renderings."""

from __future__ import annotations

import csv
import math
import os
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy  # noqa: F401 - before pycolmap: the other order breaks writing PNG files later
import pycolmap

from colmap_av1.errors import EvaluationError
from colmap_av1.evaluate.frontends.measure import run_measured
from colmap_av1.evaluate.metrics.renderings import RenderingMetrics, rendering_metrics
from colmap_av1.evaluate.programs import check_packages
from colmap_av1.evaluate.training.splatting import Milestone, split_images, write_scene
from colmap_av1.geometry.colmap_model import model_points, posed_images, read_model, write_model
from colmap_av1.images.names import natural_key
from colmap_av1.options.compare import GSPLAT, words_of_trainer
from colmap_av1.splats.gaussians import write_model_gaussians
from colmap_av1.util.digests import file_digest
from colmap_av1.util.processes import bound_group
from colmap_av1.util.stages import run_stage_in
from colmap_av1.util.texts import excerpt

# Only changes of this code affect the results of a training. Changes elsewhere in the package do
# not repeat trainings.
_CODE = ("evaluate/training", "evaluate/metrics")
# The program of the trainer gsplat.
_PROGRAM = Path(__file__).with_name("train_gaussians.py")
# File with the training times of milestones, in the folder of the renderings.
_TIMES = "times.csv"
# Number of characters that a message shows of a program's last line.
_MOST_SHOWN = 200
_PICTURES = {".png", ".jpg", ".jpeg"}


@dataclass(frozen=True)
class Split:
    """A model with undistorted images, complete and split into training and test images.

    Attributes:
        whole: folder with all images in `images/` and the model in `sparse/0/`.
        train: the same with the training images, the even ones in the order of their names.
        test: the same with the test images.
    """

    whole: Path
    train: Path
    test: Path

    @property
    def references(self) -> list[Path]:
        """The photographs of the test views, in the order of their names."""
        return sorted(path for path in (self.test / "images").rglob("*") if path.is_file())


@dataclass(frozen=True)
class Training:
    """Result of training 3D Gaussians on a model.

    Attributes:
        seconds: wall time of the training.
        states: milestones of the training, the last at its end; empty for commands without
            `{milestones}`.
        names: names of the test images.
        references: the photograph of each test image.
        renders: the rendering of each test image.
        metrics: metrics of the renderings.
    """

    seconds: float
    states: tuple[Milestone, ...]
    names: list[str]
    references: list[Path]
    renders: list[Path]
    metrics: RenderingMetrics


@dataclass(frozen=True)
class _Trained:
    """What is kept of a training: the wall time of its command, and its milestones."""

    seconds: float
    states: tuple[Milestone, ...]


def check_trainer(trainer: str) -> None:
    """Refuse a trainer that cannot run.

    Raises:
        EvaluationError: a package that gsplat needs is missing, or the program does not exist.
    """
    if trainer == GSPLAT:
        check_packages("the trainer gsplat", ("torch", "gsplat", "pytorch_msssim"), "splatting")
        return
    program = words_of_trainer(trainer)[0]
    if "{" not in program and shutil.which(program) is None:
        raise EvaluationError(
            f"trainer '{trainer}': program {program} not found: install it, or give its path"
        )


def write_split(model: Path, image_path: Path, folder: Path) -> Split:
    """Undistort the images of a model and split them for training and test.

    Both halves have all points, with the observations of their own images only.

    Args:
        model: folder of the model.
        image_path: folder of its images.
        folder: gets `data/`, `train/` and `test/`; existing ones of the same model are kept.

    Raises:
        ModelError: the model cannot be read.
        EvaluationError: the images cannot be undistorted, or there are fewer than two.
    """
    split = Split(folder / "data", folder / "train", folder / "test")
    registered = sorted(posed_images(read_model(model)))
    if len(registered) < 2:
        raise EvaluationError(
            f"{model}: one image cannot be split for training and test: give a larger model"
        )

    def make() -> None:
        run_measured(_undistort, model, image_path, split.whole, registered, log=folder / "log.txt")
        halves = split_images(registered)
        for part, names in zip((split.train, split.test), halves, strict=True):
            (part / "sparse" / "0").mkdir(parents=True)
            for name in names:
                target = part / "images" / name
                target.parent.mkdir(parents=True, exist_ok=True)
                _link(split.whole / "images" / name, target)
            _write_part(split.whole / "sparse" / "0", part / "sparse" / "0", set(names))

    files = [*sorted(model.glob("*.bin")), *(image_path / name for name in registered)]
    given = ([file_digest(file) for file in files], pycolmap.__version__)
    run_stage_in(folder, given, None, make, products=[split.whole, split.train, split.test])
    return split


def train(
    trainer: str,
    split: Split,
    folder: Path,
    *,
    name: str,
    iterations: int,
    milestones: Sequence[int],
) -> Training:
    """Train 3D Gaussians and measure their renderings; a finished training is not repeated.

    Args:
        trainer: "gsplat", or a command with placeholders, see `words_of_trainer`:

            - `{data}` and `{test}`: folders with the training and the test images,
            - `{gaussians}`: file of initial Gaussians, from the points and the training images,
            - `{output}`: an empty folder,
            - `{renders}`: folder for the renderings of the test images,
            - `{iterations}`: number of iterations,
            - `{milestones}`: iterations after which to render, including the last. The command must
              write the renderings to a folder of `{renders}` named by the iteration, and may write
              `{renders}/times.csv` with columns `iterations`, `seconds` (training time until then)
              and `gaussians` (their number),
            - `{name}`: name of the column.
        split: the data.
        folder: gets `output/`, `renders/`, `log.txt` and the figures.
        name: name of the column.
        iterations: number of iterations.
        milestones: iterations after which the test images are rendered, in addition to the last.

    Raises:
        ColmapAv1Error: the trainer failed, or did not render the test images.
    """
    renders, references = folder / "renders", split.references
    inputs = [p for part in ("sparse/0", "images") for p in (split.whole / part).rglob("*")]
    given = [file_digest(path) for path in sorted(inputs) if path.is_file()]
    names = [reference.name for reference in references]
    twice = _repeated(reference.stem for reference in references)
    if twice is not None:
        raise EvaluationError(
            f"several test images are named '{twice}', and renderings are matched by name: give "
            "images of different names"
        )
    stops = tuple(sorted({stop for stop in milestones if stop < iterations}))
    stops = (*stops, iterations) if trainer == GSPLAT or "{milestones}" in trainer else ()

    def make() -> _Trained:
        for path in (folder / "output", renders):
            path.mkdir()
        if trainer == GSPLAT:
            scene = folder / "scene.npz"
            write_scene(split.whole / "sparse" / "0", split.whole / "images", scene)
            command = [sys.executable, *map(str, (_PROGRAM, scene, renders, *stops))]
        else:
            command = _command(
                trainer, split, folder, name=name, iterations=iterations, milestones=stops
            )
        measured = run_measured(_run, command, folder / "log.txt", log=folder / "log.txt")
        if not stops:
            match_renders(renders, references)  # Raise before the result is marked as finished.
        return _Trained(measured.seconds, _states(renders, stops, references))

    # The command may name a script, which can change. Other words may be too long for `Path`.
    words = words_of_trainer(trainer) if trainer != GSPLAT else []
    scripts = [file_digest(Path(word)) for word in words if os.path.isfile(word)]
    depends_on = (trainer, scripts, given, iterations, stops)
    kind, products = _Trained, [renders]
    trained = run_stage_in(folder, depends_on, kind, make, products=products, made_by=_CODE).result
    states = trained.states
    last = renders / str(iterations) if states else renders
    files = match_renders(last, references)
    metrics = states[-1].metrics if states else rendering_metrics(files, references)
    seconds = trained.seconds
    if states and not math.isnan(states[-1].seconds):
        seconds = states[-1].seconds
    return Training(seconds, states, names, references, files, metrics)


def _command(
    trainer: str,
    split: Split,
    folder: Path,
    *,
    name: str,
    iterations: int,
    milestones: Sequence[int],
) -> list[str]:
    """A trainer's command with its placeholders filled in; writes initial Gaussians if needed."""
    gaussians = folder / "init.ply"
    if "{gaussians}" in trainer:
        write_model_gaussians(gaussians, split.train / "sparse" / "0")
    values = {
        "data": split.train.resolve(),
        "test": split.test.resolve(),
        "gaussians": gaussians.resolve(),
        "output": (folder / "output").resolve(),
        "renders": (folder / "renders").resolve(),
        "iterations": iterations,
        "milestones": ",".join(map(str, milestones)),
        "name": name,
    }
    return [word.format(**values) for word in words_of_trainer(trainer)]


def match_renders(folder: Path, references: Sequence[Path]) -> list[Path]:
    """The rendering of each reference: by name, else by order if the numbers are equal.

    Folders and extensions do not count.

    Raises:
        EvaluationError: the folder does not have a rendering of each reference, or several
            renderings have the name of one.
    """
    found = [p for p in folder.rglob("*") if p.suffix.lower() in _PICTURES]
    by_stem = {path.stem: path for path in found}
    wanted = [reference.stem for reference in references]
    twice = _repeated(path.stem for path in found if path.stem in wanted)
    if twice is not None:
        raise EvaluationError(
            f"{folder}: has several pictures named '{twice}': let the trainer's command write only "
            "the renderings into {renders}"
        )
    if all(stem in by_stem for stem in wanted):
        return [by_stem[stem] for stem in wanted]
    if len(found) == len(references):
        return sorted(found, key=lambda path: natural_key(path.name))
    raise EvaluationError(
        f"{folder}: has {len(found)} renderings for {len(references)} test images: let the "
        "trainer's command write one for each into {renders}"
    )


def _repeated(names: Iterable[str]) -> str | None:
    """A name that occurs more than once; None if there is none."""
    return next((name for name, count in Counter(names).items() if count > 1), None)


def _states(
    renders: Path, stops: Sequence[int], references: Sequence[Path]
) -> tuple[Milestone, ...]:
    """The milestones that a command rendered, with their times if it reported them.

    Raises:
        EvaluationError: renderings are missing, or `times.csv` cannot be read.
    """
    times = _read_times(renders / _TIMES) if stops else {}
    states = []
    for stop in stops:
        files = match_renders(renders / str(stop), references)
        seconds, gaussians = times.get(stop, (math.nan, None))
        states.append(Milestone(stop, seconds, gaussians, rendering_metrics(files, references)))
    return tuple(states)


def _read_times(path: Path) -> dict[int, tuple[float, int | None]]:
    """Training time and number of Gaussians by iteration; empty without a file."""
    if not path.is_file():
        return {}
    try:
        with path.open(newline="", encoding="utf-8") as file:
            return {
                int(row["iterations"]): (
                    _positive(row["seconds"]),
                    int(row["gaussians"]) if row.get("gaussians") else None,
                )
                for row in csv.DictReader(file)
            }
    except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
        raise EvaluationError(
            f"{path}: cannot be read: let the trainer's command write a header "
            "'iterations,seconds' or 'iterations,seconds,gaussians', then a line of numbers for "
            "each milestone"
        ) from error


def _positive(word: str) -> float:
    value = float(word)
    if not 0 < value < math.inf:
        raise ValueError(word)
    return value


def _run(command: Sequence[str], log: Path) -> None:
    run = subprocess.run(bound_group(command), check=False, stdin=subprocess.DEVNULL)
    if run.returncode != 0:
        reason = excerpt(log.read_text(errors="replace").strip().rpartition("\n")[2], _MOST_SHOWN)
        raise EvaluationError(
            f"the trainer ended with status {run.returncode}{reason and f' ({reason})'}: see {log}"
        )


def _undistort(model: Path, image_path: Path, output: Path, names: Sequence[str]) -> None:
    """Undistort all images of a model into `images/` and `sparse/0/`."""
    made = output.with_name("undistorted")
    pycolmap.undistort_images(made, model, image_path, image_names=list(names))
    (output / "sparse").mkdir(parents=True)
    (made / "sparse").replace(output / "sparse" / "0")
    (made / "images").replace(output / "images")
    shutil.rmtree(made)


def _link(source: Path, target: Path) -> None:
    try:
        os.link(source, target)
    except OSError:  # The file system does not support links.
        shutil.copyfile(source, target)


def _write_part(model: Path, output: Path, names: Collection[str]) -> None:
    """Write a model with some of the images and all points."""
    whole = read_model(model)
    posed = posed_images(whole)
    images = [posed[name] for name in sorted(posed) if name in names]
    cameras = {image.camera_id: whole.cameras[image.camera_id] for image in images}
    write_model(output, cameras, images, model_points(whole, images))

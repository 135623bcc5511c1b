"""The tasks that a batch does: each makes the folder of a video from the video."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av.error
import cv2
import numpy as np  # before pycolmap: the other order breaks writing PNG files later
from numpy.typing import NDArray

from colmap_av1.batch.jobs import Work
from colmap_av1.densify import densify
from colmap_av1.errors import ColmapAv1Error, OptionError
from colmap_av1.match import match
from colmap_av1.motion.info import inspect
from colmap_av1.options import DensifyOptions, MatchOptions, ReadOptions, ReconstructOptions
from colmap_av1.options.fields import Options
from colmap_av1.reconstruct import reconstruct
from colmap_av1.util.digests import digest_if_there
from colmap_av1.video.decoding import decode_frames

THUMBNAIL = "thumbnail.jpg"
_THUMBNAIL_WIDTH = 160
_STAGES = ".stages"
_IMAGES = "images"

Figures = dict[str, Any]


@dataclass(frozen=True)
class Made:
    """What a task made in a folder.

    Attributes:
        report: the report of the command that it stands for.
        figures: columns of the video's row.
        warnings: what the user should know.
    """

    report: Any
    figures: Figures
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class Task:
    """A task.

    Attributes:
        kind: the type of its options.
        run: makes the folder: of a video, a new folder, what is done, the model's folder (of
            `densify`) and a number of threads.
    """

    kind: type[Options]
    run: Callable[[Path, Path, Work, Path | None, int], Made]


def task_of(options: Options) -> str:
    """The name of the task that options belong to.

    Raises:
        OptionError: no task has such options.
    """
    for name, task in TASKS.items():
        if type(options) is task.kind:
            return name
    kinds = ", ".join(task.kind.__name__ for task in TASKS.values())
    raise OptionError(f"{type(options).__name__} are no options of a batch: give one of {kinds}")


def matching_of(options: Options) -> MatchOptions | None:
    """The options of matching that a task's options hold."""
    found = options if isinstance(options, MatchOptions) else getattr(options, "match", None)
    return found if isinstance(found, MatchOptions) else None


def depends_on(work: Work) -> list[Any]:
    """What the result depends on beside the video and the version: see `digest_of`.

    Raises:
        OSError: a file that options name cannot be read.
    """
    matching = matching_of(work.options)
    if matching is None:
        return [work.task, work.options, None, work.write_images]
    files = digest_if_there(matching.images.frame_list), digest_if_there(matching.masks.mask_path)
    return [work.task, work.options, files, work.write_images]


def write_thumbnail(video: Path, folder: Path) -> None:
    """Write a small picture of the video, of an image where there are any."""
    images = sorted((folder / _IMAGES).glob("*")) if (folder / _IMAGES).is_dir() else []
    picture: NDArray[np.uint8] | None = None
    if images:
        data = np.fromfile(images[len(images) // 2], dtype=np.uint8)
        picture = cv2.imdecode(data, cv2.IMREAD_COLOR)
    else:
        # Of some formats of pixels FFmpeg makes no picture.
        with suppress(ColmapAv1Error, av.error.FFmpegError):
            frames = decode_frames(video, num_threads=1)
            picture = next((frame for _, frame in frames), None)
            frames.close()
    if picture is None:
        return
    height, width = picture.shape[:2]
    size = (_THUMBNAIL_WIDTH, max(1, round(height * _THUMBNAIL_WIDTH / width)))
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    _, encoded = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 80])
    encoded.tofile(folder / THUMBNAIL)


def _inspect(video: Path, folder: Path, work: Work, model: Path | None, threads: int) -> Made:
    del folder, model
    report = inspect(video, _on_threads(work.options, threads))
    return Made(report, {"frames": report.num_shown}, report.reasons)


def _match(video: Path, folder: Path, work: Work, model: Path | None, threads: int) -> Made:
    del model
    report = match(
        folder / "database.db",
        video,
        image_path=folder / _IMAGES if work.write_images else None,
        options=_on_threads(work.options, threads),
    )
    figures = {"frames": report.num_frames, "images": report.num_images}
    return Made(report, {**figures, "tracks": report.num_tracks}, report.warnings)


def _reconstruct(video: Path, folder: Path, work: Work, model: Path | None, threads: int) -> Made:
    del model
    report = reconstruct(video, folder, options=_on_threads(work.options, threads))
    figures = {
        "frames": report.num_frames,
        "images": report.num_images,
        "registered": report.num_registered,
        "tracks": report.num_tracks,
        "points": report.num_points,
        "coverage": report.coverage,
    }
    return Made(report, figures, report.warnings)


def _densify(video: Path, folder: Path, work: Work, model: Path | None, threads: int) -> Made:
    assert model is not None
    options = _on_threads(work.options, threads)
    report = densify(model, video, folder / "sparse" / "0", options=options)
    figures = {
        "images": report.num_images,
        "registered": report.num_images,
        "tracks": report.num_tracks,
        "points": report.num_points,
        "coverage": report.coverage,
    }
    return Made(report, figures, report.warnings)


def _on_threads(options: Any, threads: int) -> Any:
    """The options with the threads that were reserved, where they ask for no number."""
    changes: Mapping[str, Any]
    if isinstance(options, ReadOptions):
        changes = {} if options.num_threads is not None else {"num_threads": threads}
        return dataclasses.replace(options, **changes)
    if isinstance(options, MatchOptions):
        if options.run.num_threads is not None:
            return options
        run = dataclasses.replace(options.run, num_threads=threads)
        return dataclasses.replace(options, run=run)
    return dataclasses.replace(options, match=_on_threads(options.match, threads))


# What of a task's folder is no result: what only a further run of the same command would use.
UNPUBLISHED = (_STAGES,)

TASKS: dict[str, Task] = {
    "reconstruct": Task(ReconstructOptions, _reconstruct),
    "match": Task(MatchOptions, _match),
    "densify": Task(DensifyOptions, _densify),
    "info": Task(ReadOptions, _inspect),
}

# Where a model may lie in the folder that is given for a video.
_MODEL_FOLDERS = ("", "sparse/0", "0")
_MODEL_FILES = ("cameras", "images", "points3D")


def model_files(name: str) -> list[list[str]]:
    """Paths of the files that a video's model may consist of, below the folder of models."""
    return [
        ["/".join(filter(None, (name, folder, f"{file}{suffix}"))) for file in _MODEL_FILES]
        for folder in _MODEL_FOLDERS
        for suffix in (".bin", ".txt")
    ]

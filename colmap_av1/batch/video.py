"""Processing one video of a batch: run the command, then publish its files."""

from __future__ import annotations

import dataclasses
import shutil
import subprocess
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import imageio_ffmpeg

from colmap_av1.batch.command import CommandFailedError, Processes, run_command
from colmap_av1.batch.inputs import Video
from colmap_av1.batch.output import earlier_report, output_at, publish, remove_list_of_unfinished
from colmap_av1.batch.rows import Row, row_of
from colmap_av1.errors import ModelError, OptionError, VideoError
from colmap_av1.options import BatchOptions
from colmap_av1.options.batch import match_options_of
from colmap_av1.options.fields import Options
from colmap_av1.options.words import words_of
from colmap_av1.util.digests import digest_of, digest_of_tree
from colmap_av1.util.failures import Failure, failure_of
from colmap_av1.util.files import STAGES, scratch_folder
from colmap_av1.util.processes import bound
from colmap_av1.util.remote import fetch, is_url, version_of, without_secrets

THUMBNAIL = "thumbnail.jpg"
# Part of the names of folders for unfinished work.
SCRATCH = "video"
_THUMBNAIL_WIDTH = 160
_THUMBNAIL_TIME = 60.0  # seconds
_IMAGES = "images"
# Where a model may lie in the folder given for a video.
_MODEL_FOLDERS = ("", "sparse/0", "0")
_MODEL_FILES = ("cameras", "images", "points3D")
# Columns of the row, and the report fields that they show.
_FIGURES = {
    "frames": "num_frames",
    "images": "num_images",
    "registered": "num_registered",
    "tracks": "num_tracks",
    "points": "num_points",
    "coverage": "coverage",
}


@dataclass(frozen=True)
class Work:
    """The task of a batch, for each video.

    Attributes:
        task: name of the command.
        options: its options.
        output: absolute path or URL of the output, which gets a folder for each video.
        models: for `densify`: absolute path or URL of the folder with a model for each video.
        scratch: absolute path of the folder for unfinished work, on each machine.
        batch: options of the batch.
        version: version of this package, which results depend on.
    """

    task: str
    options: Options
    output: str
    models: str | None
    scratch: str
    batch: BatchOptions
    version: str


@dataclass(frozen=True)
class Outcome:
    """Result of a video.

    Attributes:
        row: its row.
        kept: whether an earlier run has finished it.
        retried: number of attempts beyond the first.
    """

    row: Row
    kept: bool = False
    retried: int = 0


def process_video(work: Work, video: Video, threads: int, processes: Processes) -> Outcome:
    """Process a video, unless its folder in the output comes from the same video and options.

    Args:
        work: the task.
        video: the video.
        threads: threads of the command, if its options do not set them.
        processes: runs the command.

    Returns:
        The outcome; any failure is reported in its row.
    """
    retried = 0
    while True:
        start = time.perf_counter()
        try:
            outcome = _attempt(work, video, threads, processes)
            return dataclasses.replace(outcome, retried=retried)
        except Exception as error:  # A failing video must not stop the others.
            failure = error.failure if isinstance(error, CommandFailedError) else failure_of(error)
        if not failure.transient or retried >= work.batch.retries or processes.stopped:
            return Outcome(failed_row(video, failure, time.perf_counter() - start), False, retried)
        retried += 1


def failed_row(video: Video, failure: Failure, seconds: float = 0.0) -> Row:
    """The row of a video that failed."""
    message = without_secrets(failure.message)
    address = without_secrets(video.address)
    return Row(video.name, address, "failed", failure.reason, round(seconds, 3), error=message)


def _attempt(work: Work, video: Video, threads: int, processes: Processes) -> Outcome:
    start = time.perf_counter()
    output = output_at(work.output)
    source = version_of(video.address, work.batch.stall)
    models = _model_versions(work, video)
    key = digest_of([source, [v for _, v in models], work.version, *_depends_on(work)])
    earlier = earlier_report(output, video.name)
    if earlier is not None and earlier.get("task") != work.task:
        raise OptionError(f"{video.name}: was created by another task: give another output")
    if earlier is not None and earlier["key"] == key:
        with suppress(ValueError):  # A video with a damaged report is processed again.
            row = dataclasses.replace(
                row_of(earlier["row"]), name=video.name, input=without_secrets(video.address)
            )
            remove_list_of_unfinished(output, video.name)
            return Outcome(row, kept=True)
    with scratch_folder(Path(work.scratch) / SCRATCH) as scratch:
        folder, copies = scratch / "output", scratch / "input"
        for new in (folder, copies):
            new.mkdir()
        path = fetch(video.address, copies, work.batch.stall)
        model = _fetch_model(models, copies, work.batch.stall)
        names = {str(path): video.address, str(copies): video.address, str(folder): video.name}
        words = _words(work, path, model, folder, threads)
        facts, warnings = run_command(words, scratch, names, work.batch.timeout, processes)
        _write_thumbnail(path, folder)
        # Only another run of the same command would use intermediate results.
        for stages in [*folder.rglob(STAGES)]:
            shutil.rmtree(stages, ignore_errors=True)
        report = facts["report"]
        figures = {column: report.get(field) for column, field in _FIGURES.items()}
        if work.task == "info":
            figures["frames"] = report["num_shown"]
        row = Row(
            video.name,
            without_secrets(video.address),
            "done",
            seconds=round(time.perf_counter() - start, 3),
            cpu_seconds=round(facts["cpu_seconds"], 3),
            video_seconds=facts["video_seconds"],
            warnings=tuple(dict.fromkeys([*warnings, *report.get("reasons", ())])),
            **figures,
        )
        record = {
            "key": key,
            "version": work.version,
            "input": {"path": row.input, **source},
            "task": work.task,
            "options": dataclasses.asdict(work.options),  # type: ignore[call-overload]
            "row": vars(row),
            "report": report,
        }
        publish(output, folder, video.name, record)
        return Outcome(row)


def _words(work: Work, video: Path, model: Path | None, folder: Path, threads: int) -> list[str]:
    """The command line that processes a video into a folder."""
    words = [work.task, f"--video={video}", *words_of(work.options), "--quiet"]
    if not any(word.startswith("--num_threads=") for word in words):
        words.append(f"--num_threads={threads}")
    if work.task == "match":
        words.append(f"--database={folder / 'database.db'}")
        if work.batch.write_images:
            words.append(f"--image_path={folder / _IMAGES}")
    elif work.task == "reconstruct":
        words.append(f"--output={folder}")
    elif work.task == "densify":
        words += [f"--model={model}", f"--output={folder / 'sparse' / '0'}"]
    return words


def _depends_on(work: Work) -> list[object]:
    """What the result depends on, in addition to the video and the version."""
    matching = match_options_of(work.options)
    files = [digest_of_tree(path) for path in matching.files] if matching is not None else None
    return [work.task, work.options, files, work.batch.write_images]


def _model_versions(work: Work, video: Video) -> list[tuple[str, dict[str, object]]]:
    """The files of the video's model and their versions; empty if the task needs no model."""
    if work.models is None:
        return []
    top = f"{work.models.rstrip('/')}/{video.name}"
    for folder in _MODEL_FOLDERS:
        for suffix in (".bin", ".txt"):
            parts = (filter(None, (top, folder, f"{file}{suffix}")) for file in _MODEL_FILES)
            files = ["/".join(part) for part in parts]
            with suppress(VideoError):  # A file is missing: try the next place.
                return [(file, version_of(file, work.batch.stall)) for file in files]
    raise ModelError(
        f"{work.models}: has no model of '{video.name}': give a folder with cameras, images and "
        f"points3D in {video.name}, {video.name}/sparse/0 or {video.name}/0"
    )


def _fetch_model(
    models: list[tuple[str, dict[str, object]]], copies: Path, stall: float
) -> Path | None:
    if not models:
        return None
    if not is_url(models[0][0]):
        return Path(models[0][0]).parent
    model = copies / "model"
    model.mkdir()
    for address, _ in models:
        fetch(address, model, stall).rename(model / address.rpartition("/")[2])
    return model


def _write_thumbnail(video: Path, folder: Path) -> None:
    """Write a thumbnail of the middle image or, without images, of the start of the video."""
    images = sorted((folder / _IMAGES).glob("*"))
    if images:  # Its name may have a '%', which ffmpeg would take for a number pattern.
        source = ["-f", "image2", "-pattern_type", "none", "-i", str(images[len(images) // 2])]
    else:
        source = ["-i", f"file:{video}"]
    ffmpeg = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "quiet", "-nostdin", "-threads", "1"]
    shape = ["-frames:v", "1", "-vf", f"scale={_THUMBNAIL_WIDTH}:-2"]
    with suppress(OSError, subprocess.TimeoutExpired):
        command = [*ffmpeg, *source, *shape, str(folder / THUMBNAIL)]
        subprocess.run(bound(command), check=False, timeout=_THUMBNAIL_TIME)

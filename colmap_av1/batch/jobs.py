"""What a batch hands to its engines, what it gets back, and what an engine is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

from colmap_av1.options.fields import Options


@dataclass(frozen=True)
class Source:
    """Where a video lies: a file, or a part of a tar file.

    Attributes:
        address: path or URL of the file.
        member: name of the video in a tar file; empty where the file is the video.
        start: its first byte in the file.
        length: its bytes; None: up to the end of the file.
    """

    address: str
    member: str = ""
    start: int = 0
    length: int | None = None

    def __str__(self) -> str:
        return f"{self.address}/{self.member}" if self.member else self.address


@dataclass(frozen=True)
class Needs:
    """What a video takes of a machine.

    Attributes:
        cores: CPU cores.
        memory: bytes.
    """

    cores: int
    memory: int


@dataclass(frozen=True)
class Work:
    """What is done with each video of a batch.

    Attributes:
        task: name of the task, see `tasks.TASKS`.
        options: the task's options.
        output: absolute path, or URL, of the folder that gets a folder for each video.
        models: the same of the folder with a model for each video, for `densify`.
        scratch: absolute path of the folder for unfinished work, on whatever machine.
        timeout: seconds after which an attempt is stopped; None: never.
        stall: seconds without data after which reading is given up.
        write_images: write images beside the database of `match`.
        cores: cores of every video; None: estimated.
        memory: bytes of every video, at which it is stopped; None: estimated.
        version: version of this package, which results depend on.
    """

    task: str
    options: Options
    output: str
    models: str | None
    scratch: str
    timeout: float | None
    stall: float
    write_images: bool
    cores: int | None
    memory: int | None
    version: str


@dataclass(frozen=True)
class Job:
    """One video of a batch.

    Attributes:
        position: its number in the order of the inputs, from 0.
        name: path of its folder in the output, with '/' between parts.
        source: the video.
        needs: what the engine reserves for it.
        attempt: how often it was tried, this time included.
    """

    position: int
    name: str
    source: Source
    needs: Needs
    attempt: int = 1


@dataclass(frozen=True)
class Row:
    """What became of a video; the fields are the columns of `batch.csv`.

    Attributes:
        name: path of its folder in the output.
        input: path or URL of the video.
        state: what became of it.
        reason: kind of the failure; empty where it is done.
        seconds: wall time of the attempt.
        cpu_seconds: CPU time of it, programs that it ran included; None where that was lost.
        video_seconds: length of the video; None where unknown.
        frames: shown frames.
        images: frames chosen as images.
        registered: images with a pose.
        tracks: tracks of the video.
        points: 3D points.
        coverage: share of the images' cells that visible points project into.
        warnings: what the user should know.
        error: the failure's message.
    """

    name: str
    input: str
    state: Literal["done", "failed"]
    reason: str = ""
    seconds: float = 0.0
    cpu_seconds: float | None = None
    video_seconds: float | None = None
    frames: int | None = None
    images: int | None = None
    registered: int | None = None
    tracks: int | None = None
    points: int | None = None
    coverage: float | None = None
    warnings: tuple[str, ...] = ()
    error: str = ""


@dataclass(frozen=True)
class Ended:
    """An attempt that ended with a row.

    Attributes:
        row: what became of the video.
        kept: an earlier run had finished it.
        passing: it failed in a way that another attempt may not.
        starved: it failed for want of memory.
        spent: the process must not be used for another video.
    """

    row: Row
    kept: bool = False
    passing: bool = False
    starved: bool = False
    spent: bool = False


@dataclass(frozen=True)
class TooSmall:
    """An attempt that needs more of a machine than was reserved for it.

    Attributes:
        needs: what it needs.
    """

    needs: Needs


Outcome = Ended | TooSmall


class Engine(Protocol):
    """Runs attempts at videos, several at a time.

    Attributes:
        about: what it runs on, a line for the user.
    """

    about: str

    def has_room(self, job: Job) -> bool:
        """Whether to submit a video now, not to wait for others first."""
        ...

    def submit(self, job: Job) -> None:
        """Attempt a video as soon as there is what it needs."""
        ...

    def wait(self, seconds: float) -> Sequence[tuple[Job, Outcome]]:
        """The attempts that have ended since, at least one unless none does in that time."""
        ...

    def close(self) -> None:
        """Stop all attempts at once."""
        ...

"""Options of a batch of videos."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from typing import ClassVar, Literal

from colmap_av1.errors import OptionError
from colmap_av1.options.commands import DensifyOptions, MatchOptions, ReconstructOptions
from colmap_av1.options.fields import Options, option
from colmap_av1.options.video import ReadOptions

_SHARD = re.compile(r"(\d+)/(\d+)", re.ASCII)


@dataclass(frozen=True)
class BatchOptions(Options):
    """Where the videos of a batch are processed, and how failures are handled.

    Examples:
        >>> from colmap_av1 import BatchOptions
        >>> options = BatchOptions(shard="2/10", timeout=3600)
        >>> options.engine
        'local'
    """

    title: ClassVar[str] = "batch"

    engine: Literal["local", "ray"] = option(
        "local",
        "local: processes on this machine; ray: Ray tasks, one for each video (needs the extra "
        "'cluster')",
        common=True,
    )
    address: str | None = option(
        None,
        "address of a running Ray cluster, such as auto; None: start Ray on this machine",
        common=True,
    )
    shard: str | None = option(
        None,
        "I/N: process only every N-th video, starting with the I-th (I from 1), for job arrays",
        common=True,
    )
    timeout: float | None = option(
        None,
        "stop a video after this many seconds; None: no limit",
        above=0,
        unit="seconds",
        common=True,
    )
    retries: int = option(
        2,
        "number of times to retry a video whose process was killed, ran out of time or memory, or "
        "could not read or write; damaged or unsuitable videos are not retried",
        least=0,
        common=True,
    )
    cores: int | None = option(
        None,
        "CPU cores for each video, which limits how many run at a time; None: one, or more on this "
        "machine if it has less than 4 GB of memory per core",
        least=1,
        common=True,
    )
    stall: float = option(
        60.0,
        "give up reading a URL after this many seconds without data",
        above=0,
        unit="seconds",
    )
    scratch: str | os.PathLike[str] | None = option(
        None,
        "folder for unfinished work; None: a hidden folder in the output folder, or the system's "
        "temporary folder if the output is a URL",
    )
    write_images: bool = option(True, "match: write the images next to the database")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.address is not None and self.engine != "ray":
            raise OptionError("address needs Ray: give --engine ray, or leave out address")
        index, count = self.part
        if not 1 <= index <= count:
            raise OptionError(f"shard is {self.shard!r}: give I/N with I from 1 to N, such as 3/10")

    @property
    def part(self) -> tuple[int, int]:
        """The shard's number, from 1, and the number of shards; (1, 1) for all videos."""
        if self.shard is None:
            return 1, 1
        found = _SHARD.fullmatch(self.shard)
        return (int(found[1]), int(found[2])) if found else (0, 0)


# The tasks of a batch and the options of each.
TASK_OPTIONS: dict[str, type[Options]] = {
    "reconstruct": ReconstructOptions,
    "match": MatchOptions,
    "densify": DensifyOptions,
    "info": ReadOptions,
}


def match_options_of(task: Options) -> MatchOptions | None:
    """The options for matching in those of a task; None if it has none."""
    options = task if isinstance(task, MatchOptions) else getattr(task, "match", None)
    return options if isinstance(options, MatchOptions) else None

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
    """Where the videos of a batch are processed, and what becomes of those that fail."""

    title: ClassVar[str] = "batch"

    engine: Literal["local", "ray"] = option(
        "local",
        "local: processes of this machine; ray: tasks of Ray (extra cluster), one a video",
        common=True,
    )
    address: str | None = option(
        None,
        "address of a running Ray, such as auto; None: one of this machine's is started",
        common=True,
    )
    shard: str | None = option(
        None,
        "I/N: only every N-th video from the I-th on, for arrays of jobs; I counts from 1",
        common=True,
    )
    timeout: float | None = option(
        None,
        "seconds that a video may take before it is stopped; None: any",
        above=0,
        unit="seconds",
        common=True,
    )
    retries: int = option(
        2,
        "further attempts at a video whose process was killed, ran out of time or memory, or could "
        "not read or write; a video that is damaged or unfit is not tried again",
        least=0,
        common=True,
    )
    cores: int | None = option(
        None,
        "CPU cores for each video, by which as many run at a time as there are cores for; None: "
        "one, on this machine more where it has less than 4 GB of memory for each",
        least=1,
        common=True,
    )
    stall: float = option(
        60.0,
        "seconds without any data after which the reading of a URL is given up",
        above=0,
        unit="seconds",
    )
    scratch: str | os.PathLike[str] | None = option(
        None,
        "folder for unfinished work; None: hidden in the output folder, or the system's for "
        "temporary files where the output is a URL",
    )
    write_images: bool = option(True, "match: write the images beside the database")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.address is not None and self.engine != "ray":
            raise OptionError("address is that of a Ray: give engine ray with it")
        index, count = self.part
        if not 1 <= index <= count:
            raise OptionError(f"shard is {self.shard!r}: give I/N with I from 1 to N, such as 3/10")

    @property
    def part(self) -> tuple[int, int]:
        """The shard as its number, from 1, and their count; (1, 1): all videos."""
        if self.shard is None:
            return 1, 1
        found = _SHARD.fullmatch(self.shard)
        return (int(found[1]), int(found[2])) if found else (0, 0)


# The tasks of a batch: the options of each.
TASK_OPTIONS: dict[str, type[Options]] = {
    "reconstruct": ReconstructOptions,
    "match": MatchOptions,
    "densify": DensifyOptions,
    "info": ReadOptions,
}

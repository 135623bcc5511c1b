"""Options of a run as a whole."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from colmap_av1.options.fields import Options, option


@dataclass(frozen=True)
class RunOptions(Options):
    """Options that all stages of a run share.

    Examples:
        >>> from colmap_av1 import MatchOptions, RunOptions
        >>> options = MatchOptions(run=RunOptions(num_threads=4, seed=1))
        >>> options.run.seed
        1
    """

    title: ClassVar[str] = "run"

    num_threads: int | None = option(
        None,
        "number of threads; None: one per CPU that the process may use. Does not change the result",
        least=1,
        common=True,
    )
    seed: int = option(
        0,
        "seed of the random numbers; the same seed gives the same result",
        least=0,
        spellings=("random_seed",),
    )

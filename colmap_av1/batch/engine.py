"""Where the videos of a batch are processed: what `local` and `ray` have in common."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from colmap_av1.batch.jobs import Job, Outcome


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

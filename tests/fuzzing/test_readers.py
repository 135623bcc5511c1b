"""File readers give a one-line error of the package or a result for damaged seeds.

COLMAP_AV1_EXAMPLES sets the number of examples of each kind.
"""

from __future__ import annotations

import os

import pytest
from conftest import PROJECT
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from readers import TARGETS, run

SEEDS = PROJECT / "tests" / "data" / "seeds"
EXAMPLES = os.environ.get("COLMAP_AV1_EXAMPLES")


def seeds(target: str) -> list[bytes]:
    return [path.read_bytes() for path in sorted((SEEDS / target).iterdir())]


@pytest.mark.parametrize("target", TARGETS)
def test_seeds_are_accepted(target: str) -> None:
    """Otherwise damage to them would test little."""
    assert [run(target, data) for data in seeds(target)] == [None] * len(seeds(target))


# A relative position in a file, and the new content: bytes, or a number as used in headers.
_CHANGES = st.lists(
    st.tuples(
        st.floats(0, 0.999),
        st.binary(min_size=1, max_size=8)
        | st.sampled_from(
            [n.to_bytes(size, "little") for size in (4, 8) for n in (0, 1, (1 << 31) - 1, 1 << 31)]
            + [b"\xff" * size for size in (1, 2, 4, 8)]
        ),
    ),
    min_size=1,
    max_size=4,
)


@pytest.mark.parametrize("target", TARGETS)
def test_damaged_seeds_give_errors_of_the_package(target: str) -> None:
    @settings(
        max_examples=int(EXAMPLES or "60"),
        derandomize=EXAMPLES is None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(data=st.sampled_from(seeds(target)), changes=_CHANGES, kept=st.floats(0, 1) | st.just(1))
    def damage(data: bytes, changes: list[tuple[float, bytes]], kept: float) -> None:
        changed = bytearray(data)
        for place, value in changes:
            start = int(place * len(data))
            changed[start : start + len(value)] = value
        run(target, bytes(changed[: int(kept * len(changed))]))

    damage()

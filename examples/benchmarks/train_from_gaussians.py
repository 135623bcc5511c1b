"""Run the CPU trainer of `../shared` from a file of Gaussians instead of points.

python examples/benchmarks/train_from_gaussians.py init.ply TRAINER_FOLDER ARGUMENTS_OF_gs_train...

The trainer accepts only points. This script replaces its initial Gaussians with those that
`reconstruct --gaussians init.ply` wrote, and changes nothing else.
"""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_Floats = NDArray[np.float32]


def read_gaussians(path: Path) -> dict[str, _Floats]:
    """The parameters of the Gaussians by the trainer's names, float32 [n, ...]."""
    with path.open("rb") as file:
        header = iter(file.readline, b"end_header\n")
        names = [line.split()[-1].decode() for line in header if line.startswith(b"property")]
        values = np.fromfile(file, "<f4").reshape(-1, len(names))
    column = {name: values[:, i] for i, name in enumerate(names)}

    def columns(name: str, indices: range) -> _Floats:
        return np.stack([column[f"{name}_{i}"] for i in indices], axis=1)

    return {
        "xyz": np.stack([column[axis] for axis in "xyz"], axis=1),
        "ls": columns("scale", range(3)),
        "rot": columns("rot", range(4)),
        "op": column["opacity"][:, None],
        "dc": columns("f_dc", range(3)),
        # Coefficients of degree 1, which are all 0.
        "rest": columns("f_rest", range(9)),
    }


def main() -> None:
    """Run the trainer with the given Gaussians."""
    given, trainer = Path(sys.argv[1]), Path(sys.argv[2])
    sys.path.insert(0, str(trainer))
    train: Any = importlib.import_module("gs_train")

    def init_params(_: Any, __: Any, cap: int, seed: int, ___: float) -> dict[str, _Floats]:
        found = read_gaussians(given)
        size = len(found["xyz"])
        few = np.sort(np.random.default_rng(seed).choice(size, min(cap, size), replace=False))
        return {name: np.ascontiguousarray(values[few]) for name, values in found.items()}

    train.init_params = init_params
    sys.argv[1:] = sys.argv[3:]
    train.main()


if __name__ == "__main__":
    main()

"""Runs a target of `readers` under atheris, which must be installed.

python tests/fuzzing/with_atheris.py TARGET CORPUS... [options of libFuzzer]
"""

from __future__ import annotations

import sys

import atheris

# Coverage is measured for these imports.
with atheris.instrument_imports(include=["colmap_av1", "readers"]):
    import readers


def main() -> None:
    """Run the target that the command line names."""
    target = sys.argv.pop(1)
    atheris.Setup(sys.argv, lambda data: readers.run(target, data))
    atheris.Fuzz()


if __name__ == "__main__":
    main()

"""Write the seeds of the fuzzers: IVF files as inputs of parser_fuzzer and track_builder_fuzzer.

    python make_corpus.py corpus FILE.ivf...

Each file gives corpus/parser/NAME and corpus/track_builder/NAME with as many of its first
temporal units as fit the size limit. corpus/track_builder/random_N are random block data, and
corpus/model/random_N random points and pictures. The committed seeds were made from the streams and
damaged files of the conformance kit and, except for those of the model, reduced by libFuzzer's
-merge=1.
"""

from __future__ import annotations

import argparse
import random
import struct
from pathlib import Path

_IVF_HEADER_SIZE = 32
_IVF_FRAME_HEADER_SIZE = 12

# Option bytes (see LLVMFuzzerTestOneInput of each): one thread; motion parsed from the
# units, min_length 2 and every trust rule on.
_PARSER_OPTIONS = bytes([0x00])
_TRACK_BUILDER_OPTIONS = bytes([0x00, 0xFD])
_NUM_RANDOM = 4
# For the model: number of kinds of input, which the first byte selects, and bytes of a seed. In
# every second seed nearly all numbers are small, like those of real scenes.
_NUM_KINDS = 3
_MODEL_SIZE = 900
_SMALL = range(100, 156)


def temporal_units(ivf: bytes) -> list[bytes]:
    """The temporal units of an IVF file; if it is damaged, those that can be found."""
    units = []
    position = _IVF_HEADER_SIZE
    while position + _IVF_FRAME_HEADER_SIZE <= len(ivf):
        (size,) = struct.unpack_from("<I", ivf, position)
        position += _IVF_FRAME_HEADER_SIZE
        units.append(ivf[position : position + size])
        position += size
    return units


def fuzzer_input(options: bytes, units: list[bytes], max_size: int) -> bytes:
    """An input of at most max_size bytes, the first unit always among its units."""
    data = options
    for index, unit in enumerate(units):
        grown = data + struct.pack("<I", len(unit)) + unit
        if index > 0 and len(grown) > max_size:
            break
        data = grown
    return data


def main() -> None:
    """Convert the files that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("corpus", type=Path, help="folder to write into")
    parser.add_argument("ivf", type=Path, nargs="+", help="IVF files")
    parser.add_argument("--max_size", type=int, default=6000, help="bytes of a seed")
    args = parser.parse_args()
    targets = {"parser": _PARSER_OPTIONS, "track_builder": _TRACK_BUILDER_OPTIONS}
    for target, options in targets.items():
        folder = args.corpus / target
        folder.mkdir(parents=True, exist_ok=True)
        for path in args.ivf:
            data = fuzzer_input(options, temporal_units(path.read_bytes()), args.max_size)
            (folder / path.stem).write_bytes(data)
    numbers = random.Random(1)
    for index in range(_NUM_RANDOM):
        # Bit 0 of the third byte: numbers that no stream holds.
        options = bytes([0x01, numbers.randrange(256), index % 2])
        data = options + numbers.randbytes(args.max_size - len(options))
        (args.corpus / "track_builder" / f"random_{index}").write_bytes(data)
    (args.corpus / "model").mkdir(exist_ok=True)
    for index in range(2 * _NUM_KINDS):
        values = numbers.choices(_SMALL if index % 2 else range(256), k=_MODEL_SIZE)
        data = bytes([index % _NUM_KINDS, *values])
        (args.corpus / "model" / f"random_{index}").write_bytes(data)


if __name__ == "__main__":
    main()

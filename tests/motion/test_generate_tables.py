import re
from itertools import pairwise

import pytest
from conftest import PROJECT

CORE = PROJECT / "colmap_av1" / "csrc" / "av1"
DEFINITION = re.compile(
    r"^(?:inline constexpr|const) (std::\w+) (\w+)((?:\[\d+\])+) = (\{.*?\});$", re.M | re.S
)
DECLARATION = re.compile(r"^extern const (std::\w+) (\w+)((?:\[\d+\])+);$", re.M)


def read_tables(file: str) -> dict[str, tuple[tuple[int, ...], list[int]]]:
    text = (CORE / file).read_text(encoding="utf-8")
    return {
        name: (
            tuple(int(dim) for dim in re.findall(r"\d+", dims)),
            [int(value) for value in re.findall(r"-?\d+", body)],
        )
        for _, name, dims, body in DEFINITION.findall(text)
    }


def test_every_cdf_row_increases_to_one_and_ends_with_its_counter():
    cdfs = read_tables("default_cdfs.cc")
    assert len(cdfs) == 96
    for name, (dims, values) in cdfs.items():
        for start in range(0, len(values), dims[-1]):
            row = values[start : start + dims[-1]]
            assert row[-2:] == [32768, 0], name
            assert row[0] > 0, name
            assert all(a < b for a, b in pairwise(row[:-1])), name


def test_declarations_match_definitions():
    source = (CORE / "default_cdfs.cc").read_text(encoding="utf-8")
    header = (CORE / "default_cdfs.h").read_text(encoding="utf-8")
    assert DECLARATION.findall(header) == [match[:3] for match in DEFINITION.findall(source)]


@pytest.mark.parametrize("file", ["default_cdfs.cc", "spec_tables.h"])
def test_arrays_have_the_stated_number_of_values(file):
    for name, (dims, values) in read_tables(file).items():
        size = 1
        for dim in dims:
            size *= dim
        assert len(values) == size, name


def test_every_scan_visits_each_position_once():
    scans = {k: v for k, v in read_tables("spec_tables.h").items() if "Scan" in k}
    assert len(scans) == 32
    for name, (_, values) in scans.items():
        width, height = (int(side) for side in re.findall(r"\d+", name))
        assert sorted(values) == list(range(width * height)), name


def test_block_sizes_agree_with_their_names():
    constants = dict(
        re.findall(r"int (BLOCK_\d+X\d+) = (\d+);", (CORE / "constants.h").read_text("utf-8"))
    )
    tables = read_tables("spec_tables.h")
    assert constants
    for name, index in constants.items():
        width, height = (int(side) for side in re.findall(r"\d+", name))
        assert tables["kBlockWidth"][1][int(index)] == width
        assert tables["kBlockHeight"][1][int(index)] == height
        assert tables["kMiWidthLog2"][1][int(index)] == (width // 4).bit_length() - 1

"""Write the C++ tables and constants of the AV1 parser from the AV1 specification's text.

Usage: ``python generate_tables.py SPEC_DIR``, where SPEC_DIR holds the specification's markdown
chapters (03.symbols.md to 10.additional.tables.md). The files constants.h, spec_tables.h,
default_cdfs.h and default_cdfs.cc are written next to this script; they are committed, so building
the package needs neither the specification nor this script.

Only the tables and constants that the core's sources name are written.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Union

_Nested = Union[int, list["_Nested"]]  # noqa: UP007  (evaluated at run time on Python 3.10)

_SYMBOLS = "03.symbols.md"
_SEMANTICS = "07.bitstream.semantics.md"
_TABLE_CHAPTERS = (
    "06.bitstream.syntax.md",
    _SEMANTICS,
    "08.decoding.process.md",
    "09.parsing.process.md",
    "10.additional.tables.md",
)

# The sources of the core, except the generated ones.
_CORE = Path(__file__).parents[1]
_GENERATED = ("constants.h", "default_cdfs.h", "default_cdfs.cc", "spec_tables.h")

_INT_TYPES = (
    ("std::uint8_t", 0, 2**8 - 1),
    ("std::int8_t", -(2**7), 2**7 - 1),
    ("std::uint16_t", 0, 2**16 - 1),
    ("std::int16_t", -(2**15), 2**15 - 1),
    ("std::int32_t", -(2**31), 2**31 - 1),
)
_CDF_TYPE = "std::uint16_t"
_CDF_ONE = 32768
_LINE_LENGTH = 100
_BANNER = (
    "// Generated from the AV1 specification's tables by generate_tables.py. Do not edit.\n"
    "// clang-format off\n"
)

_NUMBER = re.compile(r"-?\d+")
_NAME_CELL = re.compile(r"([A-Z][A-Z0-9_]+h?)\.?(?: +\(.*\))?")
_DEFINITION = re.compile(r"^ *([A-Za-z]\w*) *((?:\[[^\]\n]*\] *)+)= *\n? *(?=\{)", re.MULTILINE)
_DIMENSION = re.compile(r"\[([^\]]*)\]")
_MULTIPLE = re.compile(r"(\w+)\[ x \] is defined to be equal to (\d+) \* (\w+)\[ x \]")
_COMMENT = re.compile(r" *//.*|/\*.*?\*/")
_TOKEN = re.compile(r"\s*([{},]|[^{},\s][^{},]*)")


def _cpp_name(name: str) -> str:
    """Name of a table in C++: ``k`` and the specification's name without its underscores."""
    plain = name.replace("_", "")
    return f"k{plain[0].upper()}{plain[1:]}"


@dataclass(frozen=True)
class _Table:
    """One array of the specification: its name there, its dimensions and its resolved values."""

    name: str
    dims: tuple[int, ...]
    values: _Nested

    @property
    def cpp_name(self) -> str:
        return _cpp_name(self.name)

    @property
    def is_cdf(self) -> bool:
        """Whether this is one of the default CDFs."""
        return self.name.startswith("Default_") and self.name.endswith("_Cdf")

    @property
    def cpp_type(self) -> str:
        """The smallest standard integer that holds every value (one type for all CDFs)."""
        if self.is_cdf:
            return _CDF_TYPE
        flat = [value for row in _rows(self.values) for value in row]
        for name, low, high in _INT_TYPES:
            if low <= min(flat) and max(flat) <= high:
                return name
        raise ValueError(f"{self.name}: a value does not fit into 32 bits; check the table")

    @property
    def declaration(self) -> str:
        """Type, name and dimensions, without specifiers and without the values."""
        dims = "".join(f"[{dim}]" for dim in self.dims)
        return f"{self.cpp_type} {self.cpp_name}{dims}"


def _evaluate(expression: str, constants: dict[str, int]) -> int:
    """Value of an integer expression of the specification's notation.

    Args:
        expression: Numbers and constants joined by ``+ - * <<`` and parentheses.
        constants: The known constants.

    Raises:
        ValueError: If the expression holds anything else or an unknown name.
    """

    def visit(node: ast.expr) -> int:
        match node:
            case ast.Constant(value=int(value)):
                return value
            case ast.Name(id=name) if name in constants:
                return constants[name]
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                return -visit(operand)
            case ast.BinOp(left=left, op=ast.Add(), right=right):
                return visit(left) + visit(right)
            case ast.BinOp(left=left, op=ast.Sub(), right=right):
                return visit(left) - visit(right)
            case ast.BinOp(left=left, op=ast.Mult(), right=right):
                return visit(left) * visit(right)
            case ast.BinOp(left=left, op=ast.LShift(), right=right):
                return visit(left) << visit(right)
        raise ValueError(f"cannot evaluate '{expression}'; define its names or extend the parser")

    try:
        tree = ast.parse(expression.strip(), mode="eval")
    except SyntaxError as error:
        raise ValueError(f"cannot read '{expression}' as an integer expression") from error
    return visit(tree.body)


def _cells(line: str) -> list[str]:
    """The cells of one row of a markdown table, without escapes and code marks."""
    return [
        cell.strip().strip("`").replace("\\", "") for cell in line.strip().strip("|").split("|")
    ]


def _add(constants: dict[str, int], name: str, value: int) -> None:
    if constants.setdefault(name, value) != value:
        raise ValueError(f"{name} is both {constants[name]} and {value}; check the specification")


def _read_symbols(text: str) -> dict[str, int]:
    """Constants of the table of symbols (section 3)."""
    constants: dict[str, int] = {}
    for line in text.splitlines():
        if line.startswith("| `"):
            name, value = _cells(line)[:2]
            _add(constants, name, _evaluate(value, constants))
    return constants


def _read_enumerations(text: str) -> dict[str, int]:
    """Named values of the semantics chapter's tables (section 6).

    A row counts when a cell with a number is followed at once by a cell with a name; a table
    whose rows hold two names (cfl_alpha_signs) names other elements' values and is passed over.
    """
    constants: dict[str, int] = {}
    for line in text.splitlines():
        if not line.startswith("|"):
            continue
        cells = _cells(line)
        names = [_NAME_CELL.fullmatch(cell) for cell in cells]
        found = [
            (match[1], int(cells[i - 1]))
            for i, match in enumerate(names)
            if match and i > 0 and len(match[1]) > 3 and _NUMBER.fullmatch(cells[i - 1])
        ]
        both_signs = sum(match is not None and len(match[1]) > 3 for match in names) > 1
        if found and not both_signs:
            _add(constants, *found[0])
    return constants


def _parse_braces(text: str, start: int, constants: dict[str, int]) -> _Nested:
    """The nested list whose opening brace lies at ``text[start]``."""
    stack: list[list[_Nested]] = []
    position = start
    while match := _TOKEN.match(text, position):
        position = match.end()
        token = match[1].strip()
        if token == "{":
            stack.append([])
        elif token == "}":
            done = stack.pop()
            if not stack:
                return done
            stack[-1].append(done)
        elif token != ",":
            # Split_Tx_Size lacks a comma at the end of a line, so line breaks separate entries as
            # well. The check of the dimensions would detect if this split an entry.
            stack[-1].extend(_evaluate(entry, constants) for entry in token.split("\n"))
    raise ValueError("an array definition has no closing brace; the text is cut short")


def _shape(values: _Nested) -> tuple[int, ...]:
    """Dimensions of a nested list; raises ValueError if it is ragged."""
    if isinstance(values, int):
        return ()
    shapes = {_shape(value) for value in values}
    if len(shapes) != 1:
        raise ValueError("rows differ in length")
    return (len(values), *shapes.pop())


def _rows(values: _Nested) -> Iterator[list[int]]:
    """The innermost rows of a nested list."""
    if isinstance(values, int):
        return
    flat = [value for value in values if isinstance(value, int)]
    if flat:
        yield flat
    for value in values:
        yield from _rows(value)


def _check_cdf(table: _Table) -> None:
    """Raise ValueError unless every row increases up to 32768 and closes with its counter 0."""
    for row in _rows(table.values):
        probabilities, counter = row[:-1], row[-1]
        increasing = all(a < b for a, b in pairwise(probabilities))
        if not increasing or probabilities[0] <= 0 or probabilities[-1] != _CDF_ONE or counter != 0:
            raise ValueError(f"{table.name}: the row {row} is not a CDF; check the specification")


def _used_names() -> set[str]:
    """All words of the core's sources."""
    files = [f for f in _CORE.rglob("*") if f.suffix in (".cc", ".h") and f.name not in _GENERATED]
    return set(re.findall(r"\w+", "\n".join(f.read_text(encoding="utf-8") for f in files)))


def _read_tables(text: str, constants: dict[str, int], used: set[str]) -> list[_Table]:
    """The array definitions of the text with these names in C++.

    They are checked against the dimensions that they state.
    """
    text = _COMMENT.sub("", text)
    tables: list[_Table] = []
    for match in _DEFINITION.finditer(text):
        name = match[1]
        if _cpp_name(name) not in used:
            continue
        try:
            dims = tuple(_evaluate(dim, constants) for dim in _DIMENSION.findall(match[2]))
            values = _parse_braces(text, match.end(), constants)
            shape = _shape(values)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from error
        if shape != dims:
            raise ValueError(f"{name}: stated as {dims} but holds {shape}; check the table")
        table = _Table(name, dims, values)
        if table.is_cdf:
            _check_cdf(table)
        tables.append(table)
    by_name = {table.name: table for table in tables}
    if len(by_name) != len(tables):
        raise ValueError("a table is defined twice; check the specification")
    for name, factor, base in _MULTIPLE.findall(text):
        source = by_name[base]
        values = [int(factor) * value for row in _rows(source.values) for value in row]
        tables.append(_Table(name, source.dims, list(values)))
    return tables


def _wrap(items: Iterable[str], indent: str) -> str:
    """Items joined by commas on lines of at most ``_LINE_LENGTH`` columns."""
    lines: list[str] = []
    line = indent
    for item in items:
        if line.strip() and len(line) + len(item) + 2 > _LINE_LENGTH:
            lines.append(line.rstrip())
            line = indent
        line += f"{item}, "
    lines.append(line.rstrip())
    return "\n".join(lines)


def _format(values: list[_Nested], indent: str, prefix: str) -> str:
    """A brace-enclosed initializer after its prefix; rows that fit stay on one line."""
    lists = [value for value in values if isinstance(value, list)]
    if lists:
        inner = ",\n".join(_format(value, f"{indent}  ", "") for value in lists)
        return f"{indent}{prefix}{{\n{inner},\n{indent}}}"
    items = [str(value) for value in values]
    line = f"{indent}{prefix}{{{', '.join(items)}}}"
    if len(line) < _LINE_LENGTH:
        return line
    return f"{indent}{prefix}{{\n{_wrap(items, f'{indent}  ')}\n{indent}}}"


def _header(tables: list[_Table]) -> str:
    declarations = "\n".join(f"extern const {table.declaration};" for table in tables)
    return (
        f"{_BANNER}\n#pragma once\n\n#include <cstdint>\n\nnamespace colmap_av1::av1 {{\n\n"
        f"{declarations}\n\n}}  // namespace colmap_av1::av1\n"
    )


def _definitions(tables: list[_Table], specifiers: str) -> str:
    definitions = []
    for table in tables:
        if isinstance(table.values, int):
            raise ValueError(f"{table.name} is not an array; check the specification")
        definitions.append(f"{_format(table.values, '', f'{specifiers} {table.declaration} = ')};")
    return "\n\n".join(definitions)


def _source(tables: list[_Table], header_name: str) -> str:
    return (
        f'{_BANNER}\n#include "av1/{header_name}"\n\nnamespace colmap_av1::av1 {{\n\n'
        f"{_definitions(tables, 'const')}\n\n}}  // namespace colmap_av1::av1\n"
    )


def _constexpr_header(tables: list[_Table]) -> str:
    return (
        f"{_BANNER}\n#pragma once\n\n#include <cstdint>\n\nnamespace colmap_av1::av1 {{\n\n"
        f"{_definitions(tables, 'inline constexpr')}\n\n}}  // namespace colmap_av1::av1\n"
    )


def _constants_header(symbols: dict[str, int], enumerations: dict[str, int], used: set[str]) -> str:
    def lines(constants: dict[str, int]) -> str:
        return "\n".join(
            f"inline constexpr int {n} = {v};" for n, v in constants.items() if n in used
        )

    new = {name: value for name, value in enumerations.items() if name not in symbols}
    return (
        f"{_BANNER}\n#pragma once\n\nnamespace colmap_av1::av1 {{\n\n"
        f"// Section 3, symbols and abbreviated terms.\n{lines(symbols)}\n\n"
        f"// Section 6, bitstream semantics.\n{lines(new)}\n\n"
        "}  // namespace colmap_av1::av1\n"
    )


def generate(spec_dir: Path) -> dict[str, str]:
    """Contents of the generated files.

    Args:
        spec_dir: Folder with the specification's markdown chapters.

    Returns:
        The text of each file by its name.

    Raises:
        ValueError: If a table or a constant cannot be read or contradicts its stated dimensions.
        OSError: If a chapter cannot be read.
    """
    symbols = _read_symbols((spec_dir / _SYMBOLS).read_text(encoding="utf-8"))
    enumerations = _read_enumerations((spec_dir / _SEMANTICS).read_text(encoding="utf-8"))
    # This text counts UV_CFL_PRED among the intra modes and starts the inter modes behind it; later
    # editions and every tool that prints YMode start them at 13, where no table indexes them.
    shift = enumerations["NEARESTMV"] - enumerations["UV_CFL_PRED"]
    enumerations = {
        name: value - shift if name.endswith("MV") else value
        for name, value in enumerations.items()
    }
    constants = dict(symbols)
    for name, value in enumerations.items():
        _add(constants, name, value)
    text = "\n".join((spec_dir / name).read_text(encoding="utf-8") for name in _TABLE_CHAPTERS)
    used = _used_names()
    tables = _read_tables(text, constants, used)
    cdfs = [table for table in tables if table.is_cdf]
    others = [table for table in tables if not table.is_cdf]
    return {
        "constants.h": _constants_header(symbols, enumerations, used),
        "default_cdfs.h": _header(cdfs),
        "default_cdfs.cc": _source(cdfs, "default_cdfs.h"),
        "spec_tables.h": _constexpr_header(others),
    }


def main(arguments: list[str]) -> int:
    """Write the generated files next to this script; returns the exit status."""
    if len(arguments) != 1:
        print("usage: python generate_tables.py SPEC_DIR", file=sys.stderr)
        return 2
    try:
        files = generate(Path(arguments[0]))
    except (OSError, ValueError) as error:
        print(f"generate_tables.py: {error}", file=sys.stderr)
        return 1
    for name, text in files.items():
        (Path(__file__).parent / name).write_text(text, encoding="utf-8", newline="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

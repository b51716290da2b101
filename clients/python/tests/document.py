"""Reads PROTOCOL.md: its tables, its fenced blocks and its worked example."""

import json
import re
from pathlib import Path
from typing import Any, NamedTuple

PROTOCOL = (Path(__file__).parents[3] / "PROTOCOL.md").read_text()


class Field(NamedTuple):
    """A row of a byte table."""

    offset: int
    size: int
    of: str
    name: str


class Layout(NamedTuple):
    """A struct of section 3."""

    type_name: str
    size: int
    alignment: int
    format: str
    fields: list[Field]


def layouts() -> dict[str, Layout]:
    """Returns every struct of section 3 by name."""
    heading = r"^### (\w+): `(.+?)`, (\d+) bytes, alignment (\d+), struct `(.+?)`$"
    found: dict[str, Layout] = {}
    for match in re.finditer(heading, PROTOCOL, re.MULTILINE):
        rows = _rows(PROTOCOL[match.end() :], "| offset |")
        fields = [Field(int(row[0]), int(row[1]), row[2], row[3]) for row in rows]
        name, type_name, size, alignment, struct = match.groups()
        found[name] = Layout(type_name, int(size), int(alignment), struct, fields)
    return found


def table(header: str) -> list[list[str]]:
    """Returns the cells of each row of the only table whose header line begins with `header`."""
    assert PROTOCOL.count(f"\n{header}") == 1
    return _rows(PROTOCOL, header)


def limits() -> dict[str, int]:
    return {name: int(value) for name, value, _ in table("| limit | value |")}


def examples() -> list[dict[str, Any]]:
    blocks = re.findall(r"^```json\n(.*?)^```", PROTOCOL, re.MULTILINE | re.DOTALL)
    return [json.loads(line) for block in blocks for line in block.splitlines()]


def worked_example(name: str) -> tuple[bytes, list[tuple[str, str]]]:
    """Returns a message of section 12: its bytes, and the names and values next to them."""
    found = re.search(rf"^```hex {name}\n(.*?)^```", PROTOCOL, re.MULTILINE | re.DOTALL)
    assert found
    message, values = b"", list[tuple[str, str]]()
    for line in found[1].splitlines():
        numbers, _, words = line.partition("  | ")
        offset, _, text = numbers.partition("  ")
        assert int(offset, 16) == len(message), line
        message += bytes.fromhex(text)
        pairs = (word.partition(" = ") for word in words.split(", "))
        values += [(name, value) for name, _, value in pairs]
    return message, values


def _rows(text: str, header: str) -> list[list[str]]:
    lines = text[text.index(f"\n{header}") + 1 :].splitlines()[2:]
    cells = [[cell.strip(" `") for cell in line.split("|")[1:-1]] for line in lines]
    end = next((i for i, line in enumerate(lines) if not line.startswith("|")), len(lines))
    return cells[:end]

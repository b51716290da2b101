"""The reference client in `tests/` has the layouts of PROTOCOL.md."""

import ctypes
import sys
from pathlib import Path

import document
import pytest

sys.path.append(str(Path(__file__).parents[3] / "tests"))

wire_reference = pytest.importorskip("wire_reference", exc_type=ImportError)


def test_its_layouts_match_the_document() -> None:
    layouts = document.layouts()
    for name, (layout, fields) in wire_reference.LAYOUTS.items():
        expected = layouts[name]
        assert (layout, fields.split()) == (expected.format, [it.name for it in expected.fields])
        if name.endswith(("Request", "Reply")):
            header = wire_reference.header_type(name)
            assert header.type_name() == expected.type_name
            assert ctypes.sizeof(header) == expected.size

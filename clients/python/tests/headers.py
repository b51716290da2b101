"""Builds headers of samples as bytes, from the fields that PROTOCOL.md lists."""

import document

LAYOUTS = document.layouts()


def header(name: str, *, result: bytes = bytes(64), **fields: int) -> bytes:
    """Returns the bytes of a header. Fields that are not given are 0."""
    layout, given = LAYOUTS[name], {"version": 3} | fields
    assert given.keys() <= {field.name for field in layout.fields}
    return b"".join(
        result
        if field.name == "result"
        else given.get(field.name, 0).to_bytes(field.size, "little")
        for field in layout.fields
    )

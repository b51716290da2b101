"""Conversion of file paths between Python's text and the UTF-8 that other programs use."""

import os
import sys
from typing import Any, Final, cast

import emberwatch._native as _native
from emberwatch.errors import invalid, repr_of, shortened

#: Character that editors on Windows write at the beginning of UTF-8 text.
BYTE_ORDER_MARK: Final = "\ufeff"


def utf8(subject: str, path: str | os.PathLike[str]) -> str:
    """Checks a path, and converts it to UTF-8, which GDAL and other programs read in any locale."""
    try:
        text = os.fsencode(path).decode()
    except TypeError:
        raise invalid(subject, "text or a path", repr_of(path)) from None
    except UnicodeError:
        text = "\0"
    if "\0" in text:
        expected = "UTF-8, and a locale that has its letters, such as LC_ALL=C.UTF-8"
        raise invalid(subject, expected, shortened(ascii(os.fspath(path))))
    return text


def absolute(name: Any) -> Any:
    """Makes the path of a file absolute, as a policy may change the folder; other values stay."""
    if not isinstance(name, (str, os.PathLike)):
        return name
    path = os.fspath(cast("str | os.PathLike[str]", name))
    is_built_in = any(path in _native.built_in(kind) for kind in ("models", "tasks", "states"))
    return os.path.abspath(path) if os.path.exists(path) and not is_built_in else path


def shown(text: str) -> str:
    """Escapes characters that standard output cannot write, for example in undecodable paths."""
    encoding = sys.stdout.encoding or "utf-8"
    try:
        text.encode(encoding, sys.stdout.errors or "strict")
    except UnicodeEncodeError:
        return text.encode(encoding, "backslashreplace").decode(encoding)
    return text

"""Conversion of file paths between Python's text and the UTF-8 that other programs use."""

import os
import sys
from collections.abc import Mapping
from typing import Any, Final, cast

import emberwatch._native as _native
from emberwatch.errors import invalid, repr_of, shortened

#: Character that editors on Windows write at the beginning of UTF-8 text.
BYTE_ORDER_MARK: Final = "\ufeff"

#: Keywords that name files, or a built-in task, model or recorded world.
_OF_FILES: Final = frozenset({"task", "model", "states", "checkpoint"})


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


def with_absolute_paths(keywords: Mapping[str, Any]) -> dict[str, Any]:
    """Returns keywords with absolute paths of files, as the program may change its folder."""
    return {name: absolute(it) if name in _OF_FILES else it for name, it in keywords.items()}


def absolute(name: Any) -> Any:
    """Makes the path of a file absolute. Other values stay, also in a folder that is not UTF-8."""
    if not isinstance(name, (str, os.PathLike)):
        return name
    path = os.fspath(cast("str | os.PathLike[str]", name))
    is_built_in = any(path in _native.built_in(kind) for kind in ("models", "tasks", "states"))
    if is_built_in or not os.path.exists(path):
        return path
    whole = os.path.abspath(path)
    try:
        os.fsencode(whole).decode()
    except UnicodeError:
        return path
    return whole


def shown(text: str) -> str:
    """Escapes characters that standard output cannot write, for example in undecodable paths."""
    encoding = sys.stdout.encoding or "utf-8"
    try:
        text.encode(encoding, sys.stdout.errors or "strict")
    except UnicodeEncodeError:
        return text.encode(encoding, "backslashreplace").decode(encoding)
    return text

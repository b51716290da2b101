"""Paths as they are outside Python, where they are bytes."""

import os
import sys
from typing import Final

from emberwatch.errors import invalid

#: What editors on Windows write before text in UTF-8.
BYTE_ORDER_MARK: Final = "\ufeff"


def utf8(subject: str, path: str | os.PathLike[str]) -> str:
    """Checks a path, and encodes it as UTF-8 in any locale, as programs and GDAL read it."""
    try:
        text = os.fsencode(path).decode()
    except TypeError:
        raise invalid(subject, "text or a path", repr(path)) from None
    except UnicodeError:
        text = "\0"
    if "\0" in text:
        expected = "UTF-8, and a locale that has its letters, such as LC_ALL=C.UTF-8"
        raise invalid(subject, expected, ascii(os.fspath(path)))
    return text


def local(text: str) -> str:
    """A path in UTF-8, as programs tell it, as Python takes it in this locale."""
    return os.fsdecode(text.encode())


def shown(text: str) -> str:
    """The text with escapes for what standard output cannot write, such as paths of other bytes."""
    encoding = sys.stdout.encoding or "utf-8"
    try:
        text.encode(encoding, sys.stdout.errors or "strict")
    except UnicodeEncodeError:
        return text.encode(encoding, "backslashreplace").decode(encoding)
    return text

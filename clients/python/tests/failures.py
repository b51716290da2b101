"""Context managers that expect an error, by its code or its message."""

import pytest

from emberwatch.errors import EmberwatchError, InvalidArgumentError


def fails(code: str, match: str | None = None) -> pytest.RaisesExc[EmberwatchError]:
    return pytest.raises(EmberwatchError, match=match, check=lambda error: error.code == code)


def refuses(match: str) -> pytest.RaisesExc[InvalidArgumentError]:
    return pytest.raises(InvalidArgumentError, match=match)

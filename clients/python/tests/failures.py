"""What the tests expect to fail, by the error's code."""

import pytest

from emberwatch.errors import EmberwatchError, InvalidArgumentError


def fails(code: str, match: str | None = None) -> pytest.RaisesExc[EmberwatchError]:
    return pytest.raises(EmberwatchError, match=match, check=lambda error: error.code == code)


def refuses(match: str) -> pytest.RaisesExc[InvalidArgumentError]:
    return pytest.raises(InvalidArgumentError, match=match)

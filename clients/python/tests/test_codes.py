"""The error codes in the package's README, in the docstring, and in the code are the same."""

import re
from pathlib import Path

import emberwatch
from emberwatch.errors import EmberwatchError

PYTHON = Path(__file__).parents[1]


def test_the_documented_error_codes_match_the_code() -> None:
    page = (PYTHON / "README.md").read_text("utf-8")
    table = page.split("| exception | when |")[1].split("\n\n")[0]
    cells = [line.split("|")[1] for line in table.splitlines() if line.count("|") > 2]
    of_page = {code for cell in cells for code in re.findall(r'`"(\w+)"`', cell)}
    of_classes = {each.code for each in EmberwatchError.__subclasses__()}
    described = set(re.findall(r'``?"(\w+)"`', EmberwatchError.__doc__ or ""))
    # The docstring names one status as an example.
    assert of_page == described - {"busy"}
    files = [*Path(emberwatch.__file__).parent.rglob("*.py"), *(PYTHON / "native").rglob("*.rs")]
    named = {code for file in files for code in re.findall(r'"(\w+)"', file.read_text("utf-8"))}
    assert of_page | of_classes <= named
    for kind in EmberwatchError.__subclasses__():
        assert f"| `{kind.__name__}` |" in page

"""The rooms of the package: each imports only from those before it in this list."""

import re
from pathlib import Path

import emberwatch

ROOMS = (
    "errors common model belief planning client render envs wrappers sb3 landscape benchmark"
).split()

PACKAGE = Path(emberwatch.__file__).parent


def room_of(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported(text: str) -> list[str]:
    """The rooms that a file imports from, also inside its functions."""
    direct = re.findall(r"^ *from emberwatch\.(\w+)", text, re.M)
    listed = re.findall(r"^ *from emberwatch import (\w+(?:, \w+)*)$", text, re.M)
    return direct + [name for names in listed for name in names.split(", ")]


def test_every_entry_is_a_room() -> None:
    entries = {room_of(path) for path in PACKAGE.rglob("*.py")}
    assert entries == {*ROOMS, "__init__", "__main__"}
    assert len(ROOMS) <= 12


def test_no_import_climbs() -> None:
    climbs = [
        f"{path.relative_to(PACKAGE)} imports {other}"
        for path in PACKAGE.rglob("*.py")
        if room_of(path) in ROOMS
        for other in imported(path.read_text("utf-8"))
        if other in ROOMS and ROOMS.index(other) > ROOMS.index(room_of(path))
    ]
    assert climbs == []

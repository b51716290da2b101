"""`python -m emberwatch.landscape`: converts rasters of fires to a recorded world."""

import argparse
import sys
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from emberwatch.common.output import end_with_reader
from emberwatch.common.paths import shown, utf8
from emberwatch.errors import EmberwatchError, InvalidArgumentError
from emberwatch.landscape import land
from emberwatch.landscape.fire import BURNING, BURNT, KINDS, UNBURNT, Meaning, states, times
from emberwatch.landscape.flags import Parser, add_common, of_flags, several, whole
from emberwatch.landscape.grid import Place, check_alike
from emberwatch.landscape.inputs import read, stacks
from emberwatch.landscape.layers import Choice
from emberwatch.landscape.lengths import side
from emberwatch.landscape.order import ORDERS
from emberwatch.landscape.schedule import length
from emberwatch.landscape.world import Fill, arrays, check_outputs, description, write

_NAME: Final = "python -m emberwatch.landscape"
#: Flags that apply only to some values of `--kind`.
_ONLY_FOR: Final = {
    "begin": ("arrival",),
    "year_days": ("arrival",),
    "time_column": ("arrival",),
    "burning": ("arrival", "mask"),
    "codes": ("states",),
    "every": ("mask", "burning", "states"),
    "missing_is_unburnt": ("mask", "burning", "states"),
}

_BEGIN: Final = several(
    float,
    "a number in the unit of arrival times (for dates, seconds since 1970: date -ud DATE +%s)",
    lambda it: len(it) == 1 and np.isfinite(it).all(),
)
_CODES: Final = several(
    float,
    "three different numbers",
    lambda it: np.isfinite(it).all() and len(it) == len({*it}) == 3,
)
_CROP: Final = several(
    int, "TOP,LEFT,HEIGHT,WIDTH, four whole numbers", lambda it: len(it) == 4 and 0 <= min(it)
)


def main(arguments: Sequence[str] | None = None) -> None:
    """Converts the rasters that the flags name; exits with code 2 and a message on an error.

    If the first word is `land`, makes a model file instead. An input folder of that name must be
    written `./land`.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments[:1] == ["land"]:
        return land.main(arguments[1:])
    parser = _parser()
    flags = parser.parse_args(arguments)
    try:
        _import(flags)
    except (EmberwatchError, OSError) as error:
        parser.error(str(error))


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog=_NAME,
        description="Make a recorded world for `emberwatch-server --states` from rasters, "
        "perimeters or detections of a fire. docs/landscapes.md describes formats and flags.",
        epilog="`python -m emberwatch.landscape land` makes a model from elevation, wind and fuel.",
    )
    add = parser.add_argument
    add("inputs", type=Path, nargs="+", metavar="IN", help="files, or a folder for each sequence")
    add("--out", type=Path, required=True, metavar="FILE.npz", help="also writes FILE.toml")
    add("--kind", required=True, choices=KINDS, help="meaning of the numbers in the files")
    add("--step", required=True, metavar="TIME", help="duration of a step, such as '10 min'")
    add("--unit", choices=("ms", "s", "min", "h", "d"), help="unit of times [the file's]")
    add("--begin", type=_BEGIN, metavar="X", help="arrival time of step 0 [the earliest]")
    add("--year-days", type=whole, metavar="N", help="days of the year before New Year")
    add("--burning", type=whole, metavar="N", help="steps that a cell burns (arrival, mask)")
    add("--every", type=whole, metavar="N", help="make a step of every N-th layer [1]")
    add("--codes", type=_CODES, metavar="U,B,D", help="codes of unburnt, burning, burnt [0,1,2]")
    add("--crop", type=_CROP, metavar="TOP,LEFT,HEIGHT,WIDTH", help="part of the input to use")
    add("--height", type=whole, metavar="N", help="rows of the world [the input's]")
    add("--width", type=whole, metavar="N", help="columns of the world [the input's]")
    add("--cell", metavar="METRES", help="side of the world's cells, such as 30 or '98.4 ft'")
    add("--resample", choices=("earliest", "nearest"), default="earliest", help="[earliest]")
    add("--oblong", action="store_true", help="treat cells that are not square as squares")
    add("--mixed", action="store_true", help="allow sequences whose cells differ on the ground")
    add("--missing-is-unburnt", action="store_true", help="cells without a value are unburnt")
    add("--time-column", metavar="NAME", help="column with the times of perimeters")
    add("--order", choices=ORDERS, help="numbers or dates by which a folder's files are sorted")
    add("--picture", type=Path, metavar="FILE.png", help="draw the result")
    add_common(parser)
    return parser


def _import(flags: argparse.Namespace) -> None:
    meaning = _meaning(flags)
    name = utf8("--name", flags.name or flags.out.stem)
    check_outputs(flags.out, flags.picture, force=flags.force)
    if flags.picture is not None and find_spec("PIL") is None:
        raise InvalidArgumentError("--picture: expected Pillow; pip install emberwatch[landscape]")
    is_arrival = meaning.kind == "arrival"
    choice = of_flags(Choice, flags)
    choice = choice if is_arrival else replace(choice, cell=None)
    sequences, begins, notes = list[NDArray[np.uint8]](), list[str | None](), list[str]()
    first: Place | None = None
    for stack in stacks(flags.inputs, one_file_each=is_arrival, order=flags.order):
        notes += stack.notes
        with closing(read(stack.files, choice)) as layers:
            fire = times(layers, meaning)
        first = first or fire.place
        check_alike(fire.place, fire.name, first, mixed=flags.mixed)
        sequences.append(states(fire))
        begins.append(fire.begin)
        notes += [f"{fire.name}: {note}" for note in fire.notes]
    text = description(name, flags.step, begins).encode()
    description_file = flags.out.with_suffix(".toml")
    contents: dict[Path, Fill] = {
        flags.out: arrays(sequences),
        description_file: lambda file: file.write(text),
    }
    if flags.picture is not None:
        from emberwatch.landscape.picture import draw

        image = draw(sequences, name)
        contents[flags.picture] = lambda file: image.save(file, "PNG")
    write(contents)
    for note in notes:
        print(shown(note))
    for states_of_fire in sequences:
        print(_summary(states_of_fire))
    if first is not None and flags.cell is not None and first.ground() is None:
        print(
            "assumed that cells are measured in metres, as the files name no unit; with --height N "
            "no unit is needed"
        )
    n_bytes = flags.out.stat().st_size
    summary = f"{flags.out}: {n_bytes} bytes, sequences: {len(sequences)}; {description_file}"
    print(shown(summary))


def _meaning(flags: argparse.Namespace) -> Meaning:
    for name, kinds in _ONLY_FOR.items():
        given = getattr(flags, name)
        if flags.kind not in kinds and given is not None and given is not False:
            flag = name.replace("_", "-")
            raise InvalidArgumentError(
                f"--{flag}: applies only with --kind {' or '.join(kinds)}, got --kind {flags.kind}"
            )
    if flags.kind in _ONLY_FOR["burning"] and flags.burning is None:
        raise InvalidArgumentError(
            f"--burning: required with --kind {flags.kind}: the number of steps that a cell burns"
        )
    if flags.cell is not None and (flags.height, flags.width) != (None, None):
        raise InvalidArgumentError("--cell: cannot be combined with --height or --width")
    flags.begin = None if flags.begin is None else flags.begin[0]
    flags.cell = None if flags.cell is None else side("--cell", flags.cell).metres
    flags.nodata = tuple(flags.nodata or ())
    flags.seconds = length(flags.step)
    flags.burning, flags.every = flags.burning or 1, flags.every or 1
    flags.codes = flags.codes or (UNBURNT, BURNING, BURNT)
    return of_flags(Meaning, flags)


def _summary(sequence: NDArray[np.uint8]) -> str:
    n_steps, height, width = sequence.shape
    burning = (sequence == BURNING).sum(axis=(1, 2))
    burnt = (sequence[-1] >= BURNING).mean()
    alight = [-1, *np.flatnonzero(burning).tolist()]
    gaps = [f"{end + 1} to {begin - 1}" for end, begin in pairwise(alight) if begin > end + 1]
    warning = f"\nwarning: no cell burns in steps {', '.join(gaps[:9])}" if gaps else ""
    return (
        f"{n_steps} steps of {height} x {width} cells: at most {burning.max()} burn, "
        f"at step {burning.argmax()}; {100 * burnt:.1f} % have burnt at the end{warning}"
    )


if __name__ == "__main__":
    end_with_reader()
    main()

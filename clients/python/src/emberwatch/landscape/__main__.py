"""`python -m emberwatch.landscape`: converts rasters of fires to a recorded world."""

import argparse
import sys
from collections.abc import Sequence
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from emberwatch.common.output import Parser, end_with_reader, number
from emberwatch.common.paths import shown
from emberwatch.errors import EmberwatchError, InvalidArgumentError, invalid
from emberwatch.landscape import land
from emberwatch.landscape.fire import BURNING, BURNT, UNBURNT, states, times
from emberwatch.landscape.flags import METRES, WHOLE, add_common
from emberwatch.landscape.inputs import read, stacks
from emberwatch.landscape.times import length
from emberwatch.landscape.world import check_new, write

#: Flags that apply only to some values of `--kind`.
_ONLY_FOR: Final = {
    "begin": ("arrival",),
    "time_column": ("arrival",),
    "burning": ("arrival", "mask"),
    "codes": ("states",),
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Converts the rasters that the flags name; exits with code 2 and a message on an error.

    If the first word is `land`, makes a model file instead. An input folder of that name must be
    written `./land`.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    is_land = arguments[:1] == ["land"]
    parser = land.parser() if is_land else _parser()
    flags = parser.parse_args(arguments[is_land:])
    try:
        flags.act(flags)
    except (EmberwatchError, OSError) as error:
        parser.error(str(error))


def _parser() -> Parser:
    parser = Parser(
        prog="python -m emberwatch.landscape",
        description="Make a recorded world for `emberwatch-server --states` from rasters, "
        "perimeters or detections of a fire. docs/landscapes.md describes formats and flags.",
        epilog="`python -m emberwatch.landscape land` makes a model from elevation, wind and fuel.",
    )
    add = parser.add_argument
    add("inputs", type=Path, nargs="+", metavar="IN", help="files, or a folder for each sequence")
    add("--out", type=Path, required=True, metavar="FILE.npz", help="also writes FILE.toml")
    add(
        "--kind",
        required=True,
        choices=("arrival", "mask", "burning", "states"),
        help="meaning of the numbers in the files",
    )
    add("--step", required=True, metavar="TIME", help="duration of a step, such as '10 min'")
    add("--unit", choices=("ms", "s", "min", "h", "d"), help="unit of times [the file's]")
    add(
        "--begin",
        type=number(float, -(10**18), 10**18),
        metavar="X",
        help="arrival time of step 0 [the earliest]",
    )
    add("--burning", type=WHOLE, metavar="N", help="steps that a cell burns (arrival, mask)")
    add("--codes", type=_codes, metavar="U,B,D", help="codes of unburnt, burning, burnt [0,1,2]")
    add("--height", type=WHOLE, metavar="N", help="rows of the world [the input's]")
    add("--cell", type=METRES, metavar="METRES", help="side of the world's cells on the ground")
    add("--time-column", metavar="NAME", help="column with the times of perimeters")
    add_common(parser)
    parser.set_defaults(act=_import)
    return parser


def _import(flags: argparse.Namespace) -> None:
    _check(flags)
    check_new(".npz", flags.out, flags.out.with_suffix(".toml"), force=flags.force)
    is_arrival = flags.kind == "arrival"
    sequences, begins, notes = list[NDArray[np.uint8]](), list[str | None](), list[str]()
    for files in stacks(flags.inputs, one_file_each=is_arrival):
        with closing(read(files, flags)) as layers:
            fire = times(layers, flags)
        sequences.append(states(fire))
        begins.append(fire.begin)
        if sequences[-1].shape[1:] != sequences[0].shape[1:]:
            expected = f"{sequences[0].shape[1:]} cells as in the first sequence"
            raise invalid(fire.name, expected, f"{sequences[-1].shape[1:]}; use --height")
        if len(files) > 1:
            notes.append(f"{len(files)} files in this order: {files[0]} to {files[-1]}")
        notes += [f"{fire.name}: {note}" for note in fire.notes]
    write(flags.out, sequences, flags.step, begins)
    for line in (*notes, *map(_summary, sequences)):
        print(shown(line))
    print(shown(f"{flags.out}: {flags.out.stat().st_size} bytes, sequences: {len(sequences)}"))


def _check(flags: argparse.Namespace) -> None:
    for name, kinds in _ONLY_FOR.items():
        if flags.kind not in kinds and getattr(flags, name) is not None:
            flag = name.replace("_", "-")
            raise InvalidArgumentError(
                f"--{flag}: applies only with --kind {' or '.join(kinds)}, got --kind {flags.kind}"
            )
    if flags.kind in _ONLY_FOR["burning"] and flags.burning is None:
        raise InvalidArgumentError(
            f"--burning: required with --kind {flags.kind}: the number of steps that a cell burns"
        )
    if None not in (flags.cell, flags.height):
        raise InvalidArgumentError("--cell: cannot be combined with --height")
    flags.seconds, flags.codes = length(flags.step), flags.codes or (UNBURNT, BURNING, BURNT)


def _codes(text: str) -> tuple[float, ...]:
    try:
        codes = tuple(map(float, text.split(",")))
    except ValueError:
        codes = ()
    if len(codes) != 3 or len({*codes}) != 3:
        raise argparse.ArgumentTypeError(f"expected three different numbers, got {text}")
    return codes


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

"""`python -m emberwatch.landscape land`: makes a model with maps of slope, wind and fuel."""

import argparse
import io
from collections.abc import Sequence
from contextlib import closing
from itertools import islice
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from emberwatch._native import MAX_ARCHIVE_BYTES, MAX_MAP_VALUES, MAX_SIDE
from emberwatch.common.paths import shown, utf8
from emberwatch.errors import EmberwatchError, InvalidArgumentError, invalid
from emberwatch.landscape.compass import POINTS, bearing
from emberwatch.landscape.elevation import slopes
from emberwatch.landscape.flags import Parser, add_common, several
from emberwatch.landscape.grid import check_same
from emberwatch.landscape.inputs import read, stacks
from emberwatch.landscape.layers import Choice, Layer, check_full
from emberwatch.landscape.lengths import METRES, side
from emberwatch.landscape.terrain import model_text, slope_and_wind
from emberwatch.landscape.world import Fill, check_new, write

_NAME: Final = "python -m emberwatch.landscape land"
_MOST_NUMBER: Final = 10**15  # maximum class of fuel; doubles represent all integers up to it
_MOST_FACTOR: Final = 1e6  # maximum factor of a map
_MOST_WIND: Final = 100.0  # maximum wind speed, m/s: more than any hurricane
_CLASSES: Final = several(int, "whole numbers", bool)


def main(arguments: Sequence[str]) -> None:
    """Makes the model file that the flags describe; exits with code 2 and a message on an error."""
    parser = _parser()
    flags = parser.parse_args(arguments)
    try:
        _make(flags)
    except (EmberwatchError, OSError) as error:
        parser.error(str(error))


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog=_NAME,
        description="Make a model file with maps from rasters. docs/land.md describes the flags.",
    )
    add = parser.add_argument
    add("elevation", type=Path, nargs="?", metavar="ELEVATION", help="raster of heights")
    add("--out", type=Path, required=True, metavar="FILE.toml", help="its maps go to FILE.npz")
    add("--cell", metavar="METRES", help="side of a cell, if the raster does not state it")
    add("--height-unit", choices=tuple(METRES), help="unit of the heights [the raster's, or m]")
    add("--oblong", action="store_true", help="allow cells that are not square or differ in size")
    add("--wind-speed", type=float, default=0.0, metavar="M/S", help="speed of the wind [0]")
    add("--wind-towards", type=float, metavar="DEGREES", help="0 is to the east, 90 to the north")
    add("--wind-from", metavar="POINT|DEGREES", help="instead, as in weather reports, such as NNE")
    add("--fuel", type=Path, metavar="RASTER", help="whole numbers, each a class of fuel")
    add("--factors", type=_factors, metavar="N=X,N=X", help="factors of the hazard of classes [1]")
    add("--unburnable", type=_CLASSES, metavar="N,N", help="classes of --fuel that never burn")
    add("--missing-class", type=int, metavar="N", help="class of cells without a value in --fuel")
    add("--no-fly", type=Path, metavar="RASTER", help="a number above 0 is a no-fly cell")
    add_common(parser)
    return parser


def _make(flags: argparse.Namespace) -> None:
    _check_flags(flags)
    name = utf8("--name", flags.name or flags.out.stem)
    check_new("--out", flags.out, force=flags.force)
    layers = _layers(flags)
    shape = next(iter(layers.values())).place.shape
    rise, notes = np.zeros((2, *shape)), list[str]()
    if "elevation" in layers:
        given = {"cell": flags.cell, "height_unit": flags.height_unit, "oblong": flags.oblong}
        rise, notes = slopes(layers["elevation"], **given)
    maps = {"slope_wind": slope_and_wind(rise, flags.wind_speed, flags.wind_towards)}
    if "fuel" in layers:
        maps = {"fuel": _fuel(flags, layers["fuel"])} | maps
    maps = {key: _rounded(factors) for key, factors in maps.items() if (factors != 1.0).any()}
    contents = _files(flags, maps, layers.get("no_fly"))
    files = {key: utf8("--out", file.name) for key, (file, _) in contents.items()}
    comments = "".join(f"# {line}\n" for line in (_origin(flags, layers), *notes))
    text = f"{comments}\n{model_text(name, files, list(maps))}".encode()
    fills: dict[Path, Fill] = dict(contents.values())
    fills[flags.out] = lambda file: file.write(text)
    write(fills)
    height, width = shape
    print(shown(f"{flags.out}: {height} x {width} cells, maps: {', '.join(maps) or 'none'}"))
    for note in notes:
        print(shown(f"{flags.elevation}: {note}"))
    if "no_fly" in layers:
        print(shown(f"{flags.no_fly}: {_no_fly_summary(layers['no_fly'])}"))


def _check_flags(flags: argparse.Namespace) -> None:
    if flags.out.suffix != ".toml":
        raise invalid("--out", "a .toml file", flags.out)
    if (flags.elevation, flags.fuel, flags.no_fly) == (None, None, None):
        raise invalid("rasters", "at least one of ELEVATION, --fuel and --no-fly", "none")
    needs = dict.fromkeys(("cell", "height_unit", "oblong"), "elevation")
    needs |= dict.fromkeys(("factors", "unburnable", "missing_class"), "fuel")
    for flag, needed in needs.items():
        value = getattr(flags, flag)
        if value is not None and value is not False and getattr(flags, needed) is None:
            word = "ELEVATION" if needed == "elevation" else "--fuel"
            raise InvalidArgumentError(f"--{flag.replace('_', '-')}: applies only with {word}")
    if flags.fuel is not None and (flags.factors, flags.unburnable) == (None, None):
        raise invalid("--fuel", "--factors or --unburnable with it", "neither")
    flags.cell = None if flags.cell is None else side("--cell", flags.cell)
    if flags.missing_class is not None and abs(flags.missing_class) > _MOST_NUMBER:
        raise invalid("--missing-class", f"at most {_MOST_NUMBER}", flags.missing_class)
    _check_wind(flags)


def _check_wind(flags: argparse.Namespace) -> None:
    """Checks the wind's flags, and sets `wind_towards` from the one that is given."""
    if not 0.0 <= flags.wind_speed <= _MOST_WIND:
        raise invalid("--wind-speed", f"0 to {_MOST_WIND:g} m/s", flags.wind_speed)
    if None not in (flags.wind_towards, flags.wind_from):
        raise invalid("wind", "--wind-towards or --wind-from", "both")
    if flags.wind_from is not None:
        degrees = bearing(flags.wind_from)
        if degrees is None or not -360.0 <= degrees <= 360.0:
            expected = f"one of {', '.join(POINTS)}, or -360 to 360 degrees"
            raise invalid("--wind-from", expected, f"'{flags.wind_from}'")
        flags.wind_towards = (270.0 - degrees) % 360.0
    if (flags.wind_speed > 0.0) != (flags.wind_towards is not None):
        both = "both a --wind-speed above 0 and --wind-from (or --wind-towards)"
        raise invalid("wind", f"{both}, or neither", "only one of them")
    flags.wind_towards = flags.wind_towards or 0.0
    if not -360.0 <= flags.wind_towards <= 360.0:
        raise invalid("--wind-towards", "-360 to 360 degrees", flags.wind_towards)


def _layers(flags: argparse.Namespace) -> dict[str, Layer]:
    """Reads the rasters, by the names of their flags; refuses rasters on different grids."""
    choice = Choice(variable=flags.variable, band=flags.band, nodata=tuple(flags.nodata or ()))
    layers = dict[str, Layer]()
    for key in ("elevation", "fuel", "no_fly"):
        file = getattr(flags, key)
        if file is not None:
            layers[key] = layer = _layer(file, choice)
            first = next(iter(layers.values()))
            check_same(layer.place, layer.name, first.place, first.name)
    return layers


def _fuel(flags: argparse.Namespace, layer: Layer) -> NDArray[np.float64]:
    """Returns the factor of each cell's class of fuel, shape (H, W)."""
    classes, places = np.unique(_whole(layer, flags.missing_class), return_inverse=True)
    table: dict[int, float] = dict(flags.factors or {})
    table |= dict.fromkeys(flags.unburnable or (), 0.0)
    missing = set(table).difference(classes.tolist())
    if missing:
        expected = f"classes that occur in {flags.fuel}"
        raise invalid("--factors and --unburnable", expected, min(missing))
    is_named = np.isin(layer.values, list(table))
    _check_codes(layer, is_named, "give --nodata if it means no value, or name it in --factors")
    factors = np.array([table.get(one, 1.0) for one in classes.tolist()])
    return factors[places].reshape(layer.place.shape)


def _rounded(factors: NDArray[np.float64]) -> NDArray[np.float32]:
    """Rounds to three digits, because no factor is known more precisely."""
    digits = 10.0 ** (2 - np.floor(np.log10(np.where(factors > 0.0, factors, 1.0))))
    return (np.rint(factors * digits) / digits).astype(np.float32)


def _files(
    flags: argparse.Namespace, maps: dict[str, NDArray[np.float32]], no_fly: Layer | None
) -> dict[str, tuple[Path, Fill]]:
    """Returns the files next to the model file and their contents, by key of the model file."""
    files = dict[str, tuple[Path, Fill]]()
    if maps:
        archive, n_values = io.BytesIO(), sum(factors.size for factors in maps.values())
        np.savez_compressed(archive, **maps)  # pyright: ignore
        content = archive.getvalue()
        if n_values > MAX_MAP_VALUES or len(content) > MAX_ARCHIVE_BYTES:
            expected = f"maps of at most {MAX_MAP_VALUES} values in {MAX_ARCHIVE_BYTES} bytes"
            raise invalid("--out", expected, f"{n_values} values in {len(content)} bytes")
        files["maps"] = flags.out.with_suffix(".npz"), lambda file: file.write(content)
    if no_fly is not None:
        remedy = "give --nodata if it means no value"
        _check_codes(no_fly, np.zeros(no_fly.values.shape, np.bool_), remedy)
        # Cells without a value are free, because rasters made from polygons have none outside them.
        cells = np.nan_to_num(no_fly.values, nan=0.0) != 0.0
        if cells.all():
            raise invalid(no_fly.name, "a cell of 0, where robots may be", "none")
        files["no_fly"] = flags.out.with_suffix(".no_fly.npy"), lambda file: np.save(file, cells)
    for file, _ in files.values():
        check_new("--out", file, force=flags.force)
    return files


def _no_fly_summary(layer: Layer) -> str:
    missing = np.isnan(layer.values)
    n_closed = np.count_nonzero(layer.values[~missing])
    free = f"; {missing.sum()} of the other cells have no value" if missing.any() else ""
    return f"{n_closed} no-fly cells{free}"


def _layer(file: Path, choice: Choice) -> Layer:
    (stack,) = stacks([file], one_file_each=False)
    with closing(read(stack.files, choice)) as layers:
        found = list(islice(layers, 2))
    if len(found) != 1:
        raise invalid(file, "one layer", "several; choose with --band" if found else "none")
    (layer,) = found
    height, width = layer.place.shape
    if max(height, width) > MAX_SIDE:
        most = f"at most {MAX_SIDE} x {MAX_SIDE} cells, the server's maximum"
        raise invalid(layer.name, most, f"{height} x {width}")
    return layer


def _check_codes(layer: Layer, is_named: NDArray[np.bool_], remedy: str) -> None:
    """Refuses numbers below 0, which mostly mean "no value", unless a flag names them."""
    wrong = layer.values[(layer.values < 0) & ~is_named]
    if wrong.size:
        raise invalid(layer.name, "numbers of at least 0", f"{wrong[0]:g}; {remedy}")


def _whole(layer: Layer, missing_class: int | None) -> NDArray[np.int64]:
    if missing_class is None:
        check_full(layer, "a number in each cell", "--missing-class N gives them the class N")
    values = np.nan_to_num(layer.values, nan=missing_class or 0)
    wrong = values[(values % 1 != 0) | (np.abs(values) > _MOST_NUMBER)]
    if wrong.size:
        raise invalid(layer.name, "whole numbers, each a class of fuel", wrong[0])
    return values.astype(np.int64)


def _origin(flags: argparse.Namespace, layers: dict[str, Layer]) -> str:
    """Returns a comment that names the sources of the file."""
    files = ", ".join(ascii(getattr(flags, key).name) for key in layers)
    wind = f"{flags.wind_speed:g} m/s towards {flags.wind_towards:g} degrees"
    return f"{_NAME}: {files}; wind of {wind}"


def _factors(text: str) -> dict[int, float]:
    try:
        pairs = [part.split("=") for part in text.split(",")]
        table = {int(one): float(factor) for one, factor in pairs}
    except ValueError:
        table = {0: -1.0}
    if not all(0.0 <= factor <= _MOST_FACTOR for factor in table.values()):
        expected = f"classes with factors of 0 to {_MOST_FACTOR:g}, such as 1=0.5,2=3"
        raise argparse.ArgumentTypeError(f"expected {expected}, got {text}")
    return table

"""`python -m emberwatch.landscape land`: makes a model with maps of slope, wind and fuel."""

import argparse
import io
from contextlib import closing
from itertools import islice
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from emberwatch._native import MAX_ARCHIVE_BYTES, MAX_MAP_VALUES, MAX_SIDE
from emberwatch.common.output import Parser, number
from emberwatch.common.paths import shown, utf8
from emberwatch.errors import InvalidArgumentError, invalid
from emberwatch.landscape.flags import METRES, add_common
from emberwatch.landscape.grid import check_same
from emberwatch.landscape.inputs import read, stacks
from emberwatch.landscape.layers import Layer, check_full
from emberwatch.landscape.terrain import UNITS, model_text, slope_and_wind, slopes
from emberwatch.landscape.world import check_new

_NAME: Final = "python -m emberwatch.landscape land"
_MOST_FACTOR: Final = 1e6  # maximum factor of a map
_POINTS: Final = tuple("N NNE NE ENE E ESE SE SSE S SSW SW WSW W WNW NW NNW".split())


def parser() -> Parser:
    """Returns the parser of the command."""
    made = Parser(
        prog=_NAME,
        description="Make a model file with maps from rasters. docs/land.md describes the flags.",
    )
    add = made.add_argument
    add("elevation", type=Path, nargs="?", metavar="ELEVATION", help="raster of heights")
    add("--out", type=Path, required=True, metavar="FILE.toml", help="its maps go to FILE.npz")
    add("--cell", type=METRES, metavar="METRES", help="side of a cell without a projection")
    add("--height-unit", choices=tuple(UNITS), help="unit of the heights [the raster's, or m]")
    add(
        "--wind-speed",
        type=number(float, 0, 100, "metres per second"),
        default=0.0,
        metavar="M/S",
        help="speed of the wind [0]",
    )
    add("--wind-from", type=_bearing, metavar="POINT|DEGREES", help="such as NNE, or 22.5")
    add("--fuel", type=Path, metavar="RASTER", help="whole numbers, each a class of fuel")
    add("--factors", type=_factors, metavar="N=X,N=X", help="factors of the hazard of classes [1]")
    add("--no-fly", type=Path, metavar="RASTER", help="a number above 0 is a no-fly cell")
    add_common(made)
    made.set_defaults(kind=None, act=make, time_column=None)
    return made


def make(flags: argparse.Namespace) -> None:
    """Makes the model file that the flags describe."""
    _check_flags(flags)
    out: Path = flags.out
    maps_file, no_fly_file = out.with_suffix(".npz"), out.with_suffix(".no_fly.npy")
    check_new(".toml", out, maps_file, no_fly_file, force=flags.force)
    layers = _layers(flags)
    shape = next(iter(layers.values())).place.shape
    rise, notes = np.zeros((2, *shape)), list[str]()
    if "elevation" in layers:
        given = {"cell": flags.cell, "height_unit": flags.height_unit, "oblong": flags.oblong}
        rise, notes = slopes(layers["elevation"], **given)
    towards = (270.0 - (flags.wind_from or 0.0)) % 360.0
    maps = {"slope_wind": slope_and_wind(rise, flags.wind_speed, towards)}
    if "fuel" in layers:
        maps = {"fuel": _fuel(flags, layers["fuel"])} | maps
    maps = {key: _rounded(factors) for key, factors in maps.items() if (factors != 1.0).any()}
    archive = _archive(maps)
    no_fly = _no_fly(layers["no_fly"]) if "no_fly" in layers else None
    names = {"maps": maps_file} if maps else {}
    names |= {} if no_fly is None else {"no_fly": no_fly_file}
    files = {key: utf8("--out", file.name) for key, file in names.items()}
    comments = "".join(f"# {line}\n" for line in (_origin(flags, layers), *notes))
    text = f"{comments}\n{model_text(utf8('--out', out.stem), files, list(maps))}"
    out.parent.mkdir(parents=True, exist_ok=True)
    if maps:
        maps_file.write_bytes(archive)
    if no_fly is not None:
        np.save(no_fly_file, no_fly)
    out.write_text(text, "utf-8")
    height, width = shape
    print(shown(f"{out}: {height} x {width} cells, maps: {', '.join(maps) or 'none'}"))
    for note in notes:
        print(shown(f"{flags.elevation}: {note}"))


def _check_flags(flags: argparse.Namespace) -> None:
    if (flags.elevation, flags.fuel, flags.no_fly) == (None, None, None):
        raise invalid("rasters", "at least one of ELEVATION, --fuel and --no-fly", "none")
    if (flags.fuel is None) != (flags.factors is None):
        raise invalid("--fuel", "both --fuel and --factors, or neither", "only one of them")
    if flags.elevation is None and (flags.cell, flags.height_unit) != (None, None):
        raise InvalidArgumentError("--cell and --height-unit: apply only with ELEVATION")
    if (flags.wind_speed > 0.0) != (flags.wind_from is not None):
        both = "both a --wind-speed above 0 and --wind-from"
        raise invalid("wind", f"{both}, or neither", "only one of them")


def _layers(flags: argparse.Namespace) -> dict[str, Layer]:
    """Reads the rasters, by the names of their flags; refuses rasters on different grids."""
    layers = dict[str, Layer]()
    for key in ("elevation", "fuel", "no_fly"):
        file = getattr(flags, key)
        if file is not None:
            layers[key] = layer = _layer(file, flags)
            first = next(iter(layers.values()))
            check_same(layer.place, layer.name, first.place, first.name)
    return layers


def _layer(file: Path, flags: argparse.Namespace) -> Layer:
    (files,) = stacks([file], one_file_each=False)
    with closing(read(files, flags)) as layers:
        found = list(islice(layers, 2))
    if len(found) != 1:
        raise invalid(file, "one layer", "several; choose with --band")
    (layer,) = found
    height, width = layer.place.shape
    if max(height, width) > MAX_SIDE:
        most = f"at most {MAX_SIDE} x {MAX_SIDE} cells, the server's maximum"
        raise invalid(layer.name, most, f"{height} x {width}")
    return layer


def _fuel(flags: argparse.Namespace, layer: Layer) -> NDArray[np.float64]:
    """Returns the factor of each cell's class of fuel, shape (H, W)."""
    check_full(layer, "a class in each cell", "gdal_edit.py -unsetnodata makes it a class")
    table: dict[int, float] = flags.factors
    classes, places = np.unique(layer.values, return_inverse=True)
    missing = set(table).difference(classes.tolist())
    if missing:
        raise invalid("--factors", f"classes that occur in {flags.fuel}", min(missing))
    wrong = classes[(classes % 1 != 0) | ((classes < 0) & ~np.isin(classes, list(table)))]
    if wrong.size:
        remedy = "give --nodata if it means no value, or name it in --factors"
        expected = "whole numbers of at least 0, each a class of fuel"
        raise invalid(layer.name, expected, f"{wrong[0]:g}; {remedy}")
    factors = np.array([table.get(one, 1.0) for one in classes.tolist()])
    return factors[places].reshape(layer.place.shape)


def _no_fly(layer: Layer) -> NDArray[np.bool_]:
    """Returns the no-fly cells. Rasters of polygons have no value outside: these cells are free."""
    wrong = layer.values[layer.values < 0]
    if wrong.size:
        remedy = "give --nodata if it means no value"
        raise invalid(layer.name, "numbers of at least 0", f"{wrong[0]:g}; {remedy}")
    return np.nan_to_num(layer.values, nan=0.0) != 0.0


def _rounded(factors: NDArray[np.float64]) -> NDArray[np.float32]:
    """Rounds to three digits, because no factor is known more precisely."""
    digits = 10.0 ** (2 - np.floor(np.log10(np.where(factors > 0.0, factors, 1.0))))
    return (np.rint(factors * digits) / digits).astype(np.float32)


def _archive(maps: dict[str, NDArray[np.float32]]) -> bytes:
    """Returns the bytes of the archive of maps, which has the limits of a model file."""
    archive, n_values = io.BytesIO(), sum(factors.size for factors in maps.values())
    np.savez_compressed(archive, **maps)  # pyright: ignore
    content = archive.getvalue()
    if n_values > MAX_MAP_VALUES or len(content) > MAX_ARCHIVE_BYTES:
        expected = f"maps of at most {MAX_MAP_VALUES} values in {MAX_ARCHIVE_BYTES} bytes"
        raise invalid("--out", expected, f"{n_values} values in {len(content)} bytes")
    return content


def _origin(flags: argparse.Namespace, layers: dict[str, Layer]) -> str:
    """Returns a comment that names the sources of the file."""
    files = ", ".join(ascii(getattr(flags, key).name) for key in layers)
    wind = f"wind of {flags.wind_speed:g} m/s"
    from_ = "" if flags.wind_from is None else f" from {flags.wind_from:g} degrees"
    return f"{_NAME}: {files}; {wind}{from_}"


def _bearing(text: str) -> float:
    """Parses a compass point, or degrees clockwise from the north."""
    if text.upper() in _POINTS:
        return _POINTS.index(text.upper()) * 360 / len(_POINTS)
    try:
        degrees = float(text)
    except ValueError:
        degrees = np.nan
    if not -360.0 <= degrees <= 360.0:
        expected = f"one of {', '.join(_POINTS)}, or -360 to 360 degrees"
        raise argparse.ArgumentTypeError(f"expected {expected}, got {text}")
    return degrees


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

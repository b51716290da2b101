"""`python -m emberwatch.landscape land`: makes a model file with zones of elevation and wind."""

import argparse
import tomllib
from collections.abc import Sequence
from contextlib import closing
from itertools import islice
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from emberwatch._native import MAX_SIDE
from emberwatch.common.paths import shown, utf8
from emberwatch.errors import EmberwatchError, InvalidArgumentError, invalid
from emberwatch.landscape.compass import POINTS, bearing
from emberwatch.landscape.elevation import slopes
from emberwatch.landscape.grid import check_same
from emberwatch.landscape.inputs import read, stacks
from emberwatch.landscape.layers import Choice, Layer
from emberwatch.landscape.lengths import METRES, side
from emberwatch.landscape.terrain import Zone, zones
from emberwatch.landscape.world import Fill, check_new, write
from emberwatch.landscape.zoned import Table, check_base, kernels, toml
from emberwatch.model import Model

_NAME: Final = "python -m emberwatch.landscape land"
_EXAMPLES: Final = """
examples:
  # Fire climbs slopes, and follows a wind of 5 m/s to the east-north-east:
  python -m emberwatch.landscape land dem.tif --wind-speed 5 --wind-towards 20 --out hills.toml
  # Heights in feet, and a wind from the west-south-west:
  python -m emberwatch.landscape land dem.tif --height-unit ft --wind-speed 5 --wind-from WSW \\
      --out hills.toml
  # Your own zones, with rivers in zones 7 and 8, and no-fly cells over towns:
  python -m emberwatch.landscape land --zones fuel.tif --unburnable 7,8 --no-fly towns.tif \\
      --out fuels.toml
"""
#: Maximum number of cells of a map inside the model file, whose maximum size is 16 MiB. Larger maps
#: are written to a `.npy` file.
_MOST_INLINE: Final = 1 << 16
_MOST_NUMBER: Final = 10**15  # maximum number of a zone; doubles represent all integers up to it
_MOST_WIND: Final = 100.0  # maximum wind speed, m/s: more than any hurricane


def main(arguments: Sequence[str]) -> None:
    """Makes the model file that the flags describe; exits with code 2 and a message on an error."""
    parser = _parser()
    flags = parser.parse_args(arguments)
    try:
        _make(flags)
    except (EmberwatchError, OSError) as error:
        parser.exit(2, f"{_NAME}: {error}\n")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=_NAME,
        description="Make a model file with zones from rasters: GeoTIFF (.tif), ESRI ASCII grid "
        "(.asc), NetCDF (.nc) or NumPy (.npy, .npz). docs/land.md describes the rules and "
        "the formula.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("elevation", type=Path, nargs="?", metavar="ELEVATION", help="raster of heights")
    add("--out", type=Path, required=True, metavar="FILE.toml", help="the model file")
    add(
        "--cell",
        metavar="METRES",
        help="side of a cell on the ground, if the raster does not state it; '98.4 ft' for feet",
    )
    add(
        "--height-unit",
        choices=tuple(METRES),
        help="unit of the heights [the raster's, or m]",
    )
    add("--oblong", action="store_true", help="allow cells that are not square or differ in size")
    add("--slope-step", type=float, metavar="DEGREES", help="width of the classes of slope [5]")
    add("--wind-speed", type=float, default=0.0, metavar="M/S", help="speed of the wind [0]")
    add(
        "--wind-towards",
        type=float,
        metavar="DEGREES",
        help="direction to which the wind blows, in degrees from the east towards the north: 0 is "
        "to the east, 90 to the north",
    )
    add(
        "--wind-from",
        metavar="POINT|DEGREES",
        help="instead of --wind-towards: where the wind comes from, as in weather reports: N, "
        "NNE, ..., or degrees clockwise from the north",
    )
    add("--zones", type=Path, metavar="RASTER", help="whole numbers, each a separate zone")
    add(
        "--missing-zone",
        type=int,
        metavar="N",
        help="zone of the cells that have no value in --zones",
    )
    add("--unburnable", type=_values, metavar="N,N", help="zones of --zones that never burn")
    add(
        "--no-fly",
        type=Path,
        metavar="RASTER",
        help="cells with a number other than 0 are no-fly cells",
    )
    add(
        "--model",
        default="wildfire-burnout",
        metavar="NAME|FILE",
        help="the base model, whose kernels are adapted to each zone [wildfire-burnout]",
    )
    add("--state", metavar="NAME", help="the state that spreads [the one that pays most]")
    add(
        "--base-wind",
        action="store_true",
        help="keep the base model's preferred directions. Without this flag, ELEVATION or wind "
        "replace them: neighbours at the same distance first get the mean of their weights",
    )
    add("--variable", metavar="NAME", help="the variable, if a NetCDF or .npz file has several")
    add("--band", type=int, metavar="N", help="the band, if a raster has several")
    add("--nodata", type=float, action="append", metavar="X", help="a number that means no value")
    add("--name", help="name of the model [the output file's]")
    add("--force", action="store_true", help="replace the output")
    return parser


def _make(flags: argparse.Namespace) -> None:
    _check_flags(flags)
    name = utf8("--name", flags.name or flags.out.stem)
    check_new("--out", flags.out, force=flags.force)
    base, layers = _base(flags), _layers(flags)
    slope = None
    if "elevation" in layers:
        slope = slopes(
            layers["elevation"],
            cell=flags.cell,
            height_unit=flags.height_unit,
            oblong=flags.oblong,
        )
    cells, found = _zones(flags, layers, None if slope is None else slope.rise)
    is_changed = flags.elevation is not None or flags.wind_speed > 0.0
    check_base(base, found, flags.state, is_changed=is_changed)
    maps = {"zone_map": cells} | _no_fly(layers)
    contents = dict[Path, Fill]()
    model: Table = {"name": name, "kernel_size": base["kernel_size"]}
    model |= {key: _map(key, array, flags, contents) for key, array in maps.items()}
    model |= {"zones": [{"name": zone.name, "color": zone.color} for zone in found]}
    model |= {key: value for key, value in base.items() if key not in ("name", "kernel")}
    wind, is_even = (flags.wind_speed, flags.wind_towards), is_changed and not flags.base_wind
    entries = [kernels(base, zone, flags.state, *wind, is_even=is_even) for zone in found]
    model |= {"kernel": [entry for some in entries for entry in some]}
    notes = [] if slope is None else slope.notes
    comments = "".join(f"# {line}\n" for line in (_origin(flags, layers), *notes))
    text = f"{comments}\n{toml(model)}".encode()
    contents[flags.out] = lambda file: file.write(text)
    write(contents)
    height, width = cells.shape
    print(shown(f"{flags.out}: {height} x {width} cells, zones: {len(found)}"))
    for note in notes:
        print(shown(f"{flags.elevation}: {note}"))
    if "no_fly" in layers:
        print(shown(f"{flags.no_fly}: {_no_fly_summary(layers['no_fly'])}"))


def _check_flags(flags: argparse.Namespace) -> None:
    if flags.out.suffix != ".toml":
        raise invalid("--out", "a .toml file", flags.out)
    if (flags.elevation, flags.zones, flags.no_fly) == (None, None, None):
        raise InvalidArgumentError(
            "rasters: expected at least one of ELEVATION, --zones and --no-fly, got none"
        )
    needs = dict.fromkeys(("cell", "height_unit", "oblong", "slope_step"), "elevation")
    needs |= dict.fromkeys(("unburnable", "missing_zone"), "zones")
    for flag, needed in needs.items():
        value = getattr(flags, flag)
        if value is not None and value is not False and getattr(flags, needed) is None:
            word = "ELEVATION" if needed == "elevation" else "--zones"
            raise InvalidArgumentError(f"--{flag.replace('_', '-')}: applies only with {word}")
    flags.slope_step = 5.0 if flags.slope_step is None else flags.slope_step
    if not 0.1 <= flags.slope_step <= 90.0:
        raise invalid("--slope-step", "0.1 to 90 degrees", flags.slope_step)
    flags.cell = None if flags.cell is None else side("--cell", flags.cell)
    if flags.missing_zone is not None and abs(flags.missing_zone) > _MOST_NUMBER:
        raise invalid("--missing-zone", f"at most {_MOST_NUMBER}", flags.missing_zone)
    _check_wind(flags)


def _check_wind(flags: argparse.Namespace) -> None:
    """Checks the wind's flags, and sets `wind_towards` from the one that is given."""
    if not 0.0 <= flags.wind_speed <= _MOST_WIND:
        raise invalid("--wind-speed", f"0 to {_MOST_WIND:g} m/s", flags.wind_speed)
    if None not in (flags.wind_towards, flags.wind_from):
        raise InvalidArgumentError("wind: expected --wind-towards or --wind-from, got both")
    if flags.wind_from is not None:
        degrees = bearing(flags.wind_from)
        if degrees is None or not -360.0 <= degrees <= 360.0:
            expected = f"one of {', '.join(POINTS)}, or -360 to 360 degrees"
            raise invalid("--wind-from", expected, f"'{flags.wind_from}'")
        flags.wind_towards = (270.0 - degrees) % 360.0
    if (flags.wind_speed > 0.0) != (flags.wind_towards is not None):
        raise InvalidArgumentError(
            "wind: expected both a --wind-speed above 0 and --wind-from (or --wind-towards), or "
            "neither, got only one of them"
        )
    flags.wind_towards = flags.wind_towards or 0.0
    if not -360.0 <= flags.wind_towards <= 360.0:
        raise invalid("--wind-towards", "-360 to 360 degrees", flags.wind_towards)


def _base(flags: argparse.Namespace) -> Table:
    """Returns the base model's file; sets `flags.state` to the state that spreads."""
    model = Model.named(flags.model)
    if flags.state is None:
        flags.state = model.state_names[model.target_state]
        if not model.reward.max() > 0.0:
            raise invalid("--state", "the state that spreads, as no state pays", "none")
    return tomllib.loads(model.toml)


def _layers(flags: argparse.Namespace) -> dict[str, Layer]:
    """Reads the rasters, by the names of their flags; refuses rasters on different grids."""
    choice = Choice(variable=flags.variable, band=flags.band, nodata=tuple(flags.nodata or ()))
    layers = dict[str, Layer]()
    for key in ("elevation", "zones", "no_fly"):
        file = getattr(flags, key)
        if file is not None:
            layers[key] = layer = _layer(file, choice)
            _check_grid(layer, next(iter(layers.values())))
    return layers


def _check_grid(layer: Layer, first: Layer) -> None:
    (height, width), (rows, columns) = first.place.shape, layer.place.shape
    if (height, width) != (rows, columns):
        expected = f"{height} x {width} cells as in {first.name}"
        raise invalid(layer.name, expected, f"{rows} x {columns}")
    # NumPy files do not state the positions of their cells.
    if layer.place.corner is not None and first.place.corner is not None:
        check_same(layer.place, layer.name, first.place, first.name)


def _zones(
    flags: argparse.Namespace, layers: dict[str, Layer], rise: NDArray[np.float64] | None
) -> tuple[NDArray[np.uint8], list[Zone]]:
    """Computes the zone of each cell, and the zones."""
    values = _whole(layers["zones"], flags.missing_zone) if "zones" in layers else None
    unburnable = flags.unburnable or ()
    missing = set(unburnable).difference(() if values is None else values.flat)
    if missing:
        raise invalid("--unburnable", f"values that occur in {flags.zones}", min(missing))
    shape = next(iter(layers.values())).place.shape
    return zones(rise, values, shape=shape, step=flags.slope_step, unburnable=unburnable)


def _no_fly(layers: dict[str, Layer]) -> dict[str, NDArray[np.uint8]]:
    """Returns the map of no-fly cells, by its key in the model file.

    Cells without a value are free, because rasters made from polygons have no values outside them.
    """
    if "no_fly" not in layers:
        return {}
    cells = np.nan_to_num(layers["no_fly"].values, nan=0.0) != 0.0
    if cells.all():
        raise invalid(layers["no_fly"].name, "a cell of 0, where robots may be", "none")
    return {"no_fly": cells.astype(np.uint8)}


def _no_fly_summary(layer: Layer) -> str:
    missing = np.isnan(layer.values)
    n_closed = np.count_nonzero(layer.values[~missing])
    free = f"; {missing.sum()} of the other cells have no value" if missing.any() else ""
    return f"{n_closed} no-fly cells{free}"


def _layer(file: Path, choice: Choice) -> Layer:
    (files,) = stacks([file], one_file_each=False)
    with closing(read(files, choice)) as layers:
        found = list(islice(layers, 2))
    if len(found) != 1:
        raise invalid(file, "one layer", "several; choose with --band" if found else "none")
    (layer,) = found
    height, width = layer.place.shape
    if max(height, width) > MAX_SIDE:
        most = f"at most {MAX_SIDE} x {MAX_SIDE} cells, the server's maximum"
        raise invalid(layer.name, most, f"{height} x {width}")
    return layer


def _whole(layer: Layer, missing_zone: int | None) -> NDArray[np.int64]:
    missing = np.isnan(layer.values)
    if missing.any() and missing_zone is None:
        row, column = np.argwhere(missing)[0].tolist()
        got = f"none in {missing.sum()} cells, the first in row {row}, column {column}"
        remedy = "--missing-zone N gives them the number N"
        raise invalid(layer.name, "a number in each cell", f"{got}; {remedy}")
    values = np.where(missing, missing_zone or 0, layer.values)
    wrong = values[(values % 1 != 0) | (np.abs(values) > _MOST_NUMBER)]
    if wrong.size:
        raise invalid(layer.name, "whole numbers, each a zone", wrong[0])
    return values.astype(np.int64)


def _map(
    key: str, cells: NDArray[np.uint8], flags: argparse.Namespace, contents: dict[Path, Fill]
) -> list[list[int]] | str:
    """Returns the value of a map in the model file: its rows, or the name of a file if it is large.

    Adds that file to `contents`.
    """
    if cells.size <= _MOST_INLINE:
        return cells.tolist()
    file = flags.out.with_suffix(f".{key}.npy")
    check_new("--out", file, force=flags.force)
    contents[file] = lambda opened: np.save(opened, cells)
    return utf8("--out", file.name)


def _origin(flags: argparse.Namespace, layers: dict[str, Layer]) -> str:
    """Returns a comment that names the sources of the file."""
    files = ", ".join(ascii(getattr(flags, key).name) for key in layers)
    wind = f"{flags.wind_speed:g} m/s towards {flags.wind_towards:g} degrees"
    return f"{_NAME}: {files}; model {ascii(flags.model)}; wind of {wind}"


def _values(text: str) -> tuple[int, ...]:
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected whole numbers, got {text}") from None

"""Decoding of the packed numbers of a NetCDF variable, from its attributes."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from emberwatch.errors import invalid
from emberwatch.landscape.layers import is_missing
from emberwatch.landscape.libraries import library

Attributes = Mapping[str, Any]

_ROUNDED: Final = 1e-3  # tolerance for rounded unpacked limits, as a share of the scale factor


def attributes(variable: Any) -> dict[str, Any]:
    """Returns all attributes of a variable."""
    return {name: variable.getncattr(name) for name in variable.ncattrs()}


@np.errstate(over="ignore", invalid="ignore")
def unpacked(
    name: str, stored: NDArray[Any], given: Attributes, nodata: Sequence[float] = ()
) -> NDArray[np.float64]:
    """Decodes packed numbers; NaN for missing numbers and numbers beyond a limit."""
    if stored.dtype.kind not in "iuf":
        raise invalid(name, "real numbers", stored.dtype)
    stored, given = _signed(name, stored, given)
    fills = [*_numbers(name, given, "_FillValue"), *_numbers(name, given, "missing_value", None)]
    missing = is_missing(stored, [*nodata, *fills])
    scale, offset = _numbers(name, given, "scale_factor"), _numbers(name, given, "add_offset")
    packed = stored.astype(np.float64)
    values = packed * (scale[0] if scale.size else 1.0) + (offset[0] if offset.size else 0.0)
    wide = np.result_type(*scale, *offset) if scale.size or offset.size else None
    for key, limit, sign in _limits(name, given):
        # The type of a limit shows whether it is a packed or an unpacked number.
        are_whole = {limit.dtype.kind, stored.dtype.kind} <= {"i", "u"}
        if wide is not None and limit.dtype == wide != stored.dtype:
            slack = _ROUNDED * abs(float(scale[0])) if scale.size else 0.0
            slack += float(np.finfo(wide).eps * abs(limit)) if wide.kind == "f" else 0.0
            missing |= sign * values > sign * float(limit) + slack
        elif wide is None or are_whole or limit.dtype == stored.dtype:
            limit = stored.dtype.type(limit) if stored.dtype.kind == "f" else limit
            missing |= sign * packed > sign * float(limit)
        else:
            expected = f"the type of the numbers, {stored.dtype}, or of scale_factor, {wide}"
            raise invalid(f"{name}, {key}", expected, limit.dtype)
    values[missing] = np.nan
    return values


def _signed(name: str, stored: NDArray[Any], given: Attributes) -> tuple[NDArray[Any], Attributes]:
    """Returns numbers and attributes in native byte order, signed or not as `_Unsigned` states."""
    stored = stored.astype(stored.dtype.newbyteorder("="), copy=False)
    kind = stored.dtype
    if kind.itemsize > 1:  # the default fill value; single bytes have none
        fill = library("netCDF4", name).default_fillvals[kind.str[1:]]
        given = {"_FillValue": np.array(fill, kind)} | dict(given)
    sign = {"true": "u", "false": "i"}.get(str(given.get("_Unsigned")).lower())
    if sign is None or kind.kind == "f":
        return stored, given
    signed = f"{sign}{kind.itemsize}"
    return stored.view(signed), {
        key: value.view(signed) if getattr(value, "dtype", None) == kind else value
        for key, value in given.items()
    }


def _limits(name: str, given: Attributes) -> Iterator[tuple[str, Any, int]]:
    """Yields the limits: attribute, number, and 1 for an upper limit or -1 for a lower one."""
    both = _numbers(name, given, "valid_range", 2)
    if both.size == 1:
        raise invalid(f"{name}, valid_range", "two numbers", both[0])
    yield from (("valid_range", limit, sign) for limit, sign in zip(both, (-1, 1), strict=False))
    for key, sign in (("valid_min", -1), ("valid_max", 1)):
        yield from ((key, limit, sign) for limit in _numbers(name, given, key))


def _numbers(name: str, given: Attributes, key: str, most: int | None = 1) -> NDArray[Any]:
    found = np.atleast_1d(given.get(key, np.empty(0)))
    if found.dtype.kind not in "iuf" or (most is not None and found.size > most):
        raise invalid(f"{name}, {key}", "a number" if most == 1 else "numbers", given[key])
    return found

"""Digests of policies: whether rows in a file are of the same policy, as far as can be seen.

Nothing is pickled, nothing is changed, and whatever cannot be read counts by its type's name alone.
What a function reads from elsewhere, such as a file, cannot be seen.
"""

from __future__ import annotations

import hashlib
import sys
import sysconfig
from collections.abc import Callable, Iterable, Mapping
from enum import Enum
from functools import partial
from pathlib import PurePath
from types import BuiltinFunctionType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

#: Values within values, and in all, beyond which types' names alone count.
_DEPTH: Final = 24
_PARTS: Final = 50_000

_SIMPLE: Final = (bool, int, float, complex, str, bytes, range, type(None), type(...), PurePath)
_SEQUENCES: Final = (list, tuple)

#: Methods that return all weights of a model: of Stable-Baselines3, PyTorch, Keras.
_WEIGHTS: Final = ("get_parameters", "state_dict", "get_weights")

#: What a class has besides what its author wrote.
_OF_CLASSES: Final = frozenset(
    ("__annotations__", "__dict__", "__doc__", "__firstlineno__", "__module__", "__qualname__")
    + ("__static_attributes__", "__weakref__", "_abc_impl")
)

#: Where libraries are.
_STANDARD: Final = sysconfig.get_path("stdlib") + "/"
_PACKAGES: Final = frozenset(("site-packages", "dist-packages"))


def digest(value: object) -> str:
    """Returns 16 hexadecimal digits that differ where two values can be seen to differ.

    Of a model they cover its weights, of a function its code, defaults, closure and the globals
    that it names, of another object its attributes: numbers, strings, arrays and what has these.
    """
    return _Walk().of(value, 0).hex()[:16]


class _Walk:
    """One walk over a value and what it refers to."""

    def __init__(self) -> None:
        #: Digests of the objects met so far; of those still open, how deep they are.
        self._known: dict[int, bytes] = {}
        #: Keeps objects, so that no two have one identity.
        self._met: list[object] = []

    def of(self, value: object, depth: int) -> bytes:
        """Returns the digest of a value."""
        if isinstance(value, _SIMPLE) and not isinstance(value, Enum):
            return _sha(type(value).__name__, repr(value))
        if id(value) in self._known:
            return self._known[id(value)]
        self._met.append(value)
        self._known[id(value)] = _sha("above", str(depth))
        found = _sha("type", _name(type(value)))
        if depth < _DEPTH and len(self._met) < _PARTS:
            try:
                found = self._look(value, depth + 1)
            except Exception:  # of any kind: it is whatever the object's own code raises
                pass
        self._known[id(value)] = found
        return found

    def _look(self, value: Any, depth: int) -> bytes:
        kind = cast("type[Any]", type(value))
        array = _array(value)
        if array is not None:
            return self._array(array, depth)
        if isinstance(value, Mapping):
            items = cast("Mapping[object, object]", value).items()
            pairs = (self.of(key, depth) + self.of(part, depth) for key, part in items)
            return _sha("mapping", *sorted(pairs))
        if isinstance(value, _SEQUENCES):
            parts = list(cast("Iterable[object]", value))
            if all(type(part) in _SIMPLE for part in parts):  # there may be millions
                return _sha("sequence", repr(parts))
            return self._all("sequence", parts, depth)
        if isinstance(value, set | frozenset):
            members = (self.of(part, depth) for part in cast("Iterable[object]", value))
            return _sha("set", *sorted(members))
        if isinstance(value, Enum | ModuleType | np.dtype):
            return _sha(_name(kind), str(cast("Any", value)))
        if isinstance(value, CodeType):
            shape = (value.co_code, value.co_flags, value.co_argcount, value.co_kwonlyargcount)
            names = (value.co_names, value.co_varnames, value.co_freevars)
            return self._all("code", (*shape, *names, value.co_consts), depth)
        if isinstance(value, FunctionType):
            return self._all("function", _of_function(value), depth)
        if isinstance(value, MethodType | BuiltinFunctionType):
            function = getattr(value, "__func__", value.__qualname__)
            return self._all("method", (function, value.__self__), depth)
        if isinstance(value, partial):
            given = cast("partial[Any]", value)
            return self._all("partial", (given.func, given.args, given.keywords), depth)
        if isinstance(value, type):
            return self._all(_name(value), (_of_class(value), value.__bases__), depth)
        # What a decorator has made, such as one that compiles or caches.
        wrapped = getattr(value, "__wrapped__", None)
        return self._all("object", (kind, wrapped, _of_object(value)), depth)

    def _all(self, kind: str, parts: Iterable[object], depth: int) -> bytes:
        return _sha(kind, *(self.of(part, depth) for part in parts))

    def _array(self, array: NDArray[Any], depth: int) -> bytes:
        form = f"{array.dtype.str} {array.shape}"
        if array.dtype.hasobject:
            return self._all(form, array.ravel().tolist(), depth)
        flat = np.ascontiguousarray(array).reshape(-1)
        return _sha("array", form, flat.view(np.uint8).data)


def _array(value: Any) -> NDArray[Any] | None:
    """Returns the array that a value of any library is; None: it is none."""
    kind = cast("type[Any]", type(value))
    if isinstance(value, np.ndarray | np.generic):
        return np.asarray(cast("Any", value))
    if callable(getattr(kind, "detach", None)) and callable(getattr(kind, "cpu", None)):
        tensor = value.detach().cpu()
        try:
            return np.asarray(tensor)
        except TypeError:  # NumPy has no bfloat16
            return np.asarray(tensor.float())
    return np.asarray(value) if hasattr(kind, "__array__") else None


def _of_function(function: FunctionType) -> Iterable[object]:
    """What a function does and reads."""
    yield function.__defaults__
    yield function.__kwdefaults__
    for cell in function.__closure__ or ():
        yield _cell(cell)
    if _is_installed(function.__module__):
        yield _name(function)
        return
    yield function.__code__
    for name in sorted(_names(function.__code__) & function.__globals__.keys()):
        yield name
        yield function.__globals__[name]


def _cell(cell: Any) -> object:
    try:
        return cell.cell_contents
    except ValueError:  # nothing is assigned yet
        return None


def _names(code: CodeType) -> set[str]:
    """Returns the names that some code and the functions in it look up."""
    inner = (_names(each) for each in code.co_consts if isinstance(each, CodeType))
    return set(code.co_names).union(*inner)


def _of_class(kind: type) -> dict[str, object]:
    """What the author of a class wrote; of an installed one its name says enough."""
    if _is_installed(kind.__module__):
        return {}
    written = {name: part for name, part in vars(kind).items() if name not in _OF_CLASSES}
    return {name: _plain(part) for name, part in written.items()}


def _plain(part: Any) -> object:
    """Returns the functions behind a property, class method or static method."""
    if isinstance(part, property):
        return (part.fget, part.fset)
    return getattr(part, "__func__", part)


def _of_object(value: Any) -> object:
    """What makes one object different from another of its type."""
    kind = cast("type[Any]", type(value))
    for method in _WEIGHTS:
        if callable(getattr(kind, method, None)):
            return _weights(method, getattr(value, method)()), _settings(value)
    # Not what a method of its own returns: it may do anything.
    default: Callable[[Any], object] = object.__getstate__
    is_plain = kind.__getstate__ is default
    state: object = default(value) if is_plain else getattr(value, "__dict__", None)
    if not _is_installed(kind.__module__):
        return state
    # Objects of libraries refer to much that is none of the policy's, such as loggers to others.
    return {name: part for name, part in _attributes(state) if _is_data(part)}


def _weights(method: str, weights: object) -> object:
    """The weights without an optimizer's state, which no action depends on."""
    if method != "get_parameters" or not isinstance(weights, Mapping):
        return weights
    given = cast("Mapping[object, object]", weights)
    return {name: part for name, part in given.items() if "optimizer" not in str(name)}


def _settings(model: Any) -> object:
    """What the actions of a model depend on besides its weights."""
    modules: Any = getattr(model, "modules", None)
    parts = cast("Iterable[object]", modules() if callable(modules) else ())
    rate = getattr(model, "exploration_rate", None)
    return [(type(part), _numbers(part)) for part in parts], rate


def _numbers(module: object) -> dict[str, object]:
    """The settings of one module of PyTorch; predictions themselves switch `training`."""
    return {
        name: value
        for name, value in vars(module).items()
        if not name.startswith("_") and name != "training" and isinstance(value, _SIMPLE)
    }


def _attributes(state: object) -> Iterable[tuple[str, object]]:
    """The attributes in a state of `object.__getstate__`: of the dictionary and of slots."""
    parts = cast("tuple[object, ...]", state) if isinstance(state, tuple) else (state,)
    for part in parts:
        if isinstance(part, dict):
            yield from cast("dict[str, object]", part).items()


def _is_data(value: object) -> bool:
    kinds = (*_SIMPLE, *_SEQUENCES, np.ndarray, np.generic)
    return isinstance(value, kinds) or any(hasattr(type(value), each) for each in _WEIGHTS)


def _is_installed(module: object) -> bool:
    """Whether code is of a library or of this package: then its name stands for it."""
    root = str(module).partition(".")[0]
    file = getattr(sys.modules.get(str(module)), "__file__", None)
    if not isinstance(file, str):
        return root in sys.stdlib_module_names
    is_library = file.startswith(_STANDARD) or not _PACKAGES.isdisjoint(PurePath(file).parts)
    return root == "emberwatch" or is_library


def _name(value: Any) -> str:
    return f"{value.__module__}.{value.__qualname__}"


def _sha(*parts: str | bytes | memoryview) -> bytes:
    """The hash of some parts, each with its length."""
    whole = hashlib.sha256()
    for part in parts:
        bytes_ = part.encode("utf-8", "surrogatepass") if isinstance(part, str) else part
        whole.update(len(bytes_).to_bytes(8, "little"))
        whole.update(bytes_)
    return whole.digest()

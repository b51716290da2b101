"""Digests of policies, to detect whether rows in a file come from the same policy.

Computing a digest neither pickles nor changes a value. If a value cannot be read, only the name of
its type is hashed. Data that a function reads at run time, such as a file, is not hashed.
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

#: Maximum depth and number of nested values. Of values beyond these limits, only the names of their
#: types are hashed.
_DEPTH: Final = 24
_PARTS: Final = 50_000

_SIMPLE: Final = (bool, int, float, complex, str, bytes, range, type(None), type(...), PurePath)
_SEQUENCES: Final = (list, tuple)

#: Methods that return all weights of a model, in Stable-Baselines3, PyTorch and Keras.
_WEIGHTS: Final = ("get_parameters", "state_dict", "get_weights")

#: Class attributes that Python adds to the ones that the author wrote.
_OF_CLASSES: Final = frozenset(
    ("__annotations__", "__dict__", "__doc__", "__firstlineno__", "__module__", "__qualname__")
    + ("__static_attributes__", "__weakref__", "_abc_impl")
)

#: Folders of installed libraries.
_STANDARD: Final = sysconfig.get_path("stdlib") + "/"
_PACKAGES: Final = frozenset(("site-packages", "dist-packages"))


def digest(value: object) -> str:
    """Returns 16 hexadecimal digits, which differ for values that differ in a covered part.

    The digest of a model covers its weights. The digest of a function covers its code, defaults,
    closure, and the globals that it names. The digest of another object covers its attributes:
    numbers, strings, arrays and objects that contain these.
    """
    return _Walk().of(value, 0).hex()[:16]


class _Walk:
    """A walk over a value and the values that it refers to."""

    def __init__(self) -> None:
        #: Digests of the visited objects by `id`; for objects in progress, a digest of their depth.
        self._known: dict[int, bytes] = {}
        #: Keeps the visited objects alive, so that no `id` is reused.
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
            except Exception:  # any type, as the object's own code may raise anything
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
        # The value may come from a decorator, for example one that compiles or caches a function.
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
    """Converts an array of any library to a NumPy array; None if the value is not an array."""
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
    """Yields the parts of a function that determine its result."""
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
    except ValueError:  # the variable is not assigned yet
        return None


def _names(code: CodeType) -> set[str]:
    """Returns the names that code and its nested functions look up."""
    inner = (_names(each) for each in code.co_consts if isinstance(each, CodeType))
    return set(code.co_names).union(*inner)


def _of_class(kind: type) -> dict[str, object]:
    """Returns the attributes that the author of a class wrote; none for an installed class."""
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
    """Returns the state that distinguishes an object from others of its type."""
    kind = cast("type[Any]", type(value))
    for method in _WEIGHTS:
        if callable(getattr(kind, method, None)):
            return _weights(method, getattr(value, method)()), _settings(value)
    # A `__getstate__` of the class itself is not called, as it may have side effects.
    default: Callable[[Any], object] = object.__getstate__
    is_plain = kind.__getstate__ is default
    state: object = default(value) if is_plain else getattr(value, "__dict__", None)
    if not _is_installed(kind.__module__):
        return state
    # Objects of libraries also refer to things that are not part of the policy, such as loggers.
    return {name: part for name, part in _attributes(state) if _is_data(part)}


def _weights(method: str, weights: object) -> object:
    """Returns the weights without an optimizer's state, which actions do not depend on."""
    if method != "get_parameters" or not isinstance(weights, Mapping):
        return weights
    given = cast("Mapping[object, object]", weights)
    return {name: part for name, part in given.items() if "optimizer" not in str(name)}


def _settings(model: Any) -> object:
    """Returns the settings of a model that its actions depend on, besides its weights."""
    modules: Any = getattr(model, "modules", None)
    parts = cast("Iterable[object]", modules() if callable(modules) else ())
    rate = getattr(model, "exploration_rate", None)
    return [(type(part), _numbers(part)) for part in parts], rate


def _numbers(module: object) -> dict[str, object]:
    """Returns the settings of a PyTorch module, except `training`, which a prediction may set."""
    return {
        name: value
        for name, value in vars(module).items()
        if not name.startswith("_") and name != "training" and isinstance(value, _SIMPLE)
    }


def _attributes(state: object) -> Iterable[tuple[str, object]]:
    """Yields the attributes that `object.__getstate__` returned, from `__dict__` and from slots."""
    parts = cast("tuple[object, ...]", state) if isinstance(state, tuple) else (state,)
    for part in parts:
        if isinstance(part, dict):
            yield from cast("dict[str, object]", part).items()


def _is_data(value: object) -> bool:
    kinds = (*_SIMPLE, *_SEQUENCES, np.ndarray, np.generic)
    return isinstance(value, kinds) or any(hasattr(type(value), each) for each in _WEIGHTS)


def _is_installed(module: object) -> bool:
    """Returns whether code belongs to a library or this package, so that its name identifies it."""
    root = str(module).partition(".")[0]
    file = getattr(sys.modules.get(str(module)), "__file__", None)
    if not isinstance(file, str):
        return root in sys.stdlib_module_names
    is_library = file.startswith(_STANDARD) or not _PACKAGES.isdisjoint(PurePath(file).parts)
    return root == "emberwatch" or is_library


def _name(value: Any) -> str:
    return f"{value.__module__}.{value.__qualname__}"


def _sha(*parts: str | bytes | memoryview) -> bytes:
    """Returns the hash of some parts, each preceded by its length."""
    whole = hashlib.sha256()
    for part in parts:
        bytes_ = part.encode("utf-8", "surrogatepass") if isinstance(part, str) else part
        whole.update(len(bytes_).to_bytes(8, "little"))
        whole.update(bytes_)
    return whole.digest()

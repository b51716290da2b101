"""Imports between modules: there are no cycles, and layers import only from lower layers."""

import ast
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import emberwatch

PACKAGE = Path(emberwatch.__file__).parent

#: The layers of the package. Each imports only from the layers before it.
LAYERS = (
    "errors common model belief planning client render envs wrappers sb3 landscape benchmark"
).split()


@cache
def modules() -> dict[str, Path]:
    names = {"emberwatch._native": PACKAGE / "_native.pyi"}
    for path in PACKAGE.rglob("*.py"):
        parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
        names[".".join(parts).removesuffix(".__init__")] = path
    return names


@cache
def imports(path: Path) -> set[str]:
    """Returns the modules that a file imports, at any place in the file; a stub imports none."""
    found = set()
    if path.suffix == ".pyi":
        return found
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: a relative import"
            inner = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= inner & modules().keys() or {str(node.module)}
    return found


def test_there_are_no_import_cycles() -> None:
    graph = {name: imports(path) & modules().keys() for name, path in modules().items()}
    assert len(graph) > 30 and "emberwatch.client.wire" in graph["emberwatch.client.observer"]
    order = list(TopologicalSorter(graph).static_order())
    assert order.index("emberwatch.errors") < order.index("emberwatch.envs.path_env")


def layer(name: str) -> str:
    return f"{name}.__init__".split(".")[1]


def test_layers_import_only_from_lower_layers() -> None:
    layers = {layer(name) for name in modules()}
    assert layers == {*LAYERS, "__init__", "_native"}
    climbs = [
        f"{name} imports {other}"
        for name, path in modules().items()
        for other in imports(path) & modules().keys()
        if {layer(name), layer(other)} <= set(LAYERS)
        and LAYERS.index(layer(other)) > LAYERS.index(layer(name))
    ]
    assert climbs == []

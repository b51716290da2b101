"""Which module imports which: no circles."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import emberwatch

PACKAGE = Path(emberwatch.__file__).parent


def modules() -> dict[str, Path]:
    """The package's modules by name."""
    names = {"emberwatch._native": PACKAGE / "_native.pyi"}
    for path in PACKAGE.rglob("*.py"):
        parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
        names[".".join(parts).removesuffix(".__init__")] = path
    return names


def imports(path: Path) -> set[str]:
    """The modules that a file names in imports, wherever in it they stand."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: a relative import"
            inner = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= inner & modules().keys() or {str(node.module)}
    return found


def test_no_module_imports_itself_through_others() -> None:
    graph = {name: imports(path) & modules().keys() for name, path in modules().items()}
    assert len(graph) > 30 and "emberwatch.client.wire" in graph["emberwatch.client.connection"]
    order = list(TopologicalSorter(graph).static_order())
    assert order.index("emberwatch.errors") < order.index("emberwatch.envs.path_env")

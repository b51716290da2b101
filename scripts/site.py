"""Writes the pages of the documentation site, and the Python package that they describe: `site.py PAGES PACKAGE`.

The pages are made from `docs` and the repository's other documents, so that no text exists twice. Links are rewritten
for the site, and a notebook becomes a page.
"""

from __future__ import annotations

import ast
import html
import json
import posixpath
import re
import shutil
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]

#: Files outside `docs`, and their paths on the site.
OUTSIDE = {
    "README.md": "index.md",
    "ARCHITECTURE.md": "architecture.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "PROTOCOL.md": "protocol.md",
    "REPRODUCTION.md": "reproduction.md",
    "clients/dashboard/page/icon.svg": "assets/icon.svg",
    "clients/python/README.md": "python.md",
    "config/landscapes/jacksboro/README.md": "jacksboro.md",
}

#: An index for readers of the repository, which the site does not need because it has a navigation.
LEFT_OUT = {"docs/README.md"}

#: A paragraph of the first page that addresses only readers of the repository.
OF_REPOSITORY = re.compile(r"^All documents: .*?\n\n", re.MULTILINE | re.DOTALL)

#: Hides the list of pages at the side of the home page.
HOME = "---\nhide: [navigation]\n---\n\n"

#: Ends each guide.
API = "\n\n---\n\nAPI: [Python]({0}reference.md), [Rust]({0}rust.md)\n"

FENCE = re.compile(r"^(```.*?^```$)", re.MULTILINE | re.DOTALL)
#: The opening of a code block: its language, and further words that only tests use.
INFO = re.compile(r"\A(```\w+)[^\n]*")
LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\((?![a-z]+:|#)([^()\s#]+)(#[^()\s]*)?\)")
NAMED = re.compile(r"(?<!\[)`([\w./-]+\.md)`")
#: A number's error or confidence interval with the spaces in it, where lines must not break.
SPREAD = re.compile(r"(?<=\d)( ± (?=\d)| \[-?[\d.]+, -?[\d.]+\])")


def pages() -> dict[str, str]:
    """Returns a mapping from each file's path in the repository to its path on the site."""
    found = dict(OUTSIDE)
    for path in sorted((ROOT / "docs").rglob("*")):
        source = path.relative_to(ROOT).as_posix()
        if path.is_file() and source not in LEFT_OUT:
            found[source] = source.removeprefix("docs/")
            if path.suffix == ".ipynb":
                found[source] = found[source].removesuffix("ipynb") + "md"
    return found


def linked(text: str, source: str, found: dict[str, str]) -> str:
    """Rewrites a document's links for the site. A link to a file outside the site becomes plain text."""
    here, n_pictures = posixpath.dirname(found[source]) or ".", 0

    def link(match: re.Match[str]) -> str:
        nonlocal n_pictures
        mark, words, target, anchor = match.groups()
        n_pictures += bool(mark)
        path = posixpath.normpath(posixpath.join(posixpath.dirname(source), target))
        if path in found:
            # All pictures except the first are loaded only when they scroll into view.
            later = "{loading=lazy}" if mark and n_pictures > 1 else ""
            shown = f"{mark}[{words}]({posixpath.relpath(found[path], here)}{anchor or ''}){later}"
            # A click opens a picture at full size, because its text is small on a phone.
            return f"[{shown}]({posixpath.relpath(found[path], here)})" if mark else shown
        if (ROOT / path).exists():
            return words
        raise SystemExit(f"{source}: expected a file of the repository, got {target}")

    def name(match: re.Match[str]) -> str:
        page = found.get(match[1])
        if page is None or match[1] == source:
            return match[0]
        heading = (ROOT / match[1]).read_text("utf-8").partition("\n")[0].removeprefix("# ")
        return f"[{heading}]({posixpath.relpath(page, here)})"

    parts = FENCE.split(text)
    for index, part in enumerate(parts):
        if part.startswith("```"):
            parts[index] = INFO.sub(r"\1", part)
        else:
            part = SPREAD.sub(lambda match: match[0].replace(" ", "\u00a0"), part)
            parts[index] = NAMED.sub(name, LINK.sub(link, part))
    return "".join(parts)


def page_of(notebook: dict[str, Any], name: str) -> str:
    """Converts a notebook to Markdown: texts, and code with its outputs below."""
    parts = list[str]()
    for cell in notebook["cells"]:
        text = "".join(cell["source"])
        parts.append(text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```")
        parts += [shown(output) for output in cell.get("outputs", [])]
    return "\n\n".join([*parts, f'<a href="{name}" download>This page as a notebook</a>\n'])


def shown(output: dict[str, Any]) -> str:
    """Converts a cell's output to HTML."""
    result = output.get("data", {"text/plain": output.get("text", "")})
    if "image/png" in result:
        picture = "".join(result["image/png"]).replace("\n", "")
        return f'<img alt="What this code draws" src="data:image/png;base64,{picture}">'
    return f"<pre><code>{html.escape(''.join(result['text/plain']))}</code></pre>"


def document_native(stub: Path) -> None:
    """Adds the docstrings of the compiled module to its stub, which holds only types."""
    from emberwatch import _native

    def add(nodes: list[ast.stmt], owner: object) -> None:
        for node in nodes:
            if isinstance(node, ast.ClassDef | ast.FunctionDef):
                given = getattr(owner, node.name.replace("_Reader", "Observer"), None)
                if isinstance(node, ast.ClassDef):
                    add(node.body, given)
                if given is not None and given.__doc__:
                    node.body.insert(0, ast.Expr(ast.Constant(given.__doc__)))

    tree = ast.parse(stub.read_text("utf-8"))
    add(tree.body, _native)
    stub.write_text(ast.unparse(ast.fix_missing_locations(tree)), "utf-8")


def main() -> None:
    """Writes all pages and the package."""
    out, package, found = Path(sys.argv[1]), Path(sys.argv[2]), pages()
    shutil.rmtree(package, ignore_errors=True)
    source = ROOT / "clients/python/src/emberwatch"
    shutil.copytree(source, package / "emberwatch", ignore=shutil.ignore_patterns("*.so"))
    document_native(package / "emberwatch/_native.pyi")
    shutil.rmtree(out, ignore_errors=True)
    for source, page in found.items():
        path, place = ROOT / source, out / page
        place.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".ipynb":
            shutil.copy(path, place.with_suffix(".ipynb"))
            place.write_text(page_of(json.loads(path.read_text("utf-8")), path.name), "utf-8")
        elif path.suffix == ".md":
            text = linked(path.read_text("utf-8"), source, found)
            if source.startswith("docs/") and path.stem not in {"reference", "rust"}:
                text += API.format("../" * page.count("/"))
            home = page == "index.md"
            place.write_text(HOME + OF_REPOSITORY.sub("", text) if home else text, "utf-8")
        else:
            shutil.copy(path, place)


if __name__ == "__main__":
    main()

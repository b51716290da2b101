"""Checks the English of documents and comments with proselint, and with the project's own list of phrases to avoid."""

from __future__ import annotations

import io
import re
import subprocess
import sys
import tokenize
from collections.abc import Callable, Iterator
from pathlib import Path

from proselint.checks import __register__ as STANDARD
from proselint.config import DEFAULT
from proselint.registry import CheckRegistry
from proselint.registry.checks import Check, types
from proselint.tools import LintFile

#: Advice, and the phrases to avoid as a regular expression, in which a space matches any white space.
PHRASES = {
    "name the thing": r"\bsuch a one\b|\bthose (who|that) (are|is)\b|\bwhat [a-z]+ (is|are|was|were) of\b",
    "use a noun instead of a clause": r"\bwhat (it|an? [a-z]+) (has|have|gives?|knows?)\b|\bas one of\b",
    "write maximum, minimum, number of or capacity": r"\bso many\b|\broom for\b|[.:] Most [a-z-]+ (of an?|per)\b",
    "write reports, receives or knows": r"\b(is|are|was|were|be) told\b|\btells? of\b",
    "write updates with, records or resumes": r"\b(take[sn]?|taking|took) in\b|\b(go|goes|going|gone|went) on\b",
    "write next to, besides or together with": r"\bbeside\b",
    "write instead of": r"\bin the place of\b",
    "say what applies instead": r"\bexpected none\b",
}
#: Disabled checks of proselint, which concern matters of taste, lists of simple words, or repeated words (a heading may
#: repeat words).
OFF = ("typography", "hyperbole", "weasel_words", "restricted", "lexical_illusions", "dates_times")
OURS = [
    Check(
        check_type=types.Existence(items=(pattern.replace(" ", r"\s+"),)),
        path="emberwatch",
        message=advice,
    )
    for advice, pattern in PHRASES.items()
]
OUR_CHECKS = {"emberwatch": True}
ALL_CHECKS = OUR_CHECKS | DEFAULT["checks"] | dict.fromkeys(OFF, False)
FENCE = re.compile(r"^( *)```.*?^\1```|`[^`\n]+`|<[^>]+>|\]\([^)]*\)", re.MULTILINE | re.DOTALL)
RUST = re.compile(r'"(?:[^"\\]|\\.)*"|//[/!]?(.*)')


def blank(text: str) -> str:
    """Replaces everything except line breaks with spaces, so that positions stay the same."""
    return re.sub(r"[^\n]", " ", text)


def without_code(text: str) -> str:
    """Blanks the code, tags and links in Markdown."""
    return FENCE.sub(lambda match: blank(match[0]), text)


def rust_comments(text: str) -> str:
    """Returns the comments of a Rust file, at their original positions."""
    kept = list(blank(text))
    for match in RUST.finditer(text):
        if match[1] is not None:
            kept[match.start(1) : match.end(1)] = match[1]
    return without_code("".join(kept))


def python_comments(text: str) -> str:
    """Returns the comments and docstrings of a Python file, at their original positions."""
    lines, kept = text.splitlines(keepends=True), list(blank(text))
    starts, before = [0], tokenize.NEWLINE
    for line in lines:
        starts.append(starts[-1] + len(line))
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        is_docstring = token.type == tokenize.STRING and before in {tokenize.NEWLINE, tokenize.INDENT, tokenize.NL}
        if is_docstring or token.type == tokenize.COMMENT:
            (first, begin), (last, end) = token.start, token.end
            span = slice(starts[first - 1] + begin, starts[last - 1] + end)
            kept[span] = re.sub(r'^#:?|"""', lambda match: blank(match[0]), text[span])
        before = token.type
    return without_code("".join(kept))


def hash_comments(text: str) -> str:
    """Returns the comments of a shell or TOML file, at their original positions."""
    return re.sub(r"^([^#\n]*)(#?)", lambda match: " " * len(match[0]), text, flags=re.MULTILINE)


TEXT_OF: dict[str, Callable[[str], str]] = {
    ".md": without_code,
    ".rs": rust_comments,
    ".py": python_comments,
    ".pyi": python_comments,
    ".toml": hash_comments,
}


def faults(path: Path) -> Iterator[str]:
    """Yields one line for each fault in a file."""
    text = TEXT_OF[path.suffix](path.read_text("utf-8"))
    file = LintFile(str(path), text)
    # In comments, only the project's own list is checked, because many standard checks report false positives there.
    checks = ALL_CHECKS if path.suffix == ".md" else OUR_CHECKS
    for fault in file.lint({**DEFAULT, "checks": checks}):
        found = " ".join(file.content[slice(*fault.check_result.span)].split())
        yield f"{path}:{fault.pos[0]}: {found!r}: {fault.check_result.message}"


def main() -> None:
    """Checks all files of the repository."""
    CheckRegistry().register_many((*STANDARD, *OURS))
    listed = subprocess.run(["git", "ls-files"], check=True, stdout=subprocess.PIPE, text=True).stdout.splitlines()
    paths = [Path(name) for name in listed if not name.startswith(("fuzz/corpus/", "CHANGELOG"))]
    found = [fault for path in paths if path.suffix in TEXT_OF for fault in faults(path)]
    sys.exit("\n".join(found) or None)


if __name__ == "__main__":
    main()

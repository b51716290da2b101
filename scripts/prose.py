"""Checks the English of documents and comments with proselint, and with the project's own list of phrases to avoid."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from proselint.checks import __register__ as STANDARD
from proselint.config import DEFAULT
from proselint.registry import CheckRegistry
from proselint.registry.checks import Check, types
from proselint.tools import LintFile
from pygments.lexers import get_lexer_for_filename
from pygments.token import Token

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
#: Disabled checks of proselint: matters of taste, lists of simple words, forms of dates, and repeated words (a heading
#: may repeat words).
OFF = ("typography", "hyperbole", "weasel_words", "restricted", "lexical_illusions", "dates_times")
OURS = [
    Check(
        check_type=types.Existence(items=(pattern.replace(" ", r"\s+"),)),
        path="emberwatch",
        message=advice,
    )
    for advice, pattern in PHRASES.items()
]
ANY = re.compile("|".join(PHRASES.values()).replace(" ", r"\s+"), re.IGNORECASE)
OUR_CHECKS = {"emberwatch": True}
ALL_CHECKS = OUR_CHECKS | DEFAULT["checks"] | dict.fromkeys(OFF, False)
FENCE = re.compile(r"^( *)```.*?^\1```|`[^`\n]+`|<[^>]+>|\]\([^)]*\)", re.MULTILINE | re.DOTALL)
MARKER = re.compile(r'^[ \t]*(//[/!]?|/?\*+|#:?|""")', re.MULTILINE)
#: Suffixes of files with comments in the syntax of a language.
CODE = {".rs", ".py", ".pyi", ".js", ".css", ".toml"}


def blank(match: re.Match[str] | str) -> str:
    """Replaces everything except line breaks with spaces, so that positions stay the same."""
    return re.sub(r"[^\n]", " ", match if isinstance(match, str) else match[0])


def comments(name: str, text: str) -> str:
    """Returns the comments and docstrings of a source file, at their original positions."""
    parts = list[str]()
    for _, token, value in get_lexer_for_filename(name).get_tokens_unprocessed(text):
        is_comment = token in Token.Comment or token in Token.String.Doc
        parts.append(MARKER.sub(blank, value) if is_comment else blank(value))
    return "".join(parts)


def faults(path: Path) -> Iterator[str]:
    """Yields one line for each fault in a file."""
    text, is_document = path.read_text("utf-8"), path.suffix == ".md"
    # Lexers are slow, and most files contain no listed phrase at all.
    if not is_document and not ANY.search(MARKER.sub(blank, text)):
        return
    file = LintFile(str(path), FENCE.sub(blank, text if is_document else comments(path.name, text)))
    # In comments, only the project's own list is checked, because many standard checks report false positives there.
    checks = ALL_CHECKS if is_document else OUR_CHECKS
    for fault in file.lint({**DEFAULT, "checks": checks}):
        found = " ".join(file.content[slice(*fault.check_result.span)].split())
        yield f"{path}:{fault.pos[0]}: {found!r}: {fault.check_result.message}"


def main() -> None:
    """Checks the repository's documents, except the changelog, and the comments of its code."""
    CheckRegistry().register_many((*STANDARD, *OURS))
    listed = subprocess.run(["git", "ls-files"], check=True, stdout=subprocess.PIPE, text=True).stdout.splitlines()
    paths = [Path(name) for name in listed if not name.startswith(("fuzz/corpus/", "CHANGELOG"))]
    found = [fault for path in paths if path.suffix in {".md", *CODE} and path.exists() for fault in faults(path)]
    sys.exit("\n".join(found) or None)


if __name__ == "__main__":
    main()

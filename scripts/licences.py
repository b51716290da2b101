"""Checks that every external dependency comes from crates.io under one of the licences below."""

from __future__ import annotations

import json
import re
import subprocess
import sys

ALLOWED = {
    "0BSD",
    "Apache-2.0",
    "Apache-2.0 WITH LLVM-exception",
    "BSD-2-Clause",
    "BSD-3-Clause",
    "BSL-1.0",
    "ISC",
    "MIT",
    "Unicode-3.0",
    "Unlicense",
    "Zlib",
}
#: Tools with other licences. They generate files, and no program contains them.
TOOLS = {"cbindgen"}
SOURCE = "registry+https://github.com/rust-lang/crates.io-index"


def allowed(expression: str) -> bool:
    """Returns whether the allowed licences satisfy an SPDX expression. `/` is an older form of OR."""
    words = re.findall(r"[()]|AND|OR|[^\s()]+(?: WITH [^\s()]+)?", expression.replace("/", " OR "))
    operators = {"AND": "and", "OR": "or", "(": "(", ")": ")"}
    return bool(eval(" ".join(operators.get(word) or str(word in ALLOWED) for word in words)))


command = ["cargo", "metadata", "--locked", "--all-features", "--format-version", "1"]
packages = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)["packages"]
wrong = [
    f"{package['name']} {package['version']}: expected crates.io and a licence that scripts/licences.py allows, "
    f"got {package['license']!r} from {package['source']}"
    for package in packages
    if not (package["name"] in TOOLS or allowed(package["license"] or "none"))
    or package["source"] not in (SOURCE, None)
]
sys.exit("\n".join(wrong) or None)

"""Runs a notebook's code cell by cell. `notebook.py FILE` compares the outputs with those stored in the file.

The new outputs must have the same text, except for numbers, and pictures of the same size. With `--write`, they
replace the stored outputs instead. The package and Pillow must be installed.
"""

from __future__ import annotations

import ast
import base64
import contextlib
import io
import json
import re
import sys
from pathlib import Path
from typing import Any

from PIL import Image


def shown(source: str, names: dict[str, Any]) -> list[dict[str, Any]]:
    """Runs a cell. Returns the printed text and the value of the last line, in the form that notebooks store."""
    body = ast.parse(source).body
    last = body.pop() if body and isinstance(body[-1], ast.Expr) else None
    printed, value = io.StringIO(), None
    with contextlib.redirect_stdout(printed):
        exec(compile(ast.Module(body, []), "cell", "exec"), names)
        if isinstance(last, ast.Expr):
            value = eval(compile(ast.Expression(last.value), "cell", "eval"), names)
    outputs = list[dict[str, Any]]()
    if printed.getvalue():
        lines = printed.getvalue().splitlines(keepends=True)
        outputs.append({"output_type": "stream", "name": "stdout", "text": lines})
    if value is not None:
        outputs.append({"output_type": "display_data", "metadata": {}, "data": data_of(value)})
    return outputs


def data_of(value: Any) -> dict[str, Any]:
    """Returns a value in the form that notebooks store: as a picture, or as text."""
    if not isinstance(value, Image.Image):
        return {"text/plain": [repr(value)]}
    file = io.BytesIO()
    value.quantize(256).save(file, "png", optimize=True)
    picture = base64.b64encode(file.getvalue()).decode()
    return {"image/png": picture, "text/plain": [f"a picture, {value.width} x {value.height}"]}


def words(outputs: list[dict[str, Any]]) -> str:
    """Returns the parts of the outputs that are compared: texts without their numbers, and the sizes of pictures."""
    texts = list[str]()
    for output in outputs:
        data = output.get("data", {})
        text = "".join(output.get("text", data.get("text/plain", "")))
        texts.append(text if "image/png" in data else re.sub(r"-?[\d.]+", "N", text))
    return "\n".join(" ".join(text.split()) for text in texts)


def main() -> None:
    """Runs all cells in one namespace, then compares or stores their outputs."""
    path, names = Path(sys.argv[1]), dict[str, Any]()
    notebook = json.loads(path.read_text("utf-8"))
    for cell in notebook["cells"]:
        if cell["cell_type"] != "code":
            continue
        source = "".join(cell["source"])
        got = shown(source, names)
        if "--write" not in sys.argv and words(got) != words(cell["outputs"]):
            raise SystemExit(
                f"{path.name}: expected {words(cell['outputs'])!r}, got {words(got)!r} from\n"
                f"{source}\n(after an intended change: scripts/notebook.py {path} --write)"
            )
        cell["outputs"] = got
    if "--write" in sys.argv:
        path.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n", "utf-8")


if __name__ == "__main__":
    main()

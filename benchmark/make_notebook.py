"""Write docs/tutorial.ipynb from docs/tutorial.md: the same text, its commands as cells.

    python benchmark/make_notebook.py

A Python block that begins with a file's name in a comment becomes a cell that writes this file.
"""

import re
from pathlib import Path

import nbformat
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook

DOCS = Path(__file__).parent.parent / "docs"
FIRST = """import importlib.util
import os
import sys

if os.path.basename(os.getcwd()) == "docs":
    os.chdir("..")  # the repository's root
if importlib.util.find_spec("mujoco") is None:  # on a fresh machine, such as Colab's
    !{sys.executable} -m pip install -q -r requirements.txt"""


def notebook(text: str) -> nbformat.NotebookNode:
    """Cells of a Markdown text. Their ids are numbers, so the file changes only with the text."""
    cells = [new_code_cell(FIRST)]
    for kind, code, prose in re.findall(r"```(\w+)\n(.*?)```|((?:(?!```).)+)", text, re.DOTALL):
        if prose.strip():
            cells.append(new_markdown_cell(prose.strip()))
        elif kind == "bash":
            cells.append(new_code_cell("\n".join(f"!{line}" for line in code.splitlines())))
        elif kind == "python":
            file = re.match(r"# (\w+\.py)\n", code)
            code = f"%%writefile {file[1]}\n{code[file.end() :]}" if file else code
            cells.append(new_code_cell(code.strip()))
    for number, cell in enumerate(cells):
        cell["id"] = str(number)
    language = {"display_name": "Python 3", "language": "python", "name": "python3"}
    return new_notebook(cells=cells, metadata={"kernelspec": language})


if __name__ == "__main__":
    nbformat.write(notebook((DOCS / "tutorial.md").read_text()), DOCS / "tutorial.ipynb")

"""Pages that are documents of the repository.

A mark `<!-- {{ proto/README.md }} -->` and the line below it stand for that file: so a document has one text, which
reads well in the repository and on the site.  The line is for who reads the page in a clone: it says where the text is.
A notebook (`.py`, cells after `# %%`) becomes text and blocks of code.

On every page links to such documents are turned, to the pages that show them; links to other files are downloads.  So
in a clone all links lead to a text.
"""

import os
import re
from functools import cache
from pathlib import Path

from sphinx.application import Sphinx

_LINE = re.compile(r"^<!-- \{\{ (\S+) \}\} -->\n.*$", re.M)
_LINK = re.compile(r"(?<=\]\()([^)\s]+)(?=\))")
_FENCE = re.compile(r"^(```.*?^```)$", re.M | re.S)


def setup(app: Sphinx) -> dict[str, bool]:
    """Called by Sphinx."""
    app.connect("source-read", _fill)
    return {"parallel_read_safe": True}


def _fill(app: Sphinx, page: str, content: list[str]) -> None:
    folder = Path(app.srcdir)

    def text(line: re.Match[str]) -> str:
        path = folder.parent / line[1]
        app.env.note_dependency(str(path))
        said = path.read_text(encoding="utf-8")
        said = notebook(said) if path.suffix == ".py" else said
        return turned(said, path, folder / f"{page}.md", folder)

    own = folder / f"{page}.md"
    content[0] = _LINE.sub(text, turned(content[0], own, own, folder))


@cache
def pages(folder: Path) -> dict[Path, Path]:
    """Document of the repository → the page that shows it."""
    found = {}
    for page in folder.rglob("*.md"):
        for name in _LINE.findall(page.read_text(encoding="utf-8")):
            found[folder.parent / name] = page
    return found


def turned(text: str, path: Path, page: Path, folder: Path) -> str:
    """The text of the document `path` with links that hold on `page`.  Raises FileNotFoundError for one that leads
    nowhere."""

    def link(match: re.Match[str]) -> str:
        name, _, anchor = match[0].partition("#")
        if not name or ":" in name:
            return match[0]
        target = Path(os.path.normpath(path.parent / name))
        if not target.is_file():
            raise FileNotFoundError(f"{path}: its link {match[0]} leads to {target}, which is no file")
        there = os.path.relpath(pages(folder).get(target, target), page.parent)
        return f"{there}#{anchor}" if anchor else there

    parts = _FENCE.split(text)
    return "".join(part if part.startswith("```") else _LINK.sub(link, part) for part in parts)


def notebook(source: str) -> str:
    """Markdown of a notebook in percent format."""
    parts = []
    for cell in re.split(r"^# %%", source, flags=re.M)[1:]:
        head, _, body = cell.partition("\n")
        if "[markdown]" in head:
            parts.append(re.sub(r"^# ?", "", body.strip(), flags=re.M))
        elif body.strip():
            parts.append(f"```python\n{body.strip()}\n```")
    return "\n\n".join(parts) + "\n"

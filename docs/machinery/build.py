"""Build the site into a folder and check every link in it: what `make docs` does.

python docs/machinery/build.py [FOLDER]        [default: out/docs]
"""

import sys
from pathlib import Path

from links import broken
from sphinx.cmd.build import main as build

DOCS = Path(__file__).resolve().parents[1]
_STRICT = ("--quiet", "--fail-on-warning", "--keep-going")


def main() -> int:
    """Warnings count as errors; the exit code is 1 when there is one, or a link that leads nowhere."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else DOCS.parent / "out" / "docs").resolve()
    marks = folder.with_name(f"{folder.name}.doctrees")
    failed = build([*_STRICT, "-d", str(marks), "-b", "html", str(DOCS), str(folder)])
    found = list(broken(folder)) if (folder / "index.html").is_file() else ["there is no index.html"]
    print(*found, sep="\n", file=sys.stderr, end="\n" if found else "")
    if failed or found:
        return 1
    print(f"{len(list(folder.rglob('*.html')))} pages, all links lead somewhere: {folder / 'index.html'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""The site builds without a warning, its links lead somewhere, nothing in it is fetched from elsewhere; and what its
documents tell one to type works, typed in that order."""

import re
import subprocess
import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest
from walk import LANGUAGES, ROOT, agrees, blocks, walk, walker

from factorbus.cli.commands.explain import read_pages

sys.path.insert(0, str(ROOT / "docs" / "machinery"))
TUTORIALS = sorted(str(path.relative_to(ROOT)) for path in (ROOT / "docs" / "tutorials").glob("*.md"))
CONCEPTS = sorted(str(path.relative_to(ROOT)) for path in (ROOT / "docs" / "concepts").glob("*.md"))
CHOOSING = sorted(str(path.relative_to(ROOT)) for path in (ROOT / "docs" / "choosing").glob("*.md"))
needs_docs = pytest.mark.skipif(
    find_spec("sphinx") is None or find_spec("myst_parser") is None, reason="pip install 'factorbus[docs]'"
)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built as `make docs` builds it: a warning or a broken link fails."""
    folder = tmp_path_factory.mktemp("docs") / "site"
    ran = subprocess.run(
        [sys.executable, str(ROOT / "docs" / "machinery" / "build.py"), str(folder)],
        capture_output=True,
        text=True,
        timeout=280,
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert "all links lead somewhere" in ran.stdout
    return folder


@needs_docs
def test_every_error_code_has_its_place_on_the_site(site: Path) -> None:
    anchors = set(re.findall(r'id="([^"]+)"', (site / "reference" / "codes.html").read_text()))
    assert {name.replace("_", "-") for name in read_pages()} <= anchors


@needs_docs
def test_the_python_api_is_there_with_its_docstrings(site: Path) -> None:
    page = (site / "api" / "client.html").read_text()
    for name in ("factorbus.client.connect", "factorbus.client.Draft.between_se2", "factorbus.client.Map.insert"):
        assert f'id="{name}"' in page
    documented = re.findall(r'id="factorbus\.client\.(\w+)"', page)
    assert [name for name in documented if name in ("connect", "Map", "Draft", "AbsoluteFactors")] == [
        "connect", "Map", "Draft", "AbsoluteFactors",
    ]  # fmt: skip
    assert "Mahalanobis" in (site / "api" / "proto.html").read_text()


@needs_docs
def test_equations_are_drawn(site: Path) -> None:
    page = (site / "reference" / "solver-math.html").read_text()
    assert page.count("<math>") > 100
    assert '<span class="number">(9.32)</span>' in page
    assert "converged_share" in page


@needs_docs
def test_a_link_that_leads_nowhere_is_found(tmp_path: Path) -> None:
    from links import broken

    (tmp_path / "index.html").write_text(
        '<h1 id="top">a</h1><a href="#top"></a><a href="#gone"></a><a href="no.html"></a><a href="b/c.html#x"></a>'
        '<img src="https://elsewhere.example/a.png"><a href="https://elsewhere.example"></a>'
    )
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "c.html").write_text('<p id="y"></p><a href="../index.html#top"></a>')
    assert len(list(broken(tmp_path))) == 4


@needs_docs
def test_a_borrowed_document_with_a_bad_link_is_refused() -> None:
    from borrowed import notebook, turned

    docs, readme = ROOT / "docs", ROOT / "service" / "README.md"
    page = docs / "reference" / "service.md"
    text = "[a](../proto/README.md#4-messages) ![b](../docs/town.png)\n```\n[c](nowhere.md)\n```\n"
    assert turned(text, readme, page, docs).startswith("[a](wire.md#4-messages) ![b](../town.png)\n```\n[c](nowhere")
    with pytest.raises(FileNotFoundError, match=r"nowhere\.md"):
        turned("[c](nowhere.md)", readme, page, docs)
    assert notebook("# %% [markdown]\n# # Title\n# text\n\n# %%\nx = 1\n") == "# Title\ntext\n\n```python\nx = 1\n```\n"


DOCS = ROOT / "docs"
MARKED = re.compile(r"^<!-- \{\{ (\S+) \}\} -->\n(.*)$", re.M)
PAGES = {page: page.read_text(encoding="utf-8") for page in sorted(DOCS.rglob("*.md"))}


def test_a_page_in_a_clone_says_where_its_text_is() -> None:
    shown = [(page, *found) for page, text in PAGES.items() for found in MARKED.findall(text)]
    assert len(shown) >= 16
    for page, document, line in shown:
        (target,) = re.findall(r"\]\(([^)]+)\)", line)
        assert (page.parent / target).resolve() == ROOT / document, page
        assert (ROOT / document).is_file()
    for page, text in PAGES.items():
        assert not re.search(r"^(\{\{|\[commands\])", text, re.M), f"{page}: a mark without a word for a reader"


def test_links_in_a_clone_lead_to_a_text() -> None:
    """Not to pages that only the site fills: `borrowed` turns them there."""
    empty = {page for page, text in PAGES.items() if MARKED.match(text)}
    for page, text in PAGES.items():
        prose = re.sub(r"^```.*?^```$", "", text, flags=re.M | re.S)
        for link in re.findall(r"(?<=\]\()[^)\s]+(?=\))", prose):
            name, _, _ = link.partition("#")
            if name and ":" not in name:
                target = (page.parent / name).resolve()
                assert target.is_file(), f"{page}: {link}"
                assert target not in empty, f"{page}: {link} leads to a page without a text; name the document itself"


@needs_docs
def test_docstrings_are_read_as_they_are_meant() -> None:
    from docstrings import rewritten

    said = rewritten(["Where `x_` is, |r| and *not* emphasis.", "", "    r = z", "", "a (n,)   of `b`s"])
    assert said[0] == r"Where ``x_`` is, \|r\| and \*not\* emphasis."
    assert said[2:5] == ["::", "", "        r = z"]
    assert said[6:9] == ["::", "", "    a (n,)   of `b`s"]


@pytest.mark.parametrize("document", [*TUTORIALS, *CONCEPTS, *CHOOSING])
def test_every_block_runs_as_it_stands(document: str, tmp_path: Path) -> None:
    walk(document, tmp_path)


def test_the_notebooks_run_print_what_they_say_and_draw_their_pictures(tmp_path: Path) -> None:
    scripts = sorted((ROOT / "docs" / "notebooks").glob("*.py"))
    assert len(scripts) >= 2
    with walker(tmp_path) as run:
        run("bash", "factorbus serve")
        for script in scripts:
            text = script.read_text(encoding="utf-8")
            printed = re.findall(r"^# ```text\n((?:# .*\n)+?)# ```$", text, re.M)
            assert len(printed) == len([cell for cell in re.split(r"^# %%", text, flags=re.M) if "print(" in cell])
            agrees(re.sub(r"^# ", "", "".join(printed), flags=re.M), run("bash", f"python '{script}'"))
            drawn = set(re.findall(r"savefig\(\"(.+?)\"", text))
            assert drawn == set(re.findall(r"!\[.*\]\(\.\./figures/(.+)\)", text)) != set()
            assert all((folder / name).exists() for name in drawn for folder in (tmp_path, ROOT / "docs" / "figures"))


@pytest.mark.parametrize("peer", ["gtsam", "g2o"])
def test_a_program_prints_the_same_with_a_peer_and_with_us(peer: str, tmp_path: Path) -> None:
    """To 1e-3 of each number: a GTSAM factor measures the error of a relative pose differently."""
    service, theirs, ours = blocks(f"docs/choosing/from-{peer}.md")[:3]
    with walker(tmp_path) as run:
        run(*service)
        said = [run(*each) for each in (theirs, ours)]
    words, numbers = zip(*((re.sub(r"[-\d.]+", "0", each).split(), numbers_of(each)) for each in said), strict=True)
    assert words[0] == words[1]
    assert len(numbers[0]) >= 4
    assert numbers[0] == pytest.approx(numbers[1], abs=1e-3)


def numbers_of(said: str) -> list[float]:
    """All that stand by themselves in what was printed."""
    return [float(each) for each in re.findall(r"(?<![\w.])-?\d+\.\d*", said)]


@pytest.mark.parametrize("peer", ["gtsam", "g2o"])
def test_names_of_a_peer_are_those_of_its_wheel(peer: str) -> None:
    """In the first column of the tables: a class, a method or a parameter of one."""
    wheel = import_module({"gtsam": "gtsam", "g2o": "g2opy"}[peer])
    there = set(dir(wheel)).union(*(dir(getattr(wheel, name)) for name in dir(wheel)))
    text = (ROOT / "docs" / "choosing" / f"from-{peer}.md").read_text(encoding="utf-8")
    cells = re.findall(r"^\| (.*?) \|", text, re.M)
    named = {name for cell in cells for name in re.findall(r"`([A-Z][A-Za-z0-9_]{4,})", cell)}
    assert len(named) > 10
    in_cpp_alone = {"IndeterminantLinearSystemException", "Vector", "BaseBinaryEdge"}
    assert named - there - in_cpp_alone == set()


@pytest.mark.parametrize("document", [*TUTORIALS, *CONCEPTS, *CHOOSING])
def test_no_block_is_left_out(document: str) -> None:
    fences = re.findall(r"^```(.*)$", (ROOT / document).read_text(encoding="utf-8"), re.M)
    assert fences[::2] == [language for language, _ in blocks(document)]
    assert set(fences[::2]) <= LANGUAGES


def test_what_a_document_says_is_printed_is_compared() -> None:
    agrees("done 12 poses\n… at 1e-3", "hello\ndone 700 poses\nanything at -0.5\n")
    with pytest.raises(AssertionError, match="wanted a line"):
        agrees("done 12 poses", "failed 12 poses")

"""The chapters of the method: numbered without gaps, short, and cited correctly by code and pages."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
CHAPTERS = ROOT / "docs" / "method"
ROOMS = ("modeler", "sequences", "viz", "studies", "tests", "docs")
MAX_WORDS = 8000
_NUMBER = r"[A-Z]?\d+(?:\.\d+)?"
_CITATION = re.compile(rf"\b[Ee]qs?\.\s+({_NUMBER}(?:(?:,\s+|\s+(?:and|or|to)\s+){_NUMBER})*)")
_OTHER_SOURCE = re.compile(r"(paper|\b(19|20)\d\d),\s+\Z")  # before a citation
_FENCE = re.compile(r"^```.*?^```$", re.S | re.M)


def chapters() -> dict[int, Path]:
    """Return the chapters by number, in reading order."""
    numbers = {path: re.match(r"# (\d+)\. ", path.read_text()) for path in CHAPTERS.glob("*.md")}
    found = {int(number[1]): path for path, number in numbers.items() if number is not None}
    assert {path for path, number in numbers.items() if number is None} == {CHAPTERS / "index.md"}
    return dict(sorted(found.items()))


def labels(path: Path) -> list[str]:
    """Return the labels of a chapter's equations, in reading order."""
    return re.findall(r"\\tag\{([^}]*)\}", path.read_text())


def all_labels() -> set[str]:
    return {label for path in chapters().values() for label in labels(path)}


def texts() -> Iterator[tuple[Path, str]]:
    """Yield code and pages, once each, without what links lead to."""
    for room in ROOMS:
        for path in sorted((ROOT / room).rglob("*")):
            linked = any(part.is_symlink() for part in path.parents)
            if path.suffix in (".py", ".md") and not linked and path.is_file() and path != Path(__file__):
                yield path, path.read_text()
    yield from ((path, path.read_text()) for path in sorted(ROOT.glob("*.md")))


def citations(text: str) -> list[str]:
    """Return the numbers of equations that a text cites, but for those of other sources."""
    found = []
    for citation in _CITATION.finditer(text):
        if not _OTHER_SOURCE.search(text[max(0, citation.start() - 12) : citation.start()]):
            found += re.findall(_NUMBER, citation[1])
    return found


def slug(heading: str) -> str:
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def test_equations_are_numbered_by_chapter_in_reading_order() -> None:
    assert list(chapters()) == list(range(1, len(chapters()) + 1))
    for number, path in chapters().items():
        found = labels(path)
        assert found == [f"{number}.{place}" for place in range(1, len(found) + 1)], path.name
        assert len(found) == len(re.findall(r"^```math$", path.read_text(), re.M)), path.name


def test_index_lists_the_chapters_in_order() -> None:
    listed = re.findall(r"^(\d+)\. \[[^]]*\]\(([\w-]+\.md)\)$", (CHAPTERS / "index.md").read_text(), re.M)
    assert listed == [(str(number), path.name) for number, path in chapters().items()]


def test_citations_of_equations_resolve() -> None:
    labels, count, wrong = all_labels(), 0, []
    for path, text in texts():
        cited = citations(text)
        count += len(cited)
        wrong += [f"{path.relative_to(ROOT)}: eq. {label}" for label in cited if label not in labels]
    assert not wrong
    assert count > 100  # the pattern still finds them


@pytest.mark.parametrize(
    ("text", "cited"),
    [
        ("see the method, eq. 4.3", ["4.3"]),
        ("(method, eq. 4.2 to 4.5, 5.1 and 10.12)", ["4.2", "4.5", "5.1", "10.12"]),
        ("an older number, eq. 25, or eq. F5", ["25", "F5"]),
        ("(paper, eq. 1) and (Chen, Wiesel, Eldar and Hero 2010, eq. 23), not eq. 6.1", ["6.1"]),
    ],
)
def test_citations_are_found(text: str, cited: list[str]) -> None:
    assert citations(text) == cited


def test_chapters_refer_to_equations_that_exist() -> None:
    labels = all_labels()
    for path in chapters().values():
        referred = re.findall(r"\(([1-9]\d*\.\d+)\)", _FENCE.sub("", path.read_text()))
        assert set(referred) <= labels, path.name


def test_links_to_chapters_resolve() -> None:
    wrong = []
    for path, text in texts():
        if path.suffix != ".md":
            continue
        for target, anchor in re.findall(r"\]\(([\w./-]*\.md)(?:#([\w-]+))?\)", _FENCE.sub("", text)):
            page = (path.parent / target).resolve()
            if CHAPTERS not in (page.parent, path.parent):
                continue
            headings = re.findall(r"^#+ (.*)$", page.read_text(), re.M) if page.is_file() else []
            if not page.is_file() or (anchor and anchor not in map(slug, headings)):
                wrong.append(f"{path.relative_to(ROOT)}: {target}#{anchor}")
    assert not wrong


def test_code_names_chapters_that_exist() -> None:
    for path, text in texts():
        named = re.findall(r"\bdocs/method/([\w-]+\.md)", text)
        assert {name for name in named if not (CHAPTERS / name).is_file()} == set(), path


def test_constants_stand_in_the_code_under_their_names() -> None:
    code = "\n".join(path.read_text() for path in (ROOT / "modeler").rglob("*.py"))
    defined = set(re.findall(r"\b\w+\b", code))
    for path in chapters().values():
        rows = re.findall(r"^(?!\|).*\S\| .*\| (.+)$", path.read_text(), re.M)
        names = {name for row in rows for name in re.findall(r"`(\w+)`", row)}
        assert names, f"{path.name} has no table of constants"
        assert names <= defined, path.name


def test_chapters_are_short() -> None:
    assert sum(len(path.read_text().split("## Sources")[0].split()) for path in CHAPTERS.glob("*.md")) <= MAX_WORDS

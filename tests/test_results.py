"""Pages of figures are those of their files."""

import dataclasses
import re
from pathlib import Path

import pytest

from studies.__main__ import STUDIES
from studies.results.page import PAGES, REGION, rendered
from studies.results.tables import FOLDER, NOT_KNOWN, Table, read, read_all, record

TABLES = read_all()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_a_page_is_that_of_its_files(page: Path) -> None:
    assert page.read_text() == rendered(page.read_text(), TABLES), "run `make results`"


def test_every_table_stands_once_on_a_page() -> None:
    regions = [found for page in PAGES for found in REGION.findall(page.read_text())]
    assert sorted(name for kind, name, _ in regions if kind == "table") == sorted(TABLES)
    assert [name for kind, name, _ in regions if kind == "figures"] == ["captures"]


def test_no_table_of_results_is_typed() -> None:
    assert not re.search(r"^\|", REGION.sub("", PAGES[0].read_text()), re.MULTILINE)


@pytest.mark.parametrize("table", TABLES.values(), ids=TABLES)
def test_a_table_says_how_it_was_measured(table: Table) -> None:
    assert table.study in (*STUDIES, NOT_KNOWN) or table.study.startswith("modeler ")
    assert all(re.match(r"(modeler|make|\.venv/bin/python -m studies) ", line) for line in table.command)
    assert re.match(rf"[0-9a-f]{{7}}\b|{NOT_KNOWN}|runs: ", table.commit)


def test_the_readme_follows_its_table() -> None:
    captures = TABLES["captures"]
    rows = [list(row) for row in captures.rows]
    rows[0][captures.columns.index("frames placed")] = "17 of 19"
    rows[1][captures.columns.index("exit status")] = 3
    changed = TABLES | {"captures": dataclasses.replace(captures, rows=tuple(map(tuple, rows)))}
    text = rendered("<!-- figures: captures -->\n<!-- /figures -->", changed)
    assert re.search(r"176\sof\s178\sframes\sare\splaced.*ten\smodels", text, re.DOTALL)


def test_a_row_with_a_cell_too_few_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "some.json"
    path.write_text(
        '{"study": "s", "command": ["c"], "commit": "c", "columns": ["a", "b"], "rows": [["x"]], "note": []}'
    )
    with pytest.raises(ValueError, match="as many cells"):
        read(path)


def test_files_are_as_studies_write_them() -> None:
    assert [name for name, table in TABLES.items() if (FOLDER / f"{name}.json").read_text() != table.text()] == []


def test_measured_rows_replace_those_of_their_name(tmp_path: Path) -> None:
    path = tmp_path / "some.json"
    rows = (("first", 1), ("second", 2))
    some = Table(study="s", command=("make x",), commit=NOT_KNOWN, columns=("", "count"), rows=rows, note=("Noted.",))
    path.write_text(some.text())
    for count in (2, 3):
        record(path, [("second", count)])
    found = read(path)
    assert found.rows == (("first", 1), ("second", 3))
    assert re.fullmatch(r"not known; second: [0-9a-f]{7,}(-dirty)?", found.commit)
    record(path, [("first", 4), ("second", 5)])
    assert re.fullmatch(r"[0-9a-f]{7,}(-dirty)?", read(path).commit)
    assert read(path).note == some.note
    with pytest.raises(ValueError, match="third"):
        record(path, [("third", 1)])

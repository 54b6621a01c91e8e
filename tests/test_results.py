"""Pages of figures are those of their files."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import pytest

from studies.__main__ import STUDIES
from studies.results.page import PAGE, PLACE, README, TEMPLATE, readme, rendered
from studies.results.tables import NOT_KNOWN, Table, read, read_all

TABLES = read_all()


def test_results_are_those_of_their_files() -> None:
    assert PAGE.read_text() == rendered(TABLES), "run `make results`"


def test_the_readme_states_what_the_files_hold() -> None:
    assert README.read_text() == readme(README.read_text(), TABLES), "run `make results`"


def test_every_table_stands_once_on_the_page_and_none_is_typed_there() -> None:
    text = TEMPLATE.read_text()
    assert sorted(PLACE.findall(text)) == sorted(TABLES)
    assert not re.search(r"^\|", text, re.MULTILINE)


@pytest.mark.parametrize("table", TABLES.values(), ids=TABLES)
def test_a_table_says_how_it_was_measured(table: Table) -> None:
    assert table.study in STUDIES or table.study.startswith("modeler ")
    assert all(re.match(r"(modeler|make|\.venv/bin/python -m studies) ", line) for line in table.command)
    assert re.match(rf"[0-9a-f]{{7}}\b|earlier|{NOT_KNOWN}|runs: ", table.commit)


def test_the_readme_follows_its_table() -> None:
    captures = TABLES["captures"]
    rows = [list(row) for row in captures.rows]
    rows[0][captures.columns.index("frames placed")] = "17 of 19"
    rows[1][captures.columns.index("exit status")] = 3
    changed = TABLES | {"captures": dataclasses.replace(captures, rows=tuple(map(tuple, rows)))}
    text = readme(README.read_text(), changed)
    assert re.search(r"figures: captures -->.*\d+\sof\s\d+\sframes\sare\splaced.*six\smodels", text, re.DOTALL)


def test_a_row_with_a_cell_too_few_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "some.json"
    path.write_text(
        '{"study": "s", "command": ["c"], "commit": "c", "columns": ["a", "b"], "rows": [["x"]], "note": []}'
    )
    with pytest.raises(ValueError, match="as many cells"):
        read(path)


def test_a_page_without_marks_is_refused() -> None:
    with pytest.raises(ValueError, match="figures"):
        readme("# no marks", TABLES)

"""The table of the study: right and wrong models by fault and exit status."""

from __future__ import annotations

from collections.abc import Sequence

from studies.trust.study import Outcome

_WIDTHS = (26, 6, 14, 14, 14, 14)
_HEADS = ("", "runs", "wrong with 0", "wrong with 3", "right with 0", "right with 3")


def text(outcomes: Sequence[Outcome]) -> str:
    """Return the table of one half or both: a line for runs without fault, one for every fault, one for all faults."""
    names = sorted(dict.fromkeys(one.fault for one in outcomes), key=lambda name: (name != "no fault", name))
    lines = [_row(_HEADS), *(_line(name, [one for one in outcomes if one.fault == name]) for name in names)]
    faulty = [one for one in outcomes if one.fault != "no fault"]
    lines += [_line("all faults", faulty), _line("all", outcomes)]
    return "\n".join(lines)


def _line(name: str, outcomes: Sequence[Outcome]) -> str:
    return _row((name, *map(str, counts(outcomes))))


def counts(outcomes: Sequence[Outcome]) -> tuple[int, ...]:
    """Return the number of runs, of wrong ones with status 0 and 3, and of right ones; a rejected input has 3."""
    kinds = ((True, True), (True, False), (False, True), (False, False))
    return len(outcomes), *(
        sum(one.wrong is wrong and (one.status == 0) is trusted for one in outcomes) for wrong, trusted in kinds
    )


def _row(cells: Sequence[str]) -> str:
    (first, *others), (width, *widths) = cells, _WIDTHS
    return first.ljust(width) + "".join(cell.rjust(size) for cell, size in zip(others, widths, strict=True))

"""What a run says on stderr while it runs: a bar where somebody watches, and which frames are left out."""

from __future__ import annotations

import re
from types import TracebackType

from rich.console import Console as Terminal
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from modeler import kernels
from modeler.types import Outcome, Step, loops_closed

_ONE_BY_ONE = 3  # frames left out in a row that are told as they come


def bar() -> Progress:
    """Return a progress bar on stderr, which shows nothing where that is no terminal."""
    terminal = Terminal(stderr=True, highlight=False, soft_wrap=True)
    columns = (
        TextColumn("modeler:"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.description}"),
    )
    return Progress(*columns, console=terminal, disable=not terminal.is_terminal)


class Console:
    """A sink of steps, for a terminal; where stderr is none, only frames left out are told."""

    def __init__(self, frames: int, address: str | None) -> None:
        self._bar = bar()
        self._task = self._bar.add_task("", total=frames)
        self._frames, self._stage = frames, ""
        self._address = address
        self._placed: dict[int, bool] = {}  # a lost frame that later views place comes a second time
        self._unsure: set[int] = set()
        self._advised: set[str] = set()
        self._told, self._aloud = "", 0
        self._held: list[int] = []  # frames of which the same is to be told as of the last few

    def __enter__(self) -> Console:
        """Show the bar."""
        self._bar.start()
        if self._bar.console.is_terminal and not kernels.compiled():
            self._say("the first registration on this machine compiles for about a minute")
        if self._address is not None:
            self._say(f"watch at {self._address}")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the bar as it stands, and tell in how many frames something else may have been taken for the object."""
        self._bar.stop()
        self._release()
        if self._unsure:
            doubt = Outcome.UNSURE_MASK
            self._say(f"{len(self._unsure)} of {len(self._placed)} frames: {doubt.label}: {doubt.advice}")

    def __call__(self, step: Step) -> None:
        """Tell of a step."""
        loops = loops_closed([edge for edge in step.edges_so_far if edge.accepted])
        frame, accepted = step.frame.index, step.accepted
        again, self._placed[frame] = frame in self._placed, accepted
        if accepted and step.segmentation.outcome is Outcome.UNSURE_MASK:
            self._unsure.add(frame)
        description = f"{len(step.views)} joined, {loops} {'loop' if loops == 1 else 'loops'} closed"
        self._bar.update(self._task, completed=len(self._placed), total=self._frames, description=description)
        if not accepted and not again:
            self._tell(frame, f"left out: {self._why(step.outcome)}")
        elif accepted and again:
            self._tell(frame, "placed after all")
        elif accepted:
            self._release()

    def ending(self, stage: str, done: int, total: int) -> None:
        """Tell of what is done after the last frame: `done` of `total`."""
        if stage != self._stage:
            self._stage = stage
            self._bar.update(self._task, total=None, description=stage)  # forgets how fast the stage before went
        self._bar.update(self._task, completed=done, total=total, description=stage)

    def seeking(self, frame: int) -> None:
        """Tell that a frame did not join the previous view and is being tried against others."""
        self._bar.update(self._task, description=f"trying frame {frame} again")

    def _tell(self, frame: int, what: str) -> None:
        """Tell what became of a frame; of those that follow each other for one reason, only the first few by one."""
        if what != self._told:
            self._release()
            self._told = what
        self._aloud += 1
        if self._aloud > _ONE_BY_ONE:
            self._held.append(frame)
        else:
            self._say(f"frame {frame} is {what}")

    def _release(self) -> None:
        """Tell what was held back, together."""
        if len(self._held) == 1:
            self._say(f"frame {self._held[0]} is {self._told}")
        elif self._held:
            self._say(f"frames {self._held[0]} to {self._held[-1]} are {self._told}")
        self._told, self._aloud, self._held = "", 0, []

    def _why(self, outcome: str) -> str:
        """Return why a frame was left out, with what to do about it where that has not been said yet."""
        what, *advice = re.split(": |; ", outcome, maxsplit=1)
        if not advice or advice[0] not in self._advised:
            self._advised.update(advice)
            return outcome
        return what

    def _say(self, text: str) -> None:
        self._bar.console.print(f"modeler: {text}", markup=False)

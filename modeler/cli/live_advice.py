"""What to do next, worked out while a run goes on, for somebody who turns the object before a camera that is live."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modeler.pipeline import Modeler
    from modeler.suggestion import Belief, Suggestion, Suggestions
    from modeler.types import Step

Tell = Callable[["Step", "Belief", "Suggestions"], None]
"""Tells what is known after a step, and what to do next."""


@contextmanager
def advising(modeler: Modeler, *tell: Tell) -> Iterator[Callable[[Step], None]]:
    """Tell in a thread of its own what to do after steps; those that come meanwhile are passed over but the newest.

    What goes wrong there is raised with the next step, or at the end.
    """
    waiting: deque[Step] = deque(maxlen=1)

    def advise() -> None:
        from modeler.suggestion import suggest

        try:
            step = waiting.pop()
        except IndexError:  # a newer one was told instead
            return
        belief = modeler.belief(step.views, step.solution, step.edges_so_far)
        found = suggest(belief)
        for each in tell:
            each(step, belief, found)

    with ThreadPoolExecutor(1, thread_name_prefix="advice") as thread:
        asked: deque[Future[None]] = deque()

        def put(step: Step) -> None:
            while asked and asked[0].done():
                asked.popleft().result()
            if step.accepted and step.views:
                waiting.append(step)
                asked.append(thread.submit(advise))

        yield put
        waiting.clear()
        for future in asked:
            future.result()


def for_the_hand(found: Suggestions) -> Suggestion | None:
    """Return the best action that a run takes without being told of it: a poke has to be said by `--prior poke`."""
    return next((each for each in found.ranked if each.prediction.candidate.action in ("turn", "lay")), None)


def in_short(found: Suggestions) -> str:
    """Return in a few words what to do next."""
    best = for_the_hand(found)
    if found.reached or best is None:
        return "nothing more to gain"
    return f"next: {best.words.split(':')[0]}"

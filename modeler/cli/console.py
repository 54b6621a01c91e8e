"""Output of a command on stderr: messages, a progress bar on terminals, and the handling of Ctrl-C."""

from __future__ import annotations

import contextlib
import logging
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import fields, is_dataclass
from functools import cache, partial
from types import FrameType
from typing import TYPE_CHECKING, Any, TypeVar

from modeler.cli.messages import MESSAGES

if TYPE_CHECKING:
    from rich.progress import Progress

    from modeler.suggestion import Belief, Suggestions
    from modeler.types import AbstractPrior, Event, Outcome, Posterior, Reason, Step, Verdict

T = TypeVar("T")

INTERRUPTED = 130  # exit status after Ctrl-C, by the convention of shells
_PAIRS_TIMED = 3  # until it is said how long all takes
_WHOLE = 2.6  # a build takes so many times its pass over the frames: 2.4 for the bundled box, 2.75 for the capture cap
_RECOUNTED = 1.02  # times the edges with which loops were counted: they are so again
_PULSE_S = 30.0  # between signs of life where there is no bar


def say(words: str, level: int = logging.INFO, show: Callable[[str], object] | None = None) -> None:
    """Print a one-line message; unprintable characters from inputs are escaped.

    Args:
        words: the message.
        level: ERROR is printed with `-q`, too, DEBUG only with `-v`.
        show: prints it; None: to stderr.
    """
    line = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in " ".join(as_options(words).split()))
    if MESSAGES.note(line, level):
        try:
            (show or partial(print, file=sys.stderr))(f"modeler: {line}")
        except (OSError, ValueError):  # ValueError: stderr is closed
            # This message and later ones are lost: results do not depend on them.
            with contextlib.suppress(OSError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), 2)


def as_options(words: str) -> str:
    """Return a message with the parameters that it names in backticks, such as `max_depth_m`, as options."""
    return re.sub(r"`(\w+)`", lambda found: _options().get(found[1], found[0]), words)


@cache
def _options() -> dict[str, str]:
    """Return the options of all commands by the names of their parameters."""
    from modeler.cli.overview import SUMMARIES, command_class

    groups, names = list[Any](map(command_class, SUMMARIES)), set[str]()
    while groups:
        for field in fields(groups.pop()):
            names.add(field.name)
            if is_dataclass(field.default_factory):
                groups.append(field.default_factory)
    return {name: f"--{name.replace('_', '-')}" for name in names} | {"purpose": "--for"}


def worded_as_options(record: logging.LogRecord) -> bool:
    """Put options for parameters in a record of the log; a filter that lets all pass."""
    record.msg, record.args = as_options(record.getMessage()), ()
    return True


def trusted_status(verdict: Verdict) -> int:
    """Say why a model is not to be trusted, and return the exit status."""
    if verdict.reasons:
        say(f"not to be trusted: {verdict.reasons[0]}")
    return 0 if verdict.trustworthy else 3


@contextlib.contextmanager
def _handled(number: signal.Signals, handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Handle a signal in the block, then restore the previous handler; no effect outside the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(number, handler)
    try:
        yield
    finally:
        signal.signal(number, signal.SIG_DFL if before is None else before)  # None: not set by Python


@contextlib.contextmanager
def endable() -> Iterator[None]:
    """Let Ctrl-C, SIGTERM and SIGHUP end the block like an exception, so that it cleans up.

    Compiled code and libraries turn that exception into others, or drop it where nobody can handle it.

    Raises:
        KeyboardInterrupt: after Ctrl-C.
        SystemExit: after another of these signals, with 128 and its number.
    """
    if threading.current_thread() is not threading.main_thread():  # others get no signals
        yield
        return
    got: list[int] = []
    otherwise = sys.unraisablehook

    def ending() -> BaseException:
        return KeyboardInterrupt() if got[-1] == signal.SIGINT else SystemExit(128 + got[-1])

    def end(number: int, frame: FrameType | None) -> None:
        got.append(number)
        raise ending()

    def dropped(error: sys.UnraisableHookArgs) -> None:
        if got and error.exc_type in (KeyboardInterrupt, SystemExit):  # send it again, to somewhere else
            threading.Timer(0.05, os.kill, (os.getpid(), got[-1])).start()
        else:
            otherwise(error)

    with contextlib.ExitStack() as handlers:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:  # as nohup has it
                handlers.enter_context(_handled(number, end))
        sys.unraisablehook = dropped
        try:
            yield
        except BaseException as error:
            streams: Any = sys.modules.get("modeler.viz.stream")
            with contextlib.suppress(AttributeError):  # they are not, or were just being, imported
                streams.let_go()  # it may have been in the middle of taking leave of a silent viewer
            if not got or isinstance(error, KeyboardInterrupt | SystemExit):
                raise
            raise ending() from error
        finally:
            sys.unraisablehook = otherwise


class Interrupt:
    """In its context, the first Ctrl-C ends the iteration `until`, the second the program."""

    def __init__(self) -> None:
        self.ended_early = False
        """Whether there were more items."""
        self._presses = 0
        self._listening = _handled(signal.SIGINT, self._note)

    def __enter__(self) -> Interrupt:
        self._before = signal.getsignal(signal.SIGINT) or signal.default_int_handler
        self._listening.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self._listening.__exit__(None, None, None)

    @property
    def asked(self) -> bool:
        """Whether Ctrl-C was pressed."""
        return self._presses > 0

    def until(self, items: Iterable[T]) -> Iterator[T]:
        """Yield items until Ctrl-C."""
        for item in items:
            if self.asked:
                self.ended_early = True
                return
            yield item

    def until_next(self, items: Iterable[T]) -> Iterator[T]:
        """Yield items until Ctrl-C is pressed, if it was before, again; after that, another one ends the program."""
        before = self._presses
        with _handled(signal.SIGINT, self._note) if self.asked else contextlib.nullcontext():
            for item in items:
                if self._presses > before:
                    return
                yield item

    def _note(self, number: int, frame: FrameType | None) -> None:
        self._presses += 1
        signal.signal(signal.SIGINT, self._before)
        say("finishing with the frames so far; Ctrl-C again stops at once")


def bar() -> Progress:
    """Return a progress bar on stderr, hidden if that is no terminal."""
    from rich.console import Console as Terminal
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    terminal = Terminal(stderr=True, highlight=False, soft_wrap=True)
    columns = (
        TextColumn("modeler:"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.description}"),
    )
    quiet = MESSAGES.least > logging.INFO
    return Progress(*columns, console=terminal, disable=quiet or not terminal.is_terminal)


def _rounded(seconds: float) -> str:
    """Return a duration in words, to about a tenth."""
    if seconds < 90.0:
        return f"{10 * max(1, round(seconds / 10.0))} s"
    return f"{max(2, round(seconds / 60.0))} min"


class Console:
    """A sink of steps for a terminal; if stderr is none, only frames left out are reported."""

    def __init__(self, frames: int | None, address: str | None, prior: AbstractPrior | None = None) -> None:
        self._bar = bar()
        self._task = self._bar.add_task("", total=frames)
        self._frames, self._stage = frames, ""
        self._address, self._prior = address, prior
        self._placed: dict[int, bool] = {}  # a lost frame that is placed later occurs twice
        self._loops = 0
        self._counted = self._seen = 0  # edges when loops were counted last, and in the newest step
        self._doubts: dict[Outcome, set[int]] = {}  # frames by what is doubtful about their masks
        self._advised: set[str] = set()
        self._reported, self._aloud = "", 0
        self._held: list[int] = []  # frames left out for the same reason as those reported last
        self._state, self._enough = "", False
        self._began_s: float | None = None
        self._said_s = time.monotonic()

    def __enter__(self) -> Console:
        self._bar.start()
        if self._address is not None:
            self._say(f"watch at {self._address}")
        return self

    def __exit__(self, *error: object) -> None:
        """Stop the bar, and report the number of frames with doubtful masks."""
        from modeler.verdict.advice import outcome_advice

        self._bar.stop()
        self._release()
        for doubt, frames in self._doubts.items():
            if frames:
                self._say(f"{len(frames)} of {len(self._placed)} frames: {doubt.label}: {outcome_advice(doubt)}")

    @property
    def watched(self) -> bool:
        """Whether stderr is a terminal."""
        return not self._bar.disable

    def advise(self, step: Step, belief: Belief, found: Suggestions) -> None:
        """Show the next action after a step; the first time the goal is reached, print it."""
        from modeler.runs.live_advice import summary_of

        if found.reached and not self._enough:
            self._enough = True
            self._say(found.summary)
        self._say(summary_of(found), logging.DEBUG)
        if self._state and not self._stage:
            self._bar.update(self._task, description=f"{self._state}; {summary_of(found)}")

    def __call__(self, event: Event) -> None:
        """Show an event of a run."""
        from modeler.types import Fusing, Refining, Searching, Step

        match event:
            case Step():
                self._show_step(event)
            case Searching(frame):
                self._bar.update(self._task, description=f"retrying frame {frame}")
            case Refining(done, int(total)):
                self._show_stage("registering more pairs", done, total)
            case Refining():
                self._show_stage("choosing more pairs", 0, 1)
            case Fusing():
                self._show_stage("fusing the model", 0, 1)

    def _show_step(self, step: Step) -> None:
        """Show the result of a frame; a lost frame that is placed later has a second step, and so has the last."""
        from modeler.types import Outcome, loops_closed

        closures = [edge.kind == "closure" for edge in step.edges if edge.accepted]  # edges that join frames close none
        count, few = len(step.edges_so_far), _RECOUNTED * self._counted
        if step.last or (any(closures) and not self._seen < count <= few):
            self._loops, self._counted = loops_closed([edge for edge in step.edges_so_far if edge.accepted]), count
        else:  # each closes one, unless it alone joins its frame
            self._loops += sum(closures)
        self._seen = count
        loops = self._loops
        frame, accepted = step.frame.index, step.accepted
        before, self._placed[frame] = self._placed.get(frame), accepted
        mask = step.segmentation.outcome
        for frames in self._doubts.values():
            frames.discard(frame)  # which may have another mask by now
        if accepted and mask in (Outcome.UNSURE_MASK, Outcome.CUT_OFF):
            self._doubts.setdefault(mask, set()).add(frame)
        self._expect()
        self._state = f"{len(step.views)} joined, {loops} {'loop' if loops == 1 else 'loops'} closed"
        self._bar.update(self._task, completed=len(self._placed), total=self._frames, description=self._state)
        if step.left_out is not None and before is None:
            self._report_frame(frame, f"left out: {self._why(step.left_out, step.posteriors)}")
        elif accepted and before is False:
            self._report_frame(frame, "placed on retry")
        elif accepted:
            self._release()
        if accepted:
            seconds = sum(posterior.seconds for posterior in step.posteriors)
            self._say(f"frame {frame}: {self._state}; {seconds:.2f} s of registration", logging.DEBUG)

    def _expect(self) -> None:
        """Say once, after the first pairs, how long all of it takes; without a bar, now and then how far it is."""
        now_s, done = time.monotonic(), len(self._placed)
        if self._began_s is None:
            self._began_s = now_s
        elif self._frames is not None and done == _PAIRS_TIMED + 1 < self._frames:
            whole_s = _WHOLE * (now_s - self._began_s) / _PAIRS_TIMED * self._frames
            if whole_s > 20.0:  # what takes less is over soon
                self._say(f"{self._frames} frames: to register, close loops and fuse takes about {_rounded(whole_s)}")
        elif not self.watched and now_s - self._said_s > _PULSE_S:
            self._say(f"frame {done}" if self._frames is None else f"frame {done} of {self._frames}")

    def _show_stage(self, stage: str, done: int, total: int) -> None:
        """Show the progress after the last frame."""
        if stage != self._stage:
            self._stage = stage
            self._say(stage, logging.DEBUG)
        elif total > 1 and not self.watched and time.monotonic() - self._said_s > _PULSE_S:
            self._say(f"{stage}: {done} of {total}")
            self._bar.update(self._task, total=None, description=stage)  # forgets how fast the stage before went
        elif total > 1:
            self._say(f"{stage}: {done} of {total}", logging.DEBUG)
        self._bar.update(self._task, completed=done, total=total, description=stage)

    def _report_frame(self, frame: int, what: str) -> None:
        """Report the result of a frame; of consecutive ones with the same reason, only the first few individually."""
        if what != self._reported:
            self._release()
            self._reported = what
        self._aloud += 1
        if self._aloud > 3:
            self._held.append(frame)
        else:
            self._say(f"frame {frame} is {what}")

    def _release(self) -> None:
        """Report the frames held back, together."""
        if len(self._held) == 1:
            self._say(f"frame {self._held[0]} is {self._reported}")
        elif self._held:
            self._say(f"frames {min(self._held)} to {max(self._held)} are {self._reported}")
        self._reported, self._aloud, self._held = "", 0, []

    def _why(self, reason: Reason, posteriors: Sequence[Posterior]) -> str:
        """Return why a frame was left out, with advice unless already given."""
        from modeler.types import summary
        from modeler.verdict.advice import reason_advice

        what, what_to_do = summary(reason), reason_advice(reason, self._prior, posteriors)
        if not what_to_do or what_to_do in self._advised:
            return what
        self._advised.add(what_to_do)
        return f"{what}: {what_to_do}"

    def _say(self, text: str, level: int = logging.INFO) -> None:
        say(text, level, self._print)

    def _print(self, line: str) -> None:
        self._said_s = time.monotonic()
        self._bar.console.print(line, markup=False)

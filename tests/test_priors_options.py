"""From options and what sequence.json says of the motion to a prior."""

import dataclasses
import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from input_errors import refused

from modeler.cli import main
from modeler.composition.compose import chosen_prior, prior_name
from modeler.composition.options import PriorOptions
from modeler.priors import (
    AnyMotion,
    AnyTurn,
    AutoPrior,
    FeaturesPrior,
    GeneralPrior,
    HeldPrior,
    Poke,
    PokePrior,
    ProductPrior,
    TablePrior,
    TurntablePrior,
    VelocityPrior,
)
from modeler.sequences import AbstractSequence, bundled
from modeler.types import Frame

OWN = """
from dataclasses import dataclass
from modeler.priors import TablePrior
from modeler.types import AbstractPrior, AbstractPoseDensity, RayImage

@dataclass(frozen=True)
class Slow(AbstractPrior):
    max_turn_deg: float = 20.0
    axis: tuple[float, float, float] = (0.0, 1.0, 0.0)

    def between(self, source: RayImage, target: RayImage) -> AbstractPoseDensity:
        return TablePrior(self.max_turn_deg).between(source, target)

@dataclass
class Thawed(AbstractPrior):
    def between(self, source, target): ...

class Bare(Slow): ...

@dataclass(frozen=True)
class Choosy(Slow):
    def __post_init__(self):
        raise ValueError("never")
"""
POKE = {"point_m": [0.0, 0.1, 0.8], "direction": [1, 0, 0], "length_m": 0.03}


@dataclass(frozen=True)
class Telling(AbstractSequence):
    """A sequence that says something of its motion, and has no frame."""

    motion: Mapping[str, object] | None = None  # pyright: ignore[reportIncompatibleMethodOverride, reportAssignmentType]
    robot_path: Path | None = None  # pyright: ignore[reportIncompatibleMethodOverride, reportAssignmentType]
    name: str = "telling"  # pyright: ignore[reportIncompatibleMethodOverride, reportAssignmentType]
    indices: tuple[int, ...] = ()  # pyright: ignore[reportIncompatibleMethodOverride, reportAssignmentType]
    model_path: Path | None = field(default=None)  # pyright: ignore[reportIncompatibleMethodOverride, reportAssignmentType]

    def frame(self, index: int) -> Frame:
        raise AssertionError


TURNTABLE = Telling({"kind": "turntable", "step_deg": 25, "sigma_deg": 3})


@pytest.mark.parametrize(
    ("motion", "given", "name"),
    [
        (None, {}, "auto"),
        (None, {"max_rotation_deg": 40.0}, "general"),
        ({"kind": "general", "step_deg": 20}, {}, "general"),
        ({"kind": "somersault"}, {}, "auto"),
        ({"kind": "table"}, {}, "table"),
        ({"kind": "table"}, {"max_shift_m": 0.1}, "table"),
        ({"kind": "table"}, {"max_offset_m": 0.1}, "general"),
        ({"kind": "table"}, {"prior": "general"}, "general"),
        ({"kind": "turntable", "step_deg": 25}, {}, "turntable"),
        ({"kind": "turntable"}, {}, "auto"),
        ({"kind": "turntable"}, {"step_deg": 24.0}, "turntable"),
        ({"kind": "held"}, {}, "general"),
        ({"kind": "poke", "pokes": {"1": POKE}}, {}, "poke"),
    ],
)
def test_the_sequence_says_what_is_known_unless_it_is_asked_otherwise(
    motion: Mapping[str, object] | None, given: dict[str, Any], name: str
) -> None:
    assert prior_name(PriorOptions(**given), Telling(motion)) == name
    chosen_prior(PriorOptions(**given), Telling(motion))


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("general", GeneralPrior(limits_assumed=True)),
        ("table", TablePrior(limits_assumed=True)),
        ("features+table", FeaturesPrior(TablePrior(limits_assumed=True))),
        ("table+velocity+features", FeaturesPrior(VelocityPrior(TablePrior(limits_assumed=True)))),
        ("turntable", TurntablePrior(25.0, 3.0)),
        ("table+turntable", TurntablePrior(25.0, 3.0, needs_table=True)),
        ("table+general", ProductPrior(TablePrior(limits_assumed=True), GeneralPrior(limits_assumed=True))),
    ],
)
def test_names_joined_by_plus_hold_together(name: str, expected: object) -> None:
    assert chosen_prior(PriorOptions(prior=name), TURNTABLE) == expected


@pytest.mark.parametrize("given", [{"max_rotation_deg": 40.0}, {"max_offset_m": 0.1}])
def test_limits_that_are_given_hold(given: dict[str, Any]) -> None:
    assert chosen_prior(PriorOptions(), None).unlimited() == AutoPrior(AnyMotion(), AnyTurn())
    assert chosen_prior(PriorOptions(prior="general"), None).unlimited() == AnyMotion()
    assert chosen_prior(PriorOptions(**given), None).unlimited() is None
    assert chosen_prior(PriorOptions(prior="features"), None).unlimited() == FeaturesPrior(AnyMotion())


@pytest.mark.parametrize(
    ("given", "sequence", "sign"),
    [
        ({"step_deg": 24.0}, None, "unknown"),
        ({"step_deg": -24.0}, None, "known"),
        ({"step_deg": 24.0, "axis_direction": (0.0, -1.0, 0.0)}, None, "known"),
        ({"step_deg": 24.0, "step_sign": "known"}, None, "known"),
        ({"step_deg": 24.0}, TURNTABLE, "known"),
        ({"step_deg": 24.0}, Telling({"step_deg": -25}), "unknown"),
        ({}, TURNTABLE, "known"),
        ({"step_sign": "unknown"}, TURNTABLE, "unknown"),
    ],
)
def test_a_bare_step_may_turn_either_way(given: dict[str, Any], sequence: Telling | None, sign: str) -> None:
    found = chosen_prior(PriorOptions(prior="turntable", **given), sequence)
    assert isinstance(found, TurntablePrior)
    assert found.step_sign == sign


def test_a_robots_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "robot.txt"
    path.write_text("# time tx ty tz qx qy qz qw\n0 1 2 3 0 0 0 1\n0.5 1 2 4 0 0 1 0\n")
    sequence = Telling({"kind": "held"}, path)
    found = chosen_prior(PriorOptions(held_sigma_deg=2.0, max_gap_s=0.7), sequence)
    assert isinstance(found, HeldPrior)
    assert (found.held_sigma_deg, found.hand.max_gap_s, found.hand.name) == (2.0, 0.7, str(path))
    np.testing.assert_array_equal(found.hand.times_s, [0.0, 0.5])
    np.testing.assert_allclose(
        found.hand.camera_from_hand[1], [[-1, 0, 0, 1], [0, -1, 0, 2], [0, 0, 1, 4], [0, 0, 0, 1]], atol=1e-12
    )


def test_pokes_are_read() -> None:
    expected = Poke((0.0, 0.1, 0.8), (1.0, 0.0, 0.0), 0.03)
    found = chosen_prior(PriorOptions(), Telling({"kind": "poke", "pokes": {"3": POKE}}))
    assert found == PokePrior(pokes={3: expected})
    given = PriorOptions(
        prior="poke", poke_point_m=expected.point_m, poke_direction=(1.0, 0.0, 0.0), poke_length_m=0.03
    )
    assert chosen_prior(given, None) == PokePrior(expected)


@pytest.mark.parametrize(
    ("options", "sequence", "says"),
    [
        (PriorOptions(prior="magic"), None, "unknown prior 'magic'"),
        (PriorOptions(prior="table+"), None, "unknown prior ''"),
        (PriorOptions(prior="velocity+velocity"), None, "names velocity twice"),
        (PriorOptions(prior="turntable"), None, "give `step_deg`"),
        (PriorOptions(prior="held"), None, "one sequence at a time"),
        (PriorOptions(prior="held"), TURNTABLE, "telling: has no robot.txt"),
        (PriorOptions(prior="poke"), TURNTABLE, "give them"),
        (PriorOptions(prior="poke", poke_length_m=0.1), None, "`poke_point_m` as well"),
        (PriorOptions(prior="table", step_deg=3.0), None, "`step_deg` is not a parameter of `prior` table"),
        (PriorOptions(prior="table+turntable", max_rotation_deg=3.0), TURNTABLE, "`max_rotation_deg`"),
        (PriorOptions(prior="turntable", step_deg=float("nan")), None, "`step_deg` nan is out of range"),
        (
            PriorOptions(prior="turntable", step_deg=5.0, axis_point_m=(0, 0, float("inf"))),
            None,
            "`axis_point_m` 0 0 inf",
        ),
        (PriorOptions(prior="held", held_sigma_m=-0.1), TURNTABLE, "`held_sigma_m` -0.1 is out of range"),
        (PriorOptions(), Telling({"kind": "turntable", "step_deg": 1e308}), "telling: sequence.json: step_deg 1e+308"),
        (PriorOptions(), Telling({"kind": "poke", "pokes": {"1": POKE | {"length_m": 7.0}}}), "length_m 7 is out of"),
    ],
)
def test_what_cannot_be_used_is_reported_in_a_line(options: PriorOptions, sequence: Telling | None, says: str) -> None:
    with refused(says):
        chosen_prior(options, sequence)


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have a module `own_priors` with priors of a user in the current folder."""
    (tmp_path / "own_priors.py").write_text(OWN)
    (tmp_path / "broken_priors.py").write_text("1 / 0")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", list(sys.path))


@pytest.mark.usefixtures("own")
def test_a_prior_of_the_users_own_is_used_with_its_fields() -> None:
    found = chosen_prior(PriorOptions(prior="own_priors:Slow"), TURNTABLE)
    assert dataclasses.asdict(found) == {"max_turn_deg": 20.0, "axis": (0.0, 1.0, 0.0)}  # pyright: ignore[reportArgumentType]
    found = chosen_prior(
        PriorOptions(prior="own_priors:Slow+velocity", prior_args=("max_turn_deg=15", "axis=(1, 0, 0)")), TURNTABLE
    )
    assert isinstance(found, VelocityPrior)
    assert dataclasses.asdict(found.known) == {"max_turn_deg": 15, "axis": (1, 0, 0)}  # pyright: ignore[reportArgumentType]
    assert isinstance(chosen_prior(PriorOptions(prior="table+own_priors:Slow"), TURNTABLE), ProductPrior)


@pytest.mark.usefixtures("own")
@pytest.mark.parametrize(
    ("prior", "arguments", "says"),
    [
        ("own_priors:Missing", (), "cannot be imported"),
        ("nowhere_at_all:Slow", (), "cannot be imported"),
        ("broken_priors:Slow", (), "ZeroDivisionError"),
        ("own_priors:Thawed", (), "frozen dataclass"),
        ("own_priors:OWN", (), "cannot be imported"),
        ("os:path", (), "is not a prior"),
        ("own_priors:Choosy", (), "never"),
        ("own_priors:Slow", ("speed=3",), "has axis, max_turn_deg"),
        ("own_priors:Slow", ("axis",), "NAME=VALUE"),
        ("table", ("axis=1",), "`prior_args`"),
    ],
)
def test_what_is_no_prior_is_said_in_one_line(prior: str, arguments: tuple[str, ...], says: str) -> None:
    with refused("`prior", says):
        chosen_prior(PriorOptions(prior=prior, prior_args=arguments), TURNTABLE)


@pytest.mark.usefixtures("own")
def test_a_prior_of_the_users_own_registers_from_the_command_line(capfd: pytest.CaptureFixture[str]) -> None:
    own = ["--prior", "own_priors:Slow", "--prior-args", "max_turn_deg=50", "--method", "icp"]
    assert main(["register", str(bundled("box")), "1", "0", *own]) == 0
    edge = json.loads(capfd.readouterr().out)
    assert main(["register", str(bundled("box")), "1", "0", "--prior", "table", "--method", "icp"]) == 0
    assert json.loads(capfd.readouterr().out) == edge

"""What to try next where a model is not to be trusted: by the reason, and by the limit that was hit."""

import ast
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from source_trees import SOURCES, tree

from modeler import priors, se3
from modeler.cli.build import Build
from modeler.cli.console import _options
from modeler.composition.options import MethodOptions, ObjectOptions, PriorOptions
from modeler.types import ACCEPTED, AbstractPrior, Outcome
from modeler.verdict.advice import estimated_focal_length, remedies, unchecked_focal_length


def untrusted(
    *codes: str, turn_deg: float = 40.0, sigma_deg: float = 1.0, outcome: Outcome = Outcome.CONVERGED, **more: Any
) -> dict[str, Any]:
    """What a report says of a run of two frames, of which one may be left out."""
    turn = se3.exp(np.array([0.0, np.radians(turn_deg), 0.0, 0.0, 0.0, 0.0]))
    edge = {"accepted": outcome is Outcome.CONVERGED, "kind": "odometry", "source": 1, "target": 0}
    edge |= {"outcome": outcome.label, "target_from_source": turn.ravel().tolist()}
    edge["covariance"] = (np.radians(sigma_deg) ** 2 * np.eye(6)).ravel().tolist()
    edge["modes"] = [{"weight": 1.0, "weight_in_graph": None}]
    frames = [
        {"id": 0, "cause": "", "outcome": ACCEPTED},
        {"id": 1, "cause": "", "outcome": ACCEPTED}
        if edge["accepted"]
        else {"id": 1, "cause": outcome.label, "outcome": outcome.advice},
    ]
    return {"reason_codes": list(codes), "frames": frames, "edges": [edge], "closed": False, **more}


@pytest.mark.parametrize(
    ("report", "prior", "options"),
    [
        (untrusted("unsure_masks", "free_space_violations"), priors.GeneralPrior(), {"roi", "max_depth_m"}),
        (untrusted("no_motion"), priors.GeneralPrior(), {"roi", "max_depth_m"}),
        (
            untrusted("free_space_violations", up=[0.0, -1.0, 0.0], turn_deg=25.0),
            priors.GeneralPrior(),
            {"prior": "table"},
        ),
        (
            untrusted("free_space_violations", up=[0.0, -1.0, 0.0], turn_deg=48.0),
            priors.GeneralPrior(),
            {"prior": "table", "max_rotation_deg": "100"},
        ),
        (untrusted("free_space_violations"), priors.GeneralPrior(), {"prior": "turntable", "step_deg": "40"}),
        (untrusted("unsure_rotation", up=[0.0, -1.0, 0.0]), priors.TablePrior(), {"prior": "turntable"}),
        (
            untrusted("unsure_rotation", sigma_deg=15.0),
            priors.GeneralPrior(),
            {"prior": "turntable", "step_deg": "DEG"},
        ),
        (untrusted("unsure_rotation"), priors.TurntablePrior(25.0), None),
        (untrusted("unsure_focal"), priors.TablePrior(), {"camera": "camera.json"}),
        (untrusted("prior_contradicted"), priors.TurntablePrior(25.0, 2.0), {"step_sigma_deg": "6"}),
        (untrusted("prior_contradicted"), priors.TablePrior(), {"prior": "general"}),
        (untrusted("left_out", "colour_misaligned", "loop_open"), priors.TablePrior(), {"no_colour": ""}),
        (untrusted("never_came_back"), priors.GeneralPrior(), None),
        (
            untrusted("left_out", turn_deg=48.0, outcome=Outcome.AT_LIMIT),
            priors.GeneralPrior(),
            {"max_rotation_deg": "100"},
        ),
        (
            untrusted("left_out", turn_deg=10.0, outcome=Outcome.AT_LIMIT),
            priors.TablePrior(max_shift_m=0.05),
            {"max_shift_m": "0.1"},
        ),
        (
            untrusted("left_out", turn_deg=10.0, outcome=Outcome.AT_LIMIT),
            priors.GeneralPrior(max_offset_m=0.04),
            {"max_offset_m": "0.08"},
        ),
        (untrusted("left_out", outcome=Outcome.NO_OVERLAP), priors.GeneralPrior(), None),
    ],
)
def test_what_to_do_next_is_the_limit_that_was_hit_or_what_is_missing(
    report: dict[str, Any], prior: AbstractPrior, options: Any
) -> None:
    every = remedies(report, prior)
    if options is None:
        assert every == []
    else:
        (found,) = every
        assert set(options) <= set(found.parameters)
        assert ("max_rotation_deg" in found.parameters) is ("max_rotation_deg" in options)
        if isinstance(options, dict):
            assert options.items() <= found.parameters.items()


@pytest.mark.parametrize(
    ("turn_deg", "facts", "said"),
    [
        (150.0, {"trustworthy": True}, "1.5°"),
        (150.0, {"trustworthy": True, "closed": True}, ""),  # the loop checks it
        (150.0, {"trustworthy": False}, ""),  # there are other reasons to look at first
        (60.0, {"trustworthy": True}, ""),
    ],
)
def test_a_turn_without_a_loop_tells_what_hangs_on_the_focal_length(
    turn_deg: float, facts: dict[str, Any], said: str
) -> None:
    words = unchecked_focal_length(untrusted(turn_deg=turn_deg, **facts))
    assert said in words
    assert bool(words) is bool(said)


@pytest.mark.parametrize(("closed", "first"), [(True, "modeler report"), (False, "")])
def test_surface_that_is_not_there_leads_to_the_masks_where_a_loop_confirms_the_poses(closed: bool, first: str) -> None:
    report = untrusted("free_space_violations", "false_surface", closed=closed, up=[0.0, -1.0, 0.0])
    (found,) = remedies(report, priors.GeneralPrior())
    assert found.first.startswith(first)
    assert bool(found.parameters) is not closed


@pytest.mark.parametrize(
    ("codes", "frames", "lost", "contradicted", "dropped"),
    [
        (("free_space_violations", "false_surface"), 12, (), (3, 7), "3,7"),
        (("left_out",), 12, (5,), (), "5"),
        (("left_out", "false_surface"), 12, (5,), (3,), "3,5"),
        (("false_surface",), 12, (), (1, 2, 3, 4), None),  # more than a quarter
        (("left_out", "other_modes"), 12, (5,), (), None),  # others may be wrong
        ((), 12, (5,), (), None),  # between two segments
    ],
)
def test_few_frames_that_are_lost_or_contradict_others_can_be_taken_out(
    codes: tuple[str, ...], frames: int, lost: tuple[int, ...], contradicted: tuple[int, ...], dropped: str | None
) -> None:
    records = [
        {"id": k, "outcome": "no overlap" if k in lost else ACCEPTED, "cause": "no overlap" if k in lost else ""}
        for k in range(frames)
    ]
    report = untrusted(*codes, contradicted={str(k): {} for k in contradicted}) | {"frames": records}
    first = [one.first for one in remedies(report, priors.GeneralPrior()) if "edit" in one.first]
    assert first == ([] if dropped is None else [f"modeler edit {{run}} `drop` {dropped} `out` {{run}}_edited"])


def test_a_size_that_is_not_known_has_a_remedy_of_its_own() -> None:
    report = untrusted("false_surface", "unsure_size", closed=True)
    masks, size = remedies(report, priors.GeneralPrior())
    assert masks.first.startswith("modeler report")
    assert "`known` focal-length" in size.first
    assert [one.first for one in remedies(untrusted("unsure_size"), priors.GeneralPrior())] == [size.first]


def test_a_loop_that_is_open_leads_to_the_focal_length() -> None:
    report = untrusted("loop_open", "edges_disagree")
    report["edges"].append(report["edges"][0] | {"kind": "closure"})
    (found,) = remedies(report, priors.GeneralPrior())
    assert found.first.startswith("modeler calibrate-camera")
    assert found.parameters == {"camera": "camera.json"}
    for factor, again in ((0.97, True), (0.995, False)):  # known to 1 %: the second was estimated before
        report["camera"] = {"loops": 3, "factor_in_run": factor, "focal_factor_sigma": 0.01}
        (found,) = remedies(report, priors.GeneralPrior())
        assert found.first.startswith("modeler calibrate-camera") is again
        assert bool(found.parameters) is again


@pytest.mark.parametrize(("sds", "said"), [(2.9, False), (3.3, True)])
def test_a_focal_length_that_contradicts_the_given_one_is_named_with_its_causes(sds: float, *, said: bool) -> None:
    camera = {"fx_px": 268.7, "factor_in_run": 268.7 / 287.5, "focal_factor_sigma": 0.004, "loops": 9}
    camera |= {"sigmas_after": 1.1, "sigmas_before": 6.0, "given_sds": sds}
    words = estimated_focal_length(camera)
    assert words.startswith("the focal length is 268.7 ± 1.1 px, 287.5 px was given")
    assert ("contradicts the given one by 3.3" in words, "along the ray" in words) == (said, said)


def test_the_command_to_try_keeps_what_was_given() -> None:
    build = Build(Path("a b"), Path("run"), prior=PriorOptions(prior="table", max_shift_m=0.1))
    assert build.command({"roi": "1 2 3 4"}) == (
        "modeler build 'a b' --out run --overwrite --prior table --max-shift-m 0.1 --roi 1 2 3 4"
    )
    assert build.command({"prior": "general"}) == "modeler build 'a b' --out run --overwrite --prior general"
    build = Build(
        Path("a"), Path("run"), where=ObjectOptions(roi=(1, 2, 3, 4)), method=MethodOptions(seed=3, colour=False)
    )
    assert build.command({}) == "modeler build a --out run --overwrite --roi 1 2 3 4 --no-colour --seed 3"


def test_messages_name_parameters_and_options_that_exist() -> None:
    """Parameters stand in backticks, options behind two hyphens, in every text of the sources that is no docstring."""
    options = {option.removeprefix("--") for option in _options().values()} | {"help", "version", "purpose"}
    unknown = set()
    for path in SOURCES:
        if path.name in ("messages.py", "viewer.py"):  # options of all commands, and those of Rerun
            continue
        given = {id(node.value) for node in ast.walk(tree(path)) if isinstance(node, ast.Expr)}
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in given:
                named = re.findall(r"`(\w+)`", node.value)
                named += re.findall(r"(?<![\w-])--([a-z][a-z0-9-]+)", node.value)
                unknown |= {(path.name, name) for name in named if name.replace("_", "-") not in options}
    assert unknown == {
        ("jobs.py", "log"),
        ("videos.py", "depth-mode"),
        ("manifest.py", "no-colour"),
    }  # of all commands; of another program; a flag's other side

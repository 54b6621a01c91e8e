"""Help says what there is, and nothing else."""

import contextlib
import dataclasses
import io
import re

import pytest
from command_runner import Run, spawned

from modeler import priors
from modeler.cli import main, parsed
from modeler.cli.overview import SUMMARIES, command_class
from modeler.composition.options import PriorOptions

COMMANDS = (
    "build batch gallery register evaluate render view report export join info convert calibrate-sensor "
    "calibrate-camera suggest track edit studio"
).split()
DOCUMENTED = """out prior seed resume overwrite every frames roi max-depth-m max-rotation-deg max-offset-m max-shift-m
step-deg step-sigma-deg held-sigma-deg held-sigma-m
method view web"""


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_on_stdout(cli: Run, command: str) -> None:
    assert re.search(rf"\b{command}\b", cli("--help").out)
    ended = cli(command, "--help")
    assert (ended.status, ended.err) == (0, "")
    assert ended.out.startswith(f"usage: modeler {command}")


def test_help_of_the_program_tells_each_command_in_a_sentence_and_a_command_tells_all(cli: Run) -> None:
    overall, single = (" ".join(cli(*words, "--help").out.replace("│", " ").split()) for words in ((), ("build",)))
    for text in (overall, single):
        assert "Build the model of an object from a sequence: register its frames, close loops, fuse." in text
    assert "Ctrl-C" in single
    assert "Ctrl-C" not in overall


def test_help_of_the_program_has_the_first_sentence_of_each_command_without_importing_it() -> None:
    assert set(SUMMARIES) == set(COMMANDS)
    for name, summary in SUMMARIES.items():
        assert " ".join((command_class(name).__doc__ or "").split("\n\n")[0].split()) == summary
    script = "import atexit, sys; atexit.register(lambda: print('tyro' in sys.modules)); import modeler.cli as cli; "
    assert spawned("-c", f"{script} cli.main(['--help'])").out.endswith("False\n")


def test_help_may_be_asked_for_in_a_word(cli: Run) -> None:
    assert cli("help") == cli("--help")
    assert cli("help", "build") == cli("build", "--help")
    assert cli("help", "nonsense") == cli("--help")


@pytest.mark.parametrize("command", ["build", "batch", "register", "evaluate", "render", "join"])
def test_every_command_that_draws_at_random_takes_a_seed(cli: Run, command: str) -> None:
    folders = {"register": ("S", "1", "0"), "join": ("A", "B")}.get(command, ("S",))
    out = () if command == "register" else ("--out", "OUT")
    assert parsed((command, *folders, *out, "--seed", "7")) != parsed((command, *folders, *out, "--seed", "8"))
    for seed in ("-1", "one", "1.5", "NaN"):
        ended = cli(command, *folders, *out, "--seed", seed)
        assert (ended.status, ended.out) == (2, "")
        assert "--seed" in ended.err
        assert f"'{seed}'" in ended.err
        assert f"modeler {command} --help" in ended.err


@pytest.mark.parametrize(
    "command", ["info", "convert", "calibrate-sensor", "calibrate-camera", "view", "report", "export", "gallery"]
)
def test_commands_without_randomness_take_no_seed(cli: Run, command: str) -> None:
    assert "--seed" not in cli(command, "--help").out


@pytest.fixture(scope="module")
def build_help() -> str:
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.suppress(SystemExit):
        main(["build", "--help"])
    return said.getvalue()


@pytest.mark.parametrize("option", DOCUMENTED.split())
def test_build_offers_what_is_documented(build_help: str, option: str) -> None:
    assert re.search(rf"^\W* --{option}\b", build_help, re.MULTILINE)


def test_help_imports_nothing_heavy() -> None:
    heavy = "av gtsam matplotlib numba numpy open3d pyrealsense2 rerun rosbags scipy trimesh".split()
    script = f"""
import contextlib, sys
from modeler.cli import main
for command in {COMMANDS}:
    with contextlib.suppress(SystemExit):
        main([command, "--help"])
sys.exit(", ".join(sorted(set({heavy}) & set(sys.modules))) or None)
"""
    ended = spawned("-c", script)
    assert (ended.status, ended.err) == (0, "")


@pytest.mark.parametrize("name", [field.name for field in dataclasses.fields(PriorOptions) if field.name != "prior"])
def test_defaults_stated_in_help_are_those_of_the_priors(build_help: str, name: str) -> None:
    words = " ".join(build_help.replace("│", " ").split())
    given = re.search(rf"--{name.replace('_', '-')} .*?\(default: (\S+)\)", words)
    defaults = {
        field.default
        for prior in vars(priors).values()
        if isinstance(prior, type) and dataclasses.is_dataclass(prior)
        for field in dataclasses.fields(prior)
        if field.name == name and isinstance(field.default, float)
    }
    numbers = {float(given[1])} if re.fullmatch(r"[0-9.]+", given[1]) and defaults else set()
    assert numbers == defaults


def test_the_version_is_reported(cli: Run) -> None:
    ended = cli("--version")
    assert (ended.status, ended.err) == (0, "")
    assert re.fullmatch(r"modeler \d+\.\d+\.\d+\n", ended.out)

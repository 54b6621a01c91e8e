"""A run that is killed is taken up where it was: the same bytes, and no pair registered twice but the one under way."""

import json
import os
import shutil
import signal
from collections.abc import Callable
from dataclasses import fields, replace
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_runner import Run, spawned

from modeler.baselines import IcpRegistrar
from modeler.cli import build, main
from modeler.export import PairCache, Pairs, RunFolder, RunMeta, locked
from modeler.priors import GeneralPrior
from modeler.sequences import bundled, open_sequence, write_bop
from modeler.types import Frame, InputError, Mode, Outcome, PoseGaussian, Posterior, RayImage, ViewPair
from modeler.views import Sensor
from studies.formats.image_folders import small_frames, small_truth
from studies.kills.commands import COMMANDS, CommandTrials, write_inputs
from studies.kills.trials import KINDS, SAME, Trials

BOX = str(bundled("box"))
QUICK = ("--prior", "table", "--method", "icp", "--frames", "0:3")


@pytest.fixture(scope="module")
def whole(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("whole") / "run"
    assert main(["build", str(scene), "--out", str(folder), *QUICK]) == 0
    return folder


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    """Return a list to which every registration is added."""
    pairs, posterior_of = [], IcpRegistrar.posterior_of

    def noted(self: IcpRegistrar, pair: ViewPair) -> Posterior:
        pairs.append((pair.source.index, pair.target.index))
        return posterior_of(self, pair)

    monkeypatch.setattr(IcpRegistrar, "posterior_of", noted)
    return pairs


def contents(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in SAME}


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def pairs_of(run: Path) -> set[tuple[int, int]]:
    return {(edge["source"], edge["target"]) for edge in RunFolder(run).report()["edges"]}


KILLED_AT_THE_FIRST_PAIR = """
import os, signal, sys
from modeler.cli import main
from modeler.export import Pairs

def kept(pairs, *what, keep=Pairs.keep):
    keep(pairs, *what)
    os.kill(os.getpid(), signal.SIGKILL)

Pairs.keep = kept
main(sys.argv[1:])
"""


def test_a_killed_run_is_taken_up(scene: Path, whole: Path, tmp_path: Path, asked: list[tuple[int, int]]) -> None:
    folder, kept = tmp_path / "run", tmp_path / "run" / ".pairs"
    command = ["build", str(scene), "--out", str(folder), *QUICK]
    assert spawned("-c", KILLED_AT_THE_FIRST_PAIR, *command).status == -signal.SIGKILL
    assert not json.loads((folder / "report.json").read_bytes())["complete"]
    (pair,) = (tuple(map(int, path.name.split("-")[:2])) for path in kept.glob("*.pair"))
    assert main(command) == 2  # neither --resume nor --overwrite
    assert main([*command, "--resume", "--seed", "1"]) == 2
    assert asked == []
    assert main([*command, "--resume"]) == 0
    assert sorted(asked) == sorted(pairs_of(whole) - {pair})
    assert contents(folder) == contents(whole)
    assert names(folder) == names(whole)


GONE: dict[str, Callable[[Path], object]] = {
    "renamed": lambda run: run.rename(run.with_name("other")),
    "removed": shutil.rmtree,
    "without recording": lambda run: (run / "recording.rrd").unlink(),
}


@pytest.mark.parametrize("how", GONE)
def test_what_goes_away_during_a_build_takes_no_result_with_it(
    scene: Path, whole: Path, tmp_path: Path, how: str, monkeypatch: pytest.MonkeyPatch, caplog: Any
) -> None:
    run, write = tmp_path / "run", RunFolder.write

    def after(self: RunFolder, step: Any, meta: RunMeta) -> dict:
        if step.frame.index == 1:
            GONE[how](run)
        return write(self, step, meta)

    monkeypatch.setattr(RunFolder, "write", after)
    assert main(["build", str(scene), "--out", str(run), *QUICK]) == 0
    assert contents(run) == contents(whole)
    assert RunFolder(run).report()["complete"]
    assert names(run) == names(whole)
    assert f"{run / 'recording.rrd'}: was moved or removed" in caplog.text


def test_a_run_that_had_ended_is_not_made_again(
    scene: Path, whole: Path, asked: list[tuple[int, int]], cli: Run
) -> None:
    before = {path.name: path.stat().st_mtime_ns for path in whole.iterdir()}
    ended = cli("build", scene, "--out", whole, *QUICK, "--resume")
    assert (ended.status, "--overwrite" in ended.err) == (0, True)
    assert ({path.name: path.stat().st_mtime_ns for path in whole.iterdir()}, asked) == (before, [])


def test_a_run_whose_report_is_damaged_is_not_resumed(
    scene: Path, whole: Path, tmp_path: Path, refusal: Callable[..., str]
) -> None:
    report = RunFolder(whole).report()
    del report["poses"]
    (tmp_path / "report.json").write_text(json.dumps(report))
    said = refusal("build", scene, "--out", tmp_path, *QUICK, "--resume")
    assert said.startswith(f"modeler: {tmp_path / 'report.json'}: 'poses' is missing")


def test_ctrl_c_leaves_a_model_of_the_frames_so_far_and_the_rest_can_follow(
    scene: Path, whole: Path, tmp_path: Path, asked: list[tuple[int, int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, write = tmp_path / "run", RunFolder.write

    def pressed(self: RunFolder, step: Any, meta: RunMeta) -> dict:
        if step.frame.index == 0:
            signal.raise_signal(signal.SIGINT)
        return write(self, step, meta)

    with monkeypatch.context() as patch:
        patch.setattr(RunFolder, "write", pressed)
        assert main(["build", str(scene), "--out", str(folder), *QUICK]) == 3
    report = RunFolder(folder).report()
    assert not report["complete"]
    assert report["reason_codes"][0] == "interrupted"
    assert (folder / "model.ply").stat().st_size > 1000
    count = len(asked)
    before = set(asked)
    assert count >= 1
    assert main(["build", str(scene), "--out", str(folder), *QUICK, "--resume"]) == 0
    assert sorted(asked[count:]) == sorted(pairs_of(whole) - before)
    assert contents(folder) == contents(whole)


def test_a_run_that_other_versions_began_is_registered_anew(
    scene: Path, whole: Path, tmp_path: Path, asked: list[tuple[int, int]], monkeypatch: pytest.MonkeyPatch, cli: Run
) -> None:
    folder, version = tmp_path / "run", metadata.version
    with monkeypatch.context() as patch:
        patch.setattr(Pairs, "complete", lambda pairs: None)
        patch.setattr(metadata, "version", lambda name: "0.0.1" if name in ("modeler", "numpy") else version(name))
        assert main(["build", str(scene), "--out", str(folder), *QUICK]) == 0
    assert len(list((folder / ".pairs").iterdir())) == len(pairs_of(whole))
    asked.clear()
    ended = cli("build", scene, "--out", folder, *QUICK, "--resume")
    assert (ended.status, "modeler 0.0.1, numpy 0.0.1" in ended.err) == (0, True)
    assert set(asked) == pairs_of(whole)
    assert contents(folder) == contents(whole)


def test_only_pairs_of_new_or_changed_frames_are_registered(cli: Run, tmp_path: Path) -> None:
    """Frames are compared by their content, and named."""
    frames, folder, run = small_frames(4), tmp_path / "s", tmp_path / "run"
    command = ["build", folder, "--prior", "table", "--method", "icp", "--out", run, "--resume"]

    def pairs_after(kept: list[Frame]) -> tuple[set[tuple[int, int]], str]:
        """Return the pairs that were registered for some frames, and what was said."""
        before = {path.name for path in run.glob(".pairs.done/*")}
        shutil.rmtree(folder, ignore_errors=True)
        write_bop(folder, kept, small_truth(4), depth_scale_mm=1.0)
        ended = cli(*command)
        assert ended.status in (0, 3), ended.err
        made = {path.name for path in run.glob(".pairs.done/*")} - before
        return {(int(name[:6]), int(name[7:13])) for name in made}, ended.err

    first, _ = pairs_after(frames[:2])
    assert first == {(1, 0)}
    more, said = pairs_after(frames)
    assert {source for source, _ in more} == {2, 3}
    assert "frames 2, 3 are new" in said
    changed = [*frames[:3], replace(frames[3], depth_m=frames[3].depth_m + np.float32(0.001))]
    other, said = pairs_after(changed)
    assert {source for source, _ in other} == {3}
    assert "frame 3 is changed" in said
    rest, said = pairs_after(changed[:3])
    assert rest.isdisjoint(first | more)  # to a frame that is the last now, perhaps
    assert "frame 3 is gone" in said


def test_what_is_said_to_be_saved_is_on_the_disk(
    scene: Path, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each file is brought to the disk before it takes its place, and the folder's list of names after that."""
    done: list[tuple[str, str]] = []
    fsync, swap = os.fsync, os.replace

    def synced(number: int) -> None:
        done.append(("synced", Path(os.readlink(f"/proc/self/fd/{number}")).name))
        fsync(number)

    def replaced(source: Path, target: Path) -> None:
        done.append(("replaced", target.name))
        swap(source, target)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(os, "replace", replaced)
    assert main(["build", str(scene), "--out", str(tmp_path / "run"), *QUICK]) == 0
    monkeypatch.undo()
    final = done[done.index(("replaced", "cloud.ply")) - 20 :]
    order = [name for what, name in final if what == "replaced"][-6:]
    assert order == ["trajectory.txt", "odometry.txt", "graph.g2o", "cloud.ply", "model.ply", "report.json"]
    for name in order:
        place = len(final) - 1 - final[::-1].index(("replaced", name))
        assert any(what == "synced" and part.startswith(f".{name}.") for what, part in final[:place])
        assert ("synced", "run") in final[place:]
    assert ("synced", "recording.rrd") in final
    kept = [name for what, name in done if what == "replaced" and name.endswith(".pair")]
    assert len(kept) == len(pairs_of(whole))
    assert {("synced", name) for name in kept} <= set(done)


def test_ctrl_c_before_the_first_frame_ends_the_program(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Pressed(build.Interrupt):
        @property
        def asked(self) -> bool:
            return True

        def until(self, items: Any) -> Any:
            return iter(())

    monkeypatch.setattr(build, "Interrupt", Pressed)
    assert main(["build", str(scene), "--out", str(tmp_path / "run"), *QUICK]) == 130


def test_two_runs_do_not_write_into_one_folder(scene: Path, tmp_path: Path, refusal: Callable[..., str]) -> None:
    with locked(tmp_path / "run"):
        for flag in ("--resume", "--overwrite"):
            said = refusal("build", scene, "--out", tmp_path / "run", *QUICK, flag)
            assert "another run is writing to it" in said
    with locked(tmp_path / "run"):
        assert list((tmp_path / "run").iterdir()) == []
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="choose another place"), locked(tmp_path / "file"):
        pass


def posterior(rng: np.random.Generator) -> Posterior:
    """Return one with everything that a posterior may have."""
    gaussian = PoseGaussian(rng.normal(size=(4, 4)), rng.normal(size=(6, 6)))
    return Posterior(
        source=7,
        target=3,
        pose=gaussian,
        outcome=Outcome.AMBIGUOUS,
        overlap=0.3,
        samples=rng.normal(size=(5, 4, 4)),
        weights=rng.random(5),
        modes=(Mode(0.75, gaussian), Mode(0.25, gaussian.inverse())),
        effective_samples=float("nan"),
        pareto_k=float("inf"),
        log_marginal_likelihood=-float("inf"),
        seconds=0.1,
        least_overlap=0.35,
    )


KEY = ("views", "prior")


@pytest.mark.parametrize("bare", [False, True])
def test_what_is_kept_comes_back_to_the_bit(tmp_path: Path, rng: np.random.Generator, bare: bool) -> None:
    pairs, kept = Pairs(tmp_path / "pairs"), posterior(rng)
    if bare:
        kept = replace(kept, modes=(), samples=np.zeros((0, 4, 4)), weights=np.zeros(0))
    pairs.keep(kept, KEY)
    back = pairs.get(7, 3, KEY)
    assert len(back.modes) == len(kept.modes)
    for field in fields(Posterior):
        if field.name not in ("pose", "modes"):
            np.testing.assert_equal(getattr(back, field.name), getattr(kept, field.name))
    assert [mode.weight for mode in back.modes] == [mode.weight for mode in kept.modes]
    gaussians = [
        (back.pose, kept.pose),
        *((ours.pose, theirs.pose) for ours, theirs in zip(back.modes, kept.modes, strict=True)),
    ]
    for ours, theirs in gaussians:
        assert (ours.mean.tobytes(), ours.covariance.tobytes()) == (theirs.mean.tobytes(), theirs.covariance.tobytes())
    for other in ((7, 2, KEY), (6, 3, KEY), (7, 3, ("others", "prior"))):
        assert pairs.get(*other) is None
    pairs.complete()
    pairs.complete()
    assert not pairs.marked
    assert pairs.get(7, 3, ("others", "prior")) is None
    for key in (KEY, (KEY[0], "of more frames")):
        assert pairs.get(7, 3, key) is not None
    pairs.mark()
    pairs.empty()
    assert pairs.get(7, 3, KEY) is None
    assert list(tmp_path.iterdir()) == [pairs.folder]


def test_what_is_kept_and_broken_counts_as_lost(tmp_path: Path, rng: np.random.Generator) -> None:
    pairs = Pairs(tmp_path / "pairs")
    pairs.keep(posterior(rng), KEY)
    (file,) = pairs.folder.iterdir()
    content = file.read_bytes()
    for cut in (0, 10, len(content) // 2, len(content) - 3):
        file.write_bytes(content[:cut])
        assert pairs.get(7, 3, KEY) is None
    for place in rng.integers(0, 8 * len(content), 200):
        flipped = bytearray(content)
        flipped[place // 8] ^= 1 << (place % 8)
        file.write_bytes(flipped)
        assert pairs.get(7, 3, KEY) is None
    np.savez(file, mean=np.array([{}], dtype=object), allow_pickle=True)  # nothing is unpickled
    assert pairs.get(7, 3, KEY) is None
    Pairs(tmp_path / "file" / "pairs").keep(posterior(rng), KEY)  # nowhere to keep it: no fault


def test_a_cached_registration_is_that_of_the_same_inputs_only(tmp_path: Path, asked: list[tuple[int, int]]) -> None:
    frames = [open_sequence(BOX).frame(index) for index in (0, 1)]
    views = [Sensor().ray_image(frame, None) for frame in frames]
    nearer = Sensor().ray_image(replace(frames[0], depth_m=frames[0].depth_m - np.float32(0.001)), None)
    priors = [GeneralPrior(), GeneralPrior().relaxed(2)]
    cache = PairCache(Pairs(tmp_path), {})

    def ask(target: RayImage, prior: int = 0, seed: int = 0, effort: float = 1.0) -> int:
        density = priors[prior].between(views[1], target)
        pair = ViewPair(views[1], target, density, np.random.default_rng(seed), effort)
        cache.posterior_of(IcpRegistrar(), pair)
        return len(asked)

    assert [ask(views[0]), ask(views[0])] == [1, 1]
    assert [ask(views[0], prior=1), ask(views[0], prior=1)] == [2, 2]
    assert [ask(views[0], seed=1), ask(nearer), ask(views[0])] == [3, 4, 4]
    assert [ask(views[0], effort=0.25), ask(views[0])] == [5, 5]


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_killed_at_random_moments(tmp_path: Path, rng: np.random.Generator) -> None:
    trials = Trials((BOX, *QUICK), tmp_path)
    whole = trials.undisturbed()
    for kind in KINDS:
        assert trials.fault(whole, kind, kind, rng)[1] in ("", "it had ended before it was to be killed")


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("commands") / "inputs"
    folder.mkdir()
    write_inputs(folder)
    return folder


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_that_was_killed_is_given_again(inputs: Path, name: str) -> None:
    """Before the first change of the disk, one in the middle, and the last."""
    trials = CommandTrials(inputs, name)
    whole, changes = trials.undisturbed()
    assert whole
    moments = sorted({1, (changes + 1) // 2, changes})
    assert {change: trials.fault(change, whole) for change in moments} == dict.fromkeys(moments, "")

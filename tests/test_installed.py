"""The package as users install it: outside the repository, and on systems other than Linux."""

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import venv
from importlib import metadata
from pathlib import Path

import pytest
from command_runner import FILES, refusal_of, spawned
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from source_trees import ROOT

LINUX_ONLY = ("sched_getaffinity", "sched_setaffinity", "posix_fadvise", "posix_fallocate", "copy_file_range", "pipe2")
"""Functions of `os` that macOS lacks."""


def test_every_module_is_imported_and_cores_are_counted_without_what_only_linux_has() -> None:
    code = f"""
import importlib, os, pkgutil
for name in {LINUX_ONLY}:
    if hasattr(os, name):
        delattr(os, name)
import modeler
from modeler.system.processes import cores, is_parallel
os.environ.pop("NUMBA_NUM_THREADS", None)
assert cores() == os.cpu_count()
assert is_parallel() == (cores() > 1)
for module in pkgutil.walk_packages(modeler.__path__, "modeler."):
    try:
        importlib.import_module(module.name)
    except ModuleNotFoundError as error:  # of an extra that is not installed
        if str(error.name).startswith("modeler"):
            raise
"""
    ended = spawned("-c", code)
    assert (ended.status, ended.err) == (0, "")


WITHOUT = """
import sys
class Refusing:
    def find_spec(name, path=None, target=None):
        if name.partition(".")[0] in sys.argv[1].split(","):
            raise ModuleNotFoundError(name=name)
sys.meta_path.insert(0, Refusing)
from modeler.cli import main
sys.exit(main(sys.argv[2:]))
"""


def with_requirements(names: set[str]) -> set[str]:
    """Return distributions with all that they require."""
    required = {
        canonicalize_name(requirement.name)
        for name in names
        for requirement in map(Requirement, metadata.requires(name) or ())
        if requirement.marker is None or requirement.marker.evaluate({"extra": ""})
    }
    return names if required <= names else with_requirements(names | required)


def test_only_what_this_system_needs_is_required(monkeypatch: pytest.MonkeyPatch) -> None:
    listed = {
        "a": ["B_c>=1", 'colorama; platform_system == "Windows"', "win; sys_platform == 'win32' and extra == 'all'"],
        "b-c": None,
    }
    monkeypatch.setattr(metadata, "requires", listed.__getitem__)  # raises for a package that is not there
    assert with_requirements({"a"}) == {"a", "b-c"}


def test_the_demonstration_runs_on_what_is_installed_for_it(scene: Path, tmp_path: Path) -> None:
    listed = re.findall(r'^(?:modelling|showing)="(.*?)"', (ROOT / ".ci" / "setup").read_text(), re.MULTILINE)
    assert len(listed) == 2
    needed = with_requirements({*" ".join(listed).split()})
    modules = metadata.packages_distributions()
    refused = [
        module for module, (owner, *_) in modules.items() if owner.lower().replace("_", "-") not in {*needed, "modeler"}
    ]
    assert {"open3d", "matplotlib", "trimesh", "hypothesis"} <= {*refused}
    command = ("-c", WITHOUT, ",".join(refused))
    built = spawned(*command, "build", scene, "--prior", "table", "--out", tmp_path / "run")
    assert built.status in (0, 3), built.err
    said = refusal_of(spawned(*command, "report", tmp_path / "run"))
    assert re.search(r"the package \w+ is not installed, which this command needs; run make setup", said)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_an_installed_package_builds_a_bundled_sequence_from_another_folder(tmp_path: Path) -> None:
    """`pip install .` of a copy into a new environment; the dependencies are those of the running one."""
    source, home, elsewhere = tmp_path / "source", tmp_path / "environment", tmp_path / "elsewhere"
    for name in ("modeler", "sequences", "viz"):
        shutil.copytree(ROOT / name, source / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    (source / "docs").mkdir()
    for name in ("pyproject.toml", "LICENSE", "docs/package.md"):
        shutil.copy(ROOT / name, source / name)
    elsewhere.mkdir()
    venv.create(home)
    python = home / "bin" / "python"
    packages = Path(sysconfig.get_path("purelib", vars={"base": str(home), "platbase": str(home)}))
    (packages / "dependencies.pth").write_text(f"{sysconfig.get_path('purelib')}\n")
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "PYTHONHOME")}

    def run(*command: object) -> subprocess.CompletedProcess[str]:
        words = [str(word) for word in command]
        return subprocess.run(words, cwd=elsewhere, env=environment, capture_output=True, text=True, check=False)

    installed = run(sys.executable, "-m", "pip", "--python", python, "install", "--no-deps", "--quiet", source)
    if "No matching distribution found for setuptools" in installed.stderr:
        pytest.skip("no package index with the build system can be reached")
    assert installed.returncode == 0, installed.stderr
    assert {path.name for path in packages.iterdir()} - {"__pycache__", "dependencies.pth"} == {
        "modeler",
        f"modeler-{run(home / 'bin' / 'modeler', '--version').stdout.split()[-1]}.dist-info",
    }
    box = Path(run(python, "-c", "from modeler.sequences import bundled; print(bundled('box'))").stdout.strip())
    assert box.is_relative_to(packages)
    built = run(home / "bin" / "modeler", "build", box, "--out", "runs/box", "--prior", "table", "--frames", "0:4")
    assert built.returncode in (0, 3), built.stderr
    assert {path.name for path in (elsewhere / "runs" / "box").iterdir()} >= FILES
    used = run(python, "-c", "import modeler; print(modeler.open_sequence.__module__, modeler.__file__)").stdout.split()
    assert used[0] == "modeler.sequences.opening"
    assert Path(used[1]).is_relative_to(packages)

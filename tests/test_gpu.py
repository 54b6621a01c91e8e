"""What Warp evaluates against the kernels of Numba: on the CPU wherever Warp is, and on a CUDA device where one is."""

import ctypes
import importlib.util
import runpy
import sys

import numpy as np
import pytest
import tabletop
from test_free_space import NOISES, scene
from test_kernels import random_pose

from modeler.baselines import PaperRegistrar
from modeler.baselines.paper import FreeSpace, NumberedDraws, measured
from modeler.kernels import gpu, paper
from modeler.priors import GeneralPrior, TablePrior
from modeler.se3 import rows
from modeler.sequences import bundled
from modeler.types import Plane, SensorNoise
from modeler.views import Sensor

with_warp = pytest.mark.skipif(importlib.util.find_spec("warp") is None, reason="warp-lang is not installed")
BOX, POSES = tabletop.Box((0.05, 0.08, 0.035)), tabletop.turntable(24)[2:4]


def standing(index):
    """Return a view of the box on its table, with depth noise, in which the table is known."""
    pose = POSES[index]
    up = pose[:3, 2]
    plane = Plane(up, -float(up @ (pose @ [0.0, 0.0, -BOX.depth_m, 1.0])[:3]), 5e-3, 5e-4)
    frame = tabletop.view(BOX, pose, index, rng=np.random.default_rng(index)).frame
    return Sensor(SensorNoise(0.002, 0.001)).ray_image(frame, plane)


@pytest.fixture(params=["warp-cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request):
    """Where registrars evaluate."""
    pytest.importorskip("warp", exc_type=ImportError)
    if request.param == "cuda" and (fault := gpu.missing()) is not None:
        pytest.skip(fault)
    gpu.warp()
    return request.param


@pytest.mark.parametrize("noise", NOISES.values(), ids=NOISES.keys())
def test_the_papers_likelihood_and_nearest_ranges_are_those_of_numba(device, noise, rng):
    from modeler.kernels.gpu.paper import OnDevice, nearest_ranges

    there = gpu.chosen(device, 1) or ""
    source, target = (scene(rng, noise, gaps=0.5) for _ in range(2))
    reach_px = np.array([3.7, 5.2])
    np.testing.assert_array_equal(
        nearest_ranges(target.ranges_m, reach_px, there), paper.nearest_ranges(target.ranges_m, reach_px)
    )
    poses = rows(np.stack([random_pose(rng, 0.1) for _ in range(200)]))
    free = FreeSpace.of(source, target, 4.0, 1e-6)
    views = [(view.points_m, view.ranges_m, view.intrinsics, view.noise) for view in (source, target)]
    on_device = OnDevice.of(there, views, (free.checks, free.near_m, free.images), (4.0, 0.0))
    want, got = PaperRegistrar(reject_below=0.0).log_weights(poses, (source, target)), on_device.log_likelihoods(poses)
    assert np.isfinite(want).any()
    np.testing.assert_allclose(got, want, rtol=1e-9)  # -inf where it is -inf


def test_the_papers_draws_that_pass_are_those_of_numba_in_their_order(device, rng, monkeypatch):
    from modeler.kernels.gpu import paper as on_gpu

    monkeypatch.setattr(on_gpu, "AT_ONCE", 3000)  # several launches, the last one short
    source, target = (measured(standing(index), 12, rng) for index in (1, 0))
    draws = NumberedDraws.of(GeneralPrior(25.0, 0.02).between(standing(1), standing(0)), np.random.default_rng(3))
    free = FreeSpace.of(source, target, 4.0, 1e-6).ordered(draws.poses(0, 500))
    views = [(view.points_m, view.ranges_m, view.intrinsics, view.noise) for view in (source, target)]
    there = on_gpu.OnDevice.of(gpu.chosen(device, 1) or "", views, (free.checks, free.near_m, free.images), (4.0, 1e-6))
    tried, got, found = zip(*there.weighted_draws(10_000, draws.seed, draws.limits), strict=True)
    poses = draws.poses(0, 10_000)
    passing = poses[free.passes(poses)]
    values = PaperRegistrar().log_weights(passing, (source, target))
    assert sum(tried) == 10_000
    assert 10 < np.isfinite(values).sum() < len(passing) < 5000
    np.testing.assert_allclose(np.concatenate(got), passing[np.isfinite(values)], atol=1e-12)
    np.testing.assert_allclose(np.concatenate(found), values[np.isfinite(values)], rtol=1e-9)


@pytest.mark.parametrize("prior", [GeneralPrior(25.0, 0.02), TablePrior()], ids=["general", "table"])
def test_the_paper_registers_alike_on_a_device(device, prior):
    target, source = standing(0), standing(1)
    cpu, there = (
        PaperRegistrar(samples=100_000, points=25, device=where).register(
            source, target, prior.between(source, target), rng=np.random.default_rng(0)
        )
        for where in ("cpu", device)
    )
    assert len(cpu.samples) > 1
    np.testing.assert_allclose(there.samples, cpu.samples, atol=1e-12)
    np.testing.assert_allclose(there.weights, cpu.weights, rtol=1e-8)


def test_a_device_is_chosen_for_large_work_only(monkeypatch):
    monkeypatch.setattr(gpu, "missing", lambda: None)
    assert gpu.chosen("auto", gpu.LARGE) == "cuda"
    assert gpu.chosen("auto", gpu.LARGE - 1) is None
    assert gpu.chosen("cpu", gpu.LARGE) is None
    monkeypatch.setattr(gpu, "missing", lambda: "nothing there")
    assert gpu.chosen("auto", gpu.LARGE) is None


@pytest.mark.parametrize(
    ("absent", "line"),
    [
        ("warp", f"warp-lang is not installed; {sys.executable} -m pip install 'modeler[gpu]'"),
        ("driver", "there is no NVIDIA driver"),
    ],
)
def test_a_device_that_is_not_there_is_refused_in_one_line(cli, monkeypatch, absent, line):
    load = ctypes.CDLL

    def no_driver(name, *arguments):
        if name == "libcuda.so.1":
            raise OSError(name)
        return load(name, *arguments)

    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if absent == "warp" else object())
    monkeypatch.setattr(ctypes, "CDLL", no_driver)
    gpu.missing.cache_clear()
    ended = cli("register", bundled("box"), "1", "0", "--device", "cuda", "--method", "paper")
    gpu.missing.cache_clear()
    assert ended.status == 2
    assert len(ended.err.splitlines()) == 1
    assert f"--device cuda: {line}" in ended.err


@pytest.mark.parametrize("method", ["visibility", "icp"])
def test_methods_that_run_on_the_cpu_only_say_so(cli, method):
    ended = cli("register", bundled("box"), "1", "0", "--device", "cuda", "--method", method)
    assert ended.status == 2
    assert f"--method {method} runs on the CPU only" in ended.err


@with_warp
@pytest.mark.slow
def test_the_source_compiles_for_a_gpu(tmp_path):
    from modeler.kernels.gpu import paper as on_gpu

    gpu.warp().compile_aot_module(on_gpu, arch=90, module_dir=str(tmp_path), use_ptx=True)
    assert any("weigh" in path.read_text() for path in tmp_path.glob(f"*{on_gpu.__name__}*.ptx"))


@with_warp
def test_the_programme_of_measurements_runs_at_small_sizes(capsys, monkeypatch):
    arguments = ["bench-gpu", "--device", "warp-cpu", "--samples", "20000", "--runs", "1"]
    monkeypatch.setattr("sys.argv", arguments)
    with pytest.raises(SystemExit) as ended:
        runpy.run_module("studies.bench.gpu", run_name="__main__")
    assert not ended.value.code
    assert "20,000 samples of the general prior" in capsys.readouterr().out

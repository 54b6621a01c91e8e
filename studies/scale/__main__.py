"""Measure a batch.

    python -m studies scale builds FOLDER [--sequences 200] [--alone 8] [--rounds 5]
    python -m studies scale tasks FOLDER [--count 10000] [--executor dask:ADDRESS]

`builds` renders small sequences and builds them in rounds: some one by one, each by a `modeler build` with one thread,
then its share of all of them by a `modeler batch` with two workers. So a busy machine slows both alike. `tasks` has an
engine do nothing many times, and a batch find everything done.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import wait
from dataclasses import replace
from pathlib import Path
from statistics import median

from modeler.batch.engines import engine
from modeler.batch.jobs import NOTES, Job, fingerprint, write_note
from modeler.sequences.rendering import render
from modeler.sequences.rendering.recipe import load_recipe

RECIPE = {
    "name": "small",
    "object": {
        "kind": "compound",
        "parts": [{"shape": {"kind": "box", "size_m": [0.13, 0.075, 0.18]}, "rgb": [225, 190, 90]}],
    },
    "trajectory": {
        "kind": "tabletop",
        "frames": 6,
        "step_deg": 25,
        "step_sigma_deg": 3,
        "shift_m": 0.02,
        "start_deg": 20,
    },
    "view": {"width": 160, "height": 120, "focal_px": 144, "look_height_m": 0.06},
}
OPTIONS = ("--prior", "table")
ONE_THREAD = {name: "1" for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "RAYON_NUM_THREADS")}


def rendered(folder: Path, count: int) -> list[Path]:
    """Return sequences that differ in their noise and motion, rendered where they are not there yet."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "small.json").write_text(json.dumps(RECIPE))
    recipe = load_recipe(str(folder / "small.json"))
    found = [folder / "sequences" / f"s{number:05d}" for number in range(count)]
    for number, path in enumerate(found):
        if not path.exists():
            render(replace(recipe, seed=number), path, lambda sequence, *_: sequence)
    return found


def timed(commands: Sequence[Sequence[object]]) -> tuple[float, float]:
    """Return wall time and processor time in s of commands, one after the other."""
    began_s, before = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
    for command in commands:
        words = [sys.executable, "-m", "modeler", *map(str, command)]
        done = subprocess.run(words, env={**os.environ, **ONE_THREAD}, capture_output=True, text=True, check=False)
        assert done.returncode in (0, 3), done.stderr
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    used_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return time.monotonic() - began_s, used_s


def builds(folder: Path, count: int, *, alone: int, rounds: int) -> None:
    """Print what sequences cost one by one and in batches of two workers, medians over rounds and their range."""
    paths = rendered(folder, count)
    seed = int(time.time())  # nothing is done yet
    options = (*OPTIONS, "--workers", "2", "--seed", str(seed), "--overwrite")
    found: dict[str, list[float]] = {}
    for turn in range(rounds):
        share = paths[turn::rounds]
        singles = [("build", path, "--out", folder / "alone" / path.name, "--overwrite", *OPTIONS) for path in share]
        one_s, one_used_s = (total / alone for total in timed(singles[:alone]))
        each_s, used_s = (
            total / len(share) for total in timed([("batch", *share, "--out", folder / "batch", *options)])
        )
        figures = {
            "one by one, s a sequence": one_s,
            "one by one, s of a processor": one_used_s,
            "batch, s a sequence": each_s,
            "batch, s of a processor": used_s,
            "throughput of two workers over twice that of one": one_s / (2.0 * each_s),
            "processors busy with it while the batch ran": used_s / each_s,
            "processor time one by one over that in the batch": one_used_s / used_s,
        }
        for name, value in figures.items():
            found.setdefault(name, []).append(value)
        print(f"round {turn + 1} of {rounds}: {one_s:.2f} s, {each_s:.2f} s, load {os.getloadavg()[0]:.1f}", flush=True)
    for name, values in found.items():
        print(f"{name}: {median(values):.2f} ({min(values):.2f} to {max(values):.2f})")


def nothing(job: Job) -> str:
    """Do nothing."""
    return job.name


def tasks(folder: Path, count: int, executor: str) -> None:
    """Print what an engine takes for a task that does nothing, and a batch for a sequence that is done."""
    folder.mkdir(parents=True, exist_ok=True)
    told = folder / "done"
    jobs = [Job(f"s{k:06d}", str(told / "in" / f"s{k:06d}"), str(told / "out"), OPTIONS) for k in range(count)]
    with engine(executor, 2) as opened:
        opened.submit(nothing, jobs[0]).result()
        began_s = time.monotonic()
        futures = [opened.submit(nothing, job) for job in jobs]
        submitted_s = time.monotonic() - began_s
        wait(futures)
        ended_s = time.monotonic() - began_s
    print(f"{executor}: {1e3 * submitted_s / count:.3f} ms to submit, {1e3 * ended_s / count:.3f} ms a task")
    if executor != "processes":
        return
    (told / "out" / NOTES).mkdir(parents=True, exist_ok=True)
    for job in jobs:
        for number in range(20):
            path = Path(job.sequence) / "depth" / f"{number:06d}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
        job.run.mkdir(exist_ok=True)
        (job.run / "report.json").touch()
        note = {"sequence": job.sequence, "arguments": list(job.arguments), "status": 0, "record": {"frames": 20}}
        write_note(job.note, {**note, "glance": fingerprint(job, content=False)})
    (folder / "list.csv").write_text("\n".join(["sequence", *(job.sequence for job in jobs)]) + "\n")
    table = ("--manifest", folder / "list.csv", "--out", told / "out", *OPTIONS)
    wall_s, used_s = timed([("batch", *table)])
    print(f"all of {count} done: {1e3 * wall_s / count:.3f} ms, {1e3 * used_s / count:.3f} ms of a processor each")


def main() -> None:
    """Measure what is asked for."""
    parser = argparse.ArgumentParser(prog="python -m studies scale")
    parser.add_argument("what", choices=["builds", "tasks"])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--sequences", type=int, default=200)
    parser.add_argument("--alone", type=int, default=8, help="built one by one in each round")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--executor", default="processes")
    options = parser.parse_args()
    if options.what == "builds":
        builds(options.folder, options.sequences, alone=options.alone, rounds=options.rounds)
    else:
        tasks(options.folder, options.count, options.executor)


if __name__ == "__main__":
    main()

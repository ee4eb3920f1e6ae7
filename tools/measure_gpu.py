"""Measures on a GPU, against its marks, how fast crowds and robots step and learn, and what bounds them: each case in a
process of its own with a time limit, the most wanted first.

    python tools/measure_gpu.py --out OUT [--total 1500] [--only CASE ...] [--tiny]

OUT/marks.jsonl gets a line of JSON as each case ends, OUT/marks.md the table of all so far, OUT/CASE.log what the case
printed; where a case hangs, that is where each of its threads was. The same command goes on where it stopped: cases
that have a figure are left out, those that failed are tried again. tools/bench_gpu.sh compares the crowds' solvers.
"""

import argparse
import json
import os
import pathlib
import shlex
import subprocess
import sys
import time

ROOT = pathlib.Path(__file__).resolve().parent.parent
METHODS = "macid ipo copo macid-touch macid-tri mfpo"
SEEDS = 7
_TINY = {"worlds": 2, "many": 3, "seconds": 0.05, "steps": 100, "episodes": 2}
_FULL = {"worlds": 1024, "many": 4096, "seconds": 4, "steps": 20_000_000, "episodes": 100}
_DUMPED = 30  # time for a case to say where it hangs, and to end [s]


def crowd(level, worlds, kind, engine, *more):
    """The bench of a crowd; its figure is agent-steps/s."""
    words = ["-m", "macid.cli", "bench", "--engine", engine, "--levels", level, "--worlds", worlds, *more]
    return [*words, "--only", kind, "--seconds", "SECONDS", "--out", "FILE"], lambda found: found[0][kind]


def robot(limits, **case):
    """The bench of robots in MJX-Warp; its figure is control steps/s."""
    return ["-m", "bson.bench_warp", json.dumps(limits), json.dumps(case)], lambda found: found["steps_per_s"]


def profile(limits, **case):
    """The parts of robots' control step; its figure is the whole step's time [us]."""
    words = ["-m", "bson.bench_warp", json.dumps(limits), json.dumps({"profile": True, **case})]
    return words, lambda found: found["parts"]["control step"]


def native(sensor, worlds):
    """The native bench of robots."""
    words = ["-m", "bson.cli", "bench", "--pedestrians", "24", "--worlds", worlds, "--sensors", sensor]
    return [*words, "--seconds", "SECONDS", "--out", "FILE"], lambda found: found["rows"][0]["steps_per_s"]


def seconds(*words):
    """A command whose figure is the time that it takes [s]."""
    return list(words), None


def cases(args, size):
    """[(name, what, mark, limit [s], command and figure, environment)], the most wanted first."""
    many, worlds, tiny = str(size["many"]), str(size["worlds"]), args.tiny
    engine, limits, second = args.engine, json.loads(args.limits), {"seconds": size["seconds"]}
    gpu = ["--preset", "gpu", "--rollout", "2" if tiny else "25"]
    short = ["--rollout", "2"] if tiny else []
    here, wide = {"JAX_PLATFORMS": "cpu"}, {"worlds": size["many"], **second}
    narrow = {"worlds": size["worlds"], **second}
    seeds, longer = args.out / "seeds", args.out / "seeds-300M"
    budget = {"SEEDS": "2" if tiny else str(SEEDS), "METHODS": "ipo" if tiny else METHODS, "ENGINE": engine}
    budget |= {"MORE": "--worlds 1 --resume" if tiny else "--resume", "PYTHON": sys.executable}
    train = ["bash", "tools/train_gpu.sh"]
    tables = ["tools/reproduce_tables.py", "--policies", seeds / "policies", "--no-train", "--seeds", str(SEEDS)]
    learn = ["-m", "bson.cli", "train", "--algo", "ppo", "--engine", "warp", "--resume", "--steps", str(size["steps"])]
    learn += ["--worlds", "2", "--set", "horizon=20", "--set", "num_pedestrians=1"] if tiny else ["--worlds", many]
    found = [
        ("robot-lidar2d", "24 people, 720 beams", 250_000, 200, robot(limits, sensor="lidar2d", **wide), {}),
        ("robot-none", "24 people, no sensor", 400_000, 150, robot(limits, sensor="none", **wide), {}),
        ("robot-lidar3d", "24 people, 16 x 360", 50_000, 250, robot(limits, sensor="lidar3d", **narrow), {}),
        ("robot-ppo", "PPO learning, 720 beams", 100_000, 200, robot(limits, train=True, **wide), {}),
        ("robot-camera", "RGB + depth 160 x 120", 50_000, 200, robot(limits, sensor="camera", **narrow), {}),
        ("crowd-50", "crowd of 50 rolling out", 30e6, 150, crowd("2", many, "rollout", engine, *short), {}),
        ("crowd-200", "crowd of 200 rolling out", 15e6, 150, crowd("4", worlds, "rollout", engine, *short), {}),
        ("crowd-50-train", "training MAC-ID, 50 people", 10e6, 150, crowd("2", many, "training", engine, *gpu), {}),
        ("profile-none", "a step's parts, no sensor", None, 200, profile(limits, sensor="none", **wide), {}),
        ("profile-lidar3d", "a step's parts, 16 x 360", None, 250, profile(limits, sensor="lidar3d", **narrow), {}),
        ("profile-lidar2d", "a step's parts, 720 beams", None, 200, profile(limits, sensor="lidar2d", **wide), {}),
        ("profile-50", "a decision's parts", None, 150, crowd("2", many, "rollout", engine, *gpu, "--profile"), {}),
        ("seeds-30M", f"{SEEDS} seeds of all methods, 30M [s]", 900, 900, seconds(*train, seeds, "880"), budget),
        (
            "tables",
            f"Tables I and II of these {SEEDS} seeds [s]",
            None,
            1800,
            seconds(*tables, "--out", args.out / "tables"),
            here,
        ),
        ("learn", "PPO to its best policy, 20M steps [s]", None, 900, seconds(*learn, "--out", args.out / "runs"), {}),
    ]
    for agent in ("tac", "ppo", "goal"):
        scored = robot(limits, score=agent, episodes=size["episodes"])[0], lambda found: found["SNS"]
        found.append((f"score-{agent}", f"SNS of {agent} on `paper`", None, 300, scored, {}))
    for cores in ("", "-2"):
        pinned = ["taskset", "-c", "0,1"] if cores else []
        on = f"native, {cores[1:] or os.cpu_count()} cores"
        for name in ("none", "lidar2d", "lidar3d", "camera"):
            words, figure = native(name, "2" if tiny else "16")
            found.append((f"native-{name}{cores}", f"{name}, {on}", None, 200, ([*pinned, *words], figure), here))
        for level, kind in (("2", "rollout"), ("4", "rollout"), ("2", "training")):
            words, figure = crowd(level, "2" if tiny else "64", kind, "native", *short)
            found.append(
                (
                    f"native-crowd-{level}-{kind}{cores}",
                    f"Lv.{level} {kind}, {on}",
                    None,
                    200,
                    ([*pinned, *words], figure),
                    here,
                )
            )
    budget = {**budget, "STEPS": "300" if tiny else "300e6"}
    found.append(
        ("seeds-300M", f"{SEEDS} seeds of all methods, 300M [s]", None, 7200, seconds(*train, longer, "7180"), budget)
    )
    if tiny:
        found = [(*case[:5], {**case[5], "STEPS": "300"}) if case[0] == "seeds-30M" else case for case in found]
    return found


def measure(case, args, size):
    """Runs a case; returns its row."""
    name, what, mark, limit, (words, figure), more = case
    file, log = args.out / f"{name}.json", args.out / f"{name}.log"
    file.unlink(missing_ok=True)
    words = [{"SECONDS": str(size["seconds"]), "FILE": str(file)}.get(word, str(word)) for word in words]
    pinned = words[:3] if words[0] == "taskset" else []
    words = words[len(pinned) :]
    if words[0] != "bash":
        words = [sys.executable, "-X", "faulthandler", *words]
    environment = {"XLA_PYTHON_CLIENT_MEM_FRACTION": "0.55", "MUJOCO_GL": "egl", **os.environ, **more}
    if "seeds" in name:  # the script shares the memory among its trainings
        environment.pop("XLA_PYTHON_CLIENT_MEM_FRACTION")
    environment |= {
        "PYTHONUNBUFFERED": "1",
        "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]),
    }
    command = [*pinned, "timeout", "-s", "ABRT", "-k", str(_DUMPED), str(limit), *words]
    row = {"case": name, "what": what, "mark": mark, "command": shlex.join(words[1:])}
    begin = time.monotonic()
    with open(log, "w") as told:
        ran = subprocess.run(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, stderr=told, text=True)
        told.write(ran.stdout)
    row["seconds"] = round(time.monotonic() - begin, 1)
    if ran.returncode:
        return {**row, "failed": ran.returncode, "why": log.read_text(errors="replace")[-1500:]}
    if figure is None:
        return {**row, "value": row["seconds"]}
    found = json.loads(file.read_text() if file.exists() else ran.stdout.splitlines()[-1])
    return {**row, "value": figure(found), "row": found}


def table(rows):
    """The rows as a Markdown table, with whether each mark was met."""
    lines = ["| what | figure | mark | met |", "|---|---|---|---|"]
    for row in rows:
        figure = f"failed ({row['failed']})" if "failed" in row else f"{row['value']:,.0f}"
        mark, met = row["mark"], ""
        if mark is not None and "value" in row:
            met = "yes" if (row["value"] <= mark if "[s]" in row["what"] else row["value"] >= mark) else "no"
        lines.append(f"| {row['what']} | {figure} | {'' if mark is None else format(mark, ',.0f')} | {met} |")
    return "\n".join(lines) + "\n"


def main():
    """Measures the cases that have no figure yet."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("--out", type=pathlib.Path, required=True, help="folder")
    parser.add_argument("--total", type=float, default=float("inf"), help="no case begins after so many seconds")
    parser.add_argument("--only", nargs="+", metavar="CASE", help="cases by name (default: all)")
    parser.add_argument("--engine", default="warp", help="of crowds, as macid bench takes it")
    parser.add_argument("--limits", default="{}", help="of robots: fields of WarpConfig in JSON")
    parser.add_argument("--tiny", action="store_true", help="sizes that a CPU has done in minutes, to try this script")
    args = parser.parse_args()
    args.out = args.out.resolve()
    size, begin = _TINY if args.tiny else _FULL, time.monotonic()
    every = cases(args, size)
    if unknown := set(args.only or ()) - {case[0] for case in every}:
        parser.error(f"unknown case '{min(unknown)}'. Choose among {', '.join(case[0] for case in every)}")
    args.out.mkdir(parents=True, exist_ok=True)
    file, rows = args.out / "marks.jsonl", {}
    if file.exists():
        rows = {row["case"]: row for row in map(json.loads, file.read_text().splitlines())}
    for case in every:
        name = case[0]
        if (args.only and name not in args.only) or "value" in rows.get(name, {}):
            continue
        if time.monotonic() - begin > args.total:
            print(f"{name}: left for another time", flush=True)
            continue
        rows[name] = row = measure(case, args, size)
        with open(file, "a") as lines:
            lines.write(json.dumps(row) + "\n")
        print(f"{name}: {row.get('value', row.get('why', '')[-300:])} ({row['seconds']} s)", flush=True)
        (args.out / "marks.md").write_text(table([rows[case[0]] for case in every if case[0] in rows]))
    return int(any("failed" in row for row in rows.values()))


if __name__ == "__main__":
    sys.exit(main())

"""Seconds of a train step while devices and environments grow together: devices of one process, and processes.

    python benchmarks/weak_scaling.py
    python benchmarks/weak_scaling.py --task AntRun --envs 16 --groups 1x1 1x2 2x1

``2x4`` are two processes on this machine with four devices each, which speak over loopback. More devices than cores
show what dividing costs, not what it gains.
"""

import argparse
import csv
import os
import socket
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path


def free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def seconds(task: str, processes: int, devices: int, envs: int, iterations: int) -> list[float]:
    """Seconds of each iteration but the first; ``envs`` environments on each device."""
    total = processes * devices
    with tempfile.TemporaryDirectory() as folder:
        horizon = 8
        command = [
            sys.executable, "-m", "rewax", "train", f"--env={task}", "--scale=small", f"--devices={total}",
            f"--sapo.num-envs={total * envs}", f"--sapo.horizon={horizon}", f"--run-dir={folder}/run",
            f"--steps={total * envs * horizon * iterations}", "--train.num-eval-episodes=2", "--train.no-plots",
            "--train.no-baselines", "--train.eval-every=0",
        ]  # fmt: skip
        where = {"JAX_COORDINATOR_ADDRESS": f"127.0.0.1:{free_port()}", "JAX_NUM_PROCESSES": str(processes)}
        if processes > 1:
            command.append("--distributed")
        started = [
            subprocess.Popen(command, env={**os.environ, **where, "JAX_PROCESS_ID": str(i)}, stdout=subprocess.DEVNULL)
            for i in range(processes)
        ]
        codes = [process.wait() for process in started]
        if any(codes):
            raise SystemExit(f"{' '.join(command)} failed")
        with (Path(folder) / "run" / "timing.csv").open() as file:
            return [float(row["seconds"]) for row in csv.DictReader(file)][1:]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="RollingFlat")
    parser.add_argument("--envs", type=int, default=16, help="on each device")
    parser.add_argument("--groups", nargs="+", default=["1x1", "1x2", "2x1", "1x8", "2x4"])
    parser.add_argument("--iterations", type=int, default=21)
    args = parser.parse_args()
    print(f"{args.task} small, {os.cpu_count()} cores, {args.envs} environments on each device")
    print("| processes | devices of each | environments | s, best | s, median | steps/s, best |")
    print("|---|---|---|---|---|---|")
    for group in args.groups:
        processes, devices = map(int, group.split("x"))
        times = seconds(args.task, processes, devices, args.envs, args.iterations)
        envs = processes * devices * args.envs
        best, median = min(times), statistics.median(times)
        print(f"| {processes} | {devices} | {envs} | {best:.3f} | {median:.3f} | {8 * envs / best:.0f} |", flush=True)


if __name__ == "__main__":
    main()

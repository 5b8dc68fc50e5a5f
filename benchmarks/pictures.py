"""How long pictures take, how large a page is, and how fast Chromium plays it without a graphics card.

python benchmarks/pictures.py                       # RollingFlat at scale paper, 301 frames
pip install playwright && python benchmarks/pictures.py --browser /usr/bin/chromium
"""

import argparse
import os
import tempfile
import time
from pathlib import Path

import jax

from rewax.envs import make
from rewax.training import record, uniform_policy
from rewax.viz.player import write_player
from rewax.viz.render import pictures
from rewax.viz.video import SIZE, write_video

_WINDOW = {"width": 1200, "height": 700}


def frames_per_second(page: Path, browser: str, repeats: int) -> list[float]:
    """Pictures drawn each second of a page that plays from its beginning, in a window of 1200 x 700 pixels."""
    from playwright.sync_api import sync_playwright

    found = []
    with sync_playwright() as play:
        # SwiftShader: OpenGL on the processor, the slowest that a reader's browser may have.
        flags = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
        window = play.chromium.launch(executable_path=browser, args=flags).new_page(viewport=_WINDOW)
        window.goto(f"file://{page.resolve()}", timeout=300_000)
        window.wait_for_selector('[data-state="ready"]', timeout=300_000)
        for _ in range(repeats):
            drawn, seconds = window.evaluate(
                "async () => { const p = window.player; p.seek(0); p.toggle(true);"
                " await new Promise(r => setTimeout(r, 500));"  # it adapts to the machine in its first pictures
                " const [n, t] = [p.drawn, performance.now()];"
                " await new Promise(r => setTimeout(r, Math.min(5000, 1000 * (p.duration - p.time) / p.speed - 500)));"
                " return [p.drawn - n, (performance.now() - t) / 1000]; }"
            )
            found.append(drawn / seconds)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="RollingFlat")
    parser.add_argument("--scale", default="paper")
    parser.add_argument("--frames", type=int, default=301)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--browser", help="path of Chromium")
    args = parser.parse_args()
    env = make(args.task, scale=args.scale)
    recording = record(env, uniform_policy(env), None, jax.random.key(0), max_frames=args.frames)
    print(f"{args.task}, {args.scale}: {recording.num_frames} frames, {os.cpu_count()} cores")
    with tempfile.TemporaryDirectory() as folder:
        video, page = Path(folder) / "episode.mp4", Path(folder) / "episode.html"
        times = []
        for _ in range(args.repeats):
            start = time.perf_counter()
            write_video(pictures(recording, renderer="software"), video, rate=30.0, size=SIZE)
            times.append(time.perf_counter() - start)
        print("video with the software renderer: " + ", ".join(f"{t:.1f}" for t in times) + " s")
        start = time.perf_counter()
        write_player([recording], page)
        print(f"page: {page.stat().st_size / 1e6:.2f} MB, written in {time.perf_counter() - start:.1f} s")
        if args.browser:
            rates = frames_per_second(page, args.browser, args.repeats)
            print("pictures a second: " + ", ".join(f"{r:.0f}" for r in rates))


if __name__ == "__main__":
    main()

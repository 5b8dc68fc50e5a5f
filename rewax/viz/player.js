"use strict";
// The page: reads the recordings and plays them on one clock with one camera.

// The frame at a time, the next one, and how far it is between them.
function momentOf(run, time) {
  const { times } = run, last = times.length - 1;
  let low = 0, high = last;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (times[middle] <= time) low = middle; else high = middle;
  }
  const part = last ? Math.min(Math.max((time - times[low]) / (times[high] - times[low]), 0), 1) : 0;
  return { frame: low, next: high, part };
}

// What the ends of a scale stand for in several runs together.
function union(ranges) {
  return [Math.min(...ranges.map(([low]) => low)), Math.max(...ranges.map(([, high]) => high))];
}

class Player {
  constructor(data) {
    Object.assign(this, { runs: data.runs, status: data.status, speed: data.speed, time: 0, playing: false, dirty: true, drawn: 0 });
    const metrics = new Set(this.runs.flatMap((run) => Object.keys(run.metrics)));
    this.plots = ["reward", "return", ...(this.runs.some((run) => run.num_actions) ? ["actions"] : []), ...metrics];
    this.show = {
      by: "material",                              // what colours particles
      plot: "reward",                              // what the curves are
      surface: true,                               // of particles, instead of balls
      follow: this.runs.some((run) => run.follow), // the camera goes with what moves
      camera: titlesOf(this.runs)[0] || "",        // the title of the camera's picture in the corner; "": none
      large: false,                                // that picture
      one: this.similar(),                         // all runs have the same scales: metres, colours, curves
      sharpness: 1, detail: 1,                     // below 1: fewer pixels, coarser surfaces
    };
    this.slow = 0;
    this.orbit = new Orbit(this.runs[0], () => { this.dirty = true; });
    this.recorder = new Recorder(this);
    this.views = this.runs.map((run) => this.addView(run));
    addTabs(this);
    addControls(this, data);
    this.choose(this.runs.length > 1 && window.innerWidth < 700 ? 0 : -1);
    const resized = new ResizeObserver(() => this.draw());  // before the browser paints the new layout
    for (const { scene } of this.views) resized.observe(scene.canvas);
    let before = null;
    const tick = (now) => {
      requestAnimationFrame(tick);  // first, so that an error does not stop the page
      this.advance(before === null ? 0 : (now - before) / 1000);
      before = now;
    };
    requestAnimationFrame(tick);
  }

  // Whether the runs are of similar size, so that one scale suits all.
  similar() {
    const sizes = this.runs.map((run) => run.still.distance);
    return Math.max(...sizes) < 4 * Math.min(...sizes);
  }

  addView(run) {
    const section = document.importNode(byId("view").content, true).firstElementChild;
    byId("runs").append(section);
    const header = section.querySelector("header"), [scene, bar, seen, curves] = section.querySelectorAll("canvas");
    header.querySelector("b").textContent = run.name;
    this.orbit.listen(scene);
    const seek = (event) => {
      if (event.buttons) this.seek(this.duration * (event.offsetX - 8) / Math.max(curves.clientWidth - 16, 1));
    };
    curves.addEventListener("pointerdown", seek);
    curves.addEventListener("pointermove", seek);
    const resize = () => { this.show.large = !this.show.large; this.dirty = true; };
    return {
      run, section, header, bar, scene: new Scene(scene, run), seen: new SeenPane(seen, run, resize), curves: new Curves(curves, run),
    };
  }

  visible() {
    return this.views.filter(({ section }) => !section.hidden);
  }

  // Seconds until the longest of the visible runs ends.
  get duration() {
    return Math.max(...this.visible().map(({ run }) => run.times[run.times.length - 1]));
  }

  // Show one run, or all of them (-1).
  choose(index) {
    const narrow = window.innerWidth < window.innerHeight, count = index < 0 ? this.runs.length : 1;
    const columns = narrow ? 1 : count <= 3 ? count : Math.ceil(Math.sqrt(count));
    this.views.forEach(({ section }, i) => { section.hidden = index >= 0 && i !== index; });
    byId("runs").style.gridTemplateColumns = `repeat(${columns}, minmax(0, 1fr))`;
    [...byId("tabs").children].forEach((tab, i) => tab.setAttribute("aria-pressed", String(i - 1 === index)));
    this.seek(this.time);
  }

  toggle(playing = !this.playing) {
    if (playing && this.time >= this.duration) this.time = 0;
    this.playing = playing;
    byId("play").textContent = playing ? "Pause" : "Play";
    this.dirty = true;
  }

  seek(time) {
    this.time = Math.min(Math.max(time, 0), this.duration);
    this.dirty = true;
  }

  // Record a video from here, or from the beginning at the end; the end of the episode or a second click ends it.
  record() {
    const { recorder } = this;
    if (recorder.running) recorder.stop();
    else {
      this.toggle(true);
      recorder.start();
    }
    byId("video").setAttribute("aria-pressed", String(recorder.running));
  }

  advance(seconds) {
    if (this.playing) {
      if (!this.recorder.running) this.adapt(seconds);
      this.seek(this.time + this.speed * Math.min(seconds, 0.1));
      if (this.time >= this.duration) this.toggle(false);
    }
    if (!this.dirty) return;
    this.dirty = false;
    this.draw();
    if (!this.recorder.running) return;
    compose(this.recorder.canvas, this);
    if (!this.playing) this.record();
  }

  // While a slow machine plays: coarser surfaces if they take most of the time, otherwise fewer pixels.
  adapt(seconds) {
    const { show } = this;
    this.slow = 0.8 * this.slow + 0.2 * seconds;
    if (this.slow <= 1 / 32) return;
    const surfaces = this.visible().reduce((sum, { scene }) => sum + (show.surface && scene.cloud && scene.cloud.seconds || 0), 0);
    const name = surfaces > 0.4 * this.slow && show.detail > 0.6 ? "detail" : "sharpness";
    if (show[name] > 0.55) [show[name], this.slow] = [0.85 * show[name], 1 / 60];
  }

  draw() {
    const { time, duration, show } = this, runs = this.visible().map(({ run }) => run);
    byId("timeline").value = Math.round(1000 * time / Math.max(duration, 1e-9));
    byId("clock").textContent = `${time.toFixed(2)} of ${duration.toFixed(2)} s`;
    const full = this.playing && !this.recorder.running ? {} : { sharpness: 1, detail: 1 };
    const common = show.one ? this.commonScale(runs) : {};
    for (const { run, header, scene, bar, seen, curves } of this.visible()) {
      const own = { ...show, ...full, ranges: run.ranges, ...common }, moment = momentOf(run, time);
      scene.draw(moment, this.orbit, own);
      seen.draw(moment, own);
      bar.hidden = !own.ranges[show.by] || !run.ranges[show.by];
      if (!bar.hidden) drawColorBar(bar, run.palette, show.by, own.ranges[show.by]);
      curves.draw(time, duration, own);
      header.querySelector("span").textContent = this.state(run);
    }
    this.drawn += 1;
  }

  // One distance of the camera, one grid on the floor, and one range of colours and of curves for all visible runs.
  commonScale(runs) {
    const framings = runs.map((run) => (this.show.follow ? run.followed : run.still));
    const farthest = framings.reduce((a, b) => (a.distance > b.distance ? a : b));
    const names = new Set(runs.flatMap((run) => Object.keys(run.ranges)));
    const ranges = [...names].map((name) => [name, union(runs.map((run) => run.ranges[name]).filter(Boolean))]);
    return {
      distance: farthest.distance, spacing: farthest.spacing,
      ranges: dictionary(ranges), extent: extentOf(runs, this.show.plot),
    };
  }

  state(run) {
    const step = stepAt(run, this.time), bits = step ? run.status[step - 1] : 0;
    const status = this.status.filter(([, bit]) => bits & bit).map(([name]) => name).join(" ") || "OK";
    const reward = step ? run.rewards[step - 1] : 0;
    return `step ${step} · reward ${reward.toFixed(3)} · return ${run.totals[step].toFixed(2)} · ${status}`;
  }
}

// What the address asks for after #: t=0.5 [s, paused], color=speed, plot=actions, view=top, run=1 (the first), balls,
// camera=depth (the start of a title, or none), large.
function follow(player, wanted) {
  const set = (id, value) => { byId(id).value = value; byId(id).dispatchEvent(new Event("change")); };
  if (wanted.has("color")) set("color", wanted.get("color"));
  if (wanted.has("plot")) set("plot", wanted.get("plot"));
  if (Object.hasOwn(VIEWS, wanted.get("view"))) player.orbit.view(wanted.get("view"));
  if (player.runs[Number(wanted.get("run")) - 1]) player.choose(Number(wanted.get("run")) - 1);
  if (wanted.has("balls")) byId("surface").click();
  const title = titlesOf(player.runs).find((known) => known.startsWith(wanted.get("camera")));
  if (wanted.has("camera")) set("camera", title || "");
  if (wanted.has("large")) player.show.large = true;
  if (wanted.has("t")) player.seek(Number(wanted.get("t"))); else player.toggle(true);
}

async function open() {
  const player = new Player(await read(byId("data").textContent));
  window.player = player;
  follow(player, new URLSearchParams(location.hash.slice(1)));
  player.draw();
  document.documentElement.dataset.state = "ready";
}

open().catch((error) => {
  console.error(error);
  document.documentElement.dataset.state = "failed";
  const sentence = Object.assign(document.createElement("p"), { className: "error", textContent: `Cannot play this: ${error.message}.` });
  byId("runs").replaceChildren(sentence);
});

"use strict";
// The page: reads the recordings, plays them on one clock with one camera, and draws the curves below each scene.

const STATUS_COLORS = ["#c0392b", "#e67e22", "#8e44ad", "#16a085", "#d35400", "#2980b9", "#7f8c8d"];
const SPEEDS = [0.05, 0.1, 0.125, 0.25, 0.5, 1, 2, 4];
const TYPES = { f4: Float32Array, u1: Uint8Array, u2: Uint16Array, u4: Uint32Array };

// An array from its text: base64 of deflated numbers. Those with frames hold, after the first frame, differences;
// numbers of two bytes hold all low bytes before all high ones.
async function decode({ z, type, frames }) {
  const packed = Uint8Array.from(atob(z), (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
  if (!frames) return new TYPES[type](bytes.buffer);
  const wide = type === "u2", count = wide ? bytes.length / 2 : bytes.length;
  const found = wide ? new Uint16Array(count) : new Uint8Array(count);
  const each = count / frames;
  for (let i = 0; i < count; i++) {
    const difference = wide ? bytes[i] | (bytes[count + i] << 8) : bytes[i];
    found[i] = difference + (i < each ? 0 : found[i - each]);  // wraps around, as it was written
  }
  return found;
}

async function decodeAll(value) {
  if (Array.isArray(value)) return Promise.all(value.map(decodeAll));
  if (value === null || typeof value !== "object") return value;
  if ("z" in value) return decode(value);
  const entries = await Promise.all(Object.entries(value).map(async ([key, inner]) => [key, await decodeAll(inner)]));
  return Object.fromEntries(entries);
}

class Curves {
  constructor(canvas, run) {
    this.canvas = canvas;
    this.run = run;
    this.low = Math.min(...run.rewards, 0);
    this.high = Math.max(...run.rewards, this.low + 1e-9);
  }

  draw(time, duration) {
    const { canvas } = this, ratio = window.devicePixelRatio || 1;
    const width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
    if (!this.still || canvas.width !== width || canvas.height !== height) {
      [canvas.width, canvas.height] = [width, height];
      this.still = Object.assign(document.createElement("canvas"), { width, height });
      this.drawStill(this.still.getContext("2d"), width / ratio, height / ratio, ratio, duration);
    }
    const pen = canvas.getContext("2d");
    pen.clearRect(0, 0, width, height);
    pen.drawImage(this.still, 0, 0);
    pen.fillStyle = "#c0392b";
    pen.fillRect(ratio * this.x(time, width / ratio, duration), 16 * ratio, 1.4 * ratio, height - 20 * ratio);
  }

  x(time, width, duration) {
    return 8 + (width - 16) * time / Math.max(duration, 1e-9);
  }

  // Everything but the cursor.
  drawStill(pen, width, height, ratio, duration) {
    const { run } = this, strip = 10;
    pen.scale(ratio, ratio);
    const x = (t) => this.x(t, width, duration);
    const y = (r) => 18 + (height - strip - 28) * (1 - (r - this.low) / (this.high - this.low));
    pen.strokeStyle = "#e3e8ee";
    pen.strokeRect(x(0), y(0), x(duration) - x(0), 0);
    pen.strokeStyle = "#2b6cb0";
    pen.lineWidth = 1.4;
    pen.beginPath();
    run.rewards.forEach((reward, i) => pen.lineTo(x((i + 1) * run.dt), y(reward)));
    pen.stroke();
    const each = Math.max(1, x(run.dt) - x(0));
    run.status.forEach((bits, i) => {
      pen.fillStyle = bits ? STATUS_COLORS[Math.log2(bits & -bits) % STATUS_COLORS.length] : "#dfe9e2";
      pen.fillRect(x(i * run.dt), height - strip - 3, each + 0.5, strip - 3);
    });
    pen.fillStyle = "#566573";
    pen.font = "11px system-ui, sans-serif";
    pen.fillText(`reward, ${this.low.toPrecision(3)} to ${this.high.toPrecision(3)}; status below`, 8, 12);
  }
}

class Player {
  constructor(data) {
    Object.assign(this, { runs: data.runs, time: 0, playing: false, by: "material", dirty: true, drawn: 0, sharpness: 1, slow: 0 });
    this.status = data.status;
    this.duration = Math.max(...this.runs.map((run) => run.times[run.times.length - 1]));
    this.speed = data.speed;
    this.views = this.runs.map((run) => this.addView(run));
    const across = window.innerWidth > window.innerHeight ? Math.ceil(Math.sqrt(this.runs.length)) : 1;
    const columns = this.runs.length <= 3 && window.innerWidth > window.innerHeight ? this.runs.length : across;
    document.getElementById("runs").style.gridTemplateColumns = `repeat(${columns}, minmax(0, 1fr))`;
    this.home();
    this.addControls(data);
    const resized = new ResizeObserver(() => this.draw());  // before the browser paints the new layout
    for (const { scene } of this.views) resized.observe(scene.canvas);
    let before = null;
    const tick = (now) => {
      this.advance(before === null ? 0 : (now - before) / 1000);
      before = now;
      requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
  }

  addView(run) {
    const section = document.createElement("section");
    section.innerHTML = '<header><b></b><span></span></header><div class="scene"><canvas></canvas></div>' +
      '<div class="curves"><canvas></canvas></div>';
    section.querySelector("b").textContent = run.name;
    document.getElementById("runs").append(section);
    const [scene, curves] = section.querySelectorAll("canvas");
    this.addOrbit(scene);
    const seek = (event) => {
      if (event.buttons) this.seek(this.duration * (event.offsetX - 8) / Math.max(curves.clientWidth - 16, 1));
    };
    curves.addEventListener("pointerdown", seek);
    curves.addEventListener("pointermove", seek);
    return { run, label: section.querySelector("span"), scene: new Scene(scene, run), curves: new Curves(curves, run) };
  }

  // One finger or the mouse turns; two fingers, the right button or shift move; the wheel and two fingers zoom.
  addOrbit(canvas) {
    const held = new Map();
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      held.set(event.pointerId, [event.clientX, event.clientY]);
    });
    const release = (event) => held.delete(event.pointerId);
    canvas.addEventListener("pointerup", release);
    canvas.addEventListener("pointercancel", release);
    canvas.addEventListener("pointermove", (event) => {
      const old = held.get(event.pointerId);
      if (!old) return;
      const [dx, dy] = [event.clientX - old[0], event.clientY - old[1]];
      const apart = () => { const [a, b] = [...held.values()]; return Math.hypot(a[0] - b[0], a[1] - b[1]); };
      const before = held.size > 1 ? apart() : 0;
      held.set(event.pointerId, [event.clientX, event.clientY]);
      const { camera } = this, height = canvas.clientHeight;
      if (held.size > 1) camera.zoom *= apart() / Math.max(before, 1);
      if (held.size > 1 || event.buttons === 2 || event.shiftKey) {
        camera.shift = [camera.shift[0] + dx / height / held.size, camera.shift[1] + dy / height / held.size];
      } else {
        camera.azimuth -= 2.5 * dx / height;
        camera.elevation = Math.min(1.55, Math.max(0.02, camera.elevation + 2.5 * dy / height));
      }
      this.dirty = true;
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.camera.zoom *= Math.exp(-0.001 * event.deltaY);
      this.dirty = true;
    }, { passive: false });
  }

  addControls(data) {
    const get = (id) => document.getElementById(id);
    this.timeline = get("timeline");
    this.clock = get("clock");
    this.button = get("play");
    this.timeline.addEventListener("input", () => this.seek(this.duration * this.timeline.value / 1000));
    this.button.addEventListener("click", () => this.toggle());
    get("home").addEventListener("click", () => this.home());
    const names = [...new Set([...SPEEDS, data.speed])].sort((a, b) => a - b);
    get("speed").innerHTML = names.map((s) => `<option value="${s}">${Number(s.toPrecision(2))}×</option>`).join("");
    get("speed").value = data.speed;
    get("speed").addEventListener("change", (event) => { this.speed = Number(event.target.value); });
    get("color").innerHTML = data.colors.map((name) => `<option>${name}</option>`).join("");
    get("colors").hidden = !data.colors.length;
    get("color").addEventListener("change", (event) => { this.by = event.target.value; this.dirty = true; });
    window.addEventListener("keydown", (event) => {
      if (["INPUT", "SELECT", "BUTTON"].includes(event.target.tagName) && event.key === " ") return;
      const step = this.runs[0].dt;
      const keys = {
        " ": () => this.toggle(), h: () => this.home(),
        ArrowRight: () => this.seek(this.time + step), ArrowLeft: () => this.seek(this.time - step),
      };
      if (!keys[event.key] || event.target.tagName === "SELECT") return;
      event.preventDefault();
      keys[event.key]();
    });
  }

  home() {
    const { azimuth, elevation } = this.runs[0];
    this.camera = { azimuth, elevation, zoom: 1, shift: [0, 0] };
    this.dirty = true;
  }

  toggle(playing = !this.playing) {
    if (playing && this.time >= this.duration) this.time = 0;
    this.playing = playing;
    this.button.textContent = playing ? "Pause" : "Play";
    this.dirty = true;
  }

  seek(time) {
    this.time = Math.min(Math.max(time, 0), this.duration);
    this.dirty = true;
  }

  advance(seconds) {
    if (this.playing) {
      this.adapt(seconds);
      this.seek(this.time + this.speed * Math.min(seconds, 0.1));
      if (this.time >= this.duration) this.toggle(false);
    }
    if (!this.dirty) return;
    this.dirty = false;
    this.draw();
  }

  // Fewer pixels while a slow machine plays; what rests is sharp.
  adapt(seconds) {
    this.slow = 0.8 * this.slow + 0.2 * seconds;
    if (this.slow > 1 / 32 && this.sharpness > 0.55) [this.sharpness, this.slow] = [0.85 * this.sharpness, 1 / 60];
  }

  draw() {
    this.timeline.value = Math.round(1000 * this.time / Math.max(this.duration, 1e-9));
    this.clock.textContent = `${this.time.toFixed(2)} of ${this.duration.toFixed(2)} s`;
    for (const { run, label, scene, curves } of this.views) {
      scene.draw(momentOf(run, this.time), this.camera, this.by, this.playing ? this.sharpness : 1);
      curves.draw(this.time, this.duration);
      const step = Math.min(Math.floor(this.time / run.dt + 1e-6), run.rewards.length);
      const bits = step ? run.status[step - 1] : 0;
      const set = this.status.filter(([, bit]) => bits & bit).map(([name]) => name).join(" ") || "OK";
      const reward = step ? run.rewards[step - 1] : 0;
      label.textContent = `step ${step} · reward ${reward.toFixed(3)} · return ${run.totals[step].toFixed(2)} · ${set}`;
    }
    this.drawn += 1;
  }
}

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

// #t=0.5 opens the page at that time [s], paused.
async function open() {
  const data = await decodeAll(JSON.parse(document.getElementById("data").textContent));
  for (const run of data.runs) {
    run.totals = run.rewards.reduce((sums, reward) => [...sums, sums[sums.length - 1] + reward], [0]);
  }
  const player = new Player(data);
  window.player = player;
  const start = new URLSearchParams(location.hash.slice(1)).get("t");
  if (start !== null) player.seek(Number(start));
  else player.toggle(true);
  player.draw();
  document.documentElement.dataset.state = "ready";
}

open().catch((error) => {
  console.error(error);
  document.documentElement.dataset.state = "failed";
  const said = Object.assign(document.createElement("p"), { className: "error", textContent: `Cannot play this: ${error.message}.` });
  document.getElementById("runs").replaceChildren(said);
});

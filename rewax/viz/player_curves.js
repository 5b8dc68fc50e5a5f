"use strict";
// What is drawn in two dimensions: a run's numbers over time, and the bar that explains colours.

const STATUS_COLORS = ["#c0392b", "#e67e22", "#8e44ad", "#16a085", "#d35400", "#2980b9", "#7f8c8d"];
const LINE_COLORS = ["#2b6cb0", "#c05621", "#2f855a", "#805ad5", "#b7791f", "#2c7a7b", "#b83280", "#4a5568"];
const short = (x) => String(Number(x.toPrecision(3)));

// Fit a canvas to its place; returns a pen in CSS pixels, or null where the canvas is hidden.
function penOf(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
  if (!width || !height) return null;
  if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, canvas.clientWidth, canvas.clientHeight);
  return pen;
}

// The lines that a name stands for, arrays of a number for each step.
function linesOf(run, name) {
  if (name === "actions") {
    return Array.from({ length: run.num_actions }, (_, a) => run.actions.filter((_, i) => i % run.num_actions === a));
  }
  return [name === "reward" ? run.rewards : name === "return" ? run.totals.slice(1) : run.metrics[name] || []];
}

// The lowest and the highest number of some runs' lines, apart from those that are not finite.
function extentOf(runs, name) {
  let low = Infinity, high = -Infinity;
  for (const line of runs.flatMap((run) => linesOf(run, name))) {
    for (const x of line) if (Number.isFinite(x)) [low, high] = [Math.min(low, x), Math.max(high, x)];
  }
  if (low > high) [low, high] = [0, 1];
  return [Math.min(low, name === "reward" ? 0 : low), Math.max(high, low + Math.max(1e-9, 1e-6 * Math.abs(low)))];
}

class Curves {
  constructor(canvas, run) {
    Object.assign(this, { canvas, run, key: null });
  }

  x(time, width, duration) {
    return 8 + (width - 16) * time / Math.max(duration, 1e-9);
  }

  draw(time, duration, show) {
    const { canvas } = this, width = canvas.clientWidth, height = canvas.clientHeight, pen = penOf(canvas);
    if (!pen) return;
    const extent = show.extent || extentOf([this.run], show.plot);
    const key = [canvas.width, canvas.height, duration, show.plot, extent].join();
    if (key !== this.key) {  // everything but the cursor is drawn once
      this.still = Object.assign(document.createElement("canvas"), { width: canvas.width, height: canvas.height });
      const still = this.still.getContext("2d");
      still.scale(canvas.width / width, canvas.height / height);
      this.drawStill(still, width, height, duration, show.plot, extent);
      this.key = key;
    }
    pen.drawImage(this.still, 0, 0, width, height);
    pen.fillStyle = "#c0392b";
    pen.fillRect(this.x(time, width, duration), 18, 1.4, height - 20);
    this.label(pen, time, show.plot, extent);
  }

  drawStill(pen, width, height, duration, name, [low, high]) {
    const { run } = this, strip = 10, x = (t) => this.x(t, width, duration);
    const y = (value) => 20 + (height - strip - 30) * (1 - (value - low) / (high - low));
    pen.fillStyle = "#e3e8ee";
    pen.fillRect(x(0), y(Math.min(Math.max(0, low), high)), x(duration) - x(0), 1);
    linesOf(run, name).forEach((line, i) => {
      pen.strokeStyle = LINE_COLORS[i % LINE_COLORS.length];
      pen.lineWidth = 1.4;
      pen.beginPath();
      line.forEach((value, step) => { if (Number.isFinite(value)) pen.lineTo(x((step + 1) * run.dt), y(value)); });
      pen.stroke();
    });
    const each = Math.max(1, x(run.dt) - x(0));
    run.status.forEach((bits, i) => {
      pen.fillStyle = bits ? STATUS_COLORS[Math.log2(bits & -bits) % STATUS_COLORS.length] : "#dfe9e2";
      pen.fillRect(x(i * run.dt), height - strip - 3, each + 0.5, strip - 3);
    });
  }

  // The name, the ends of the axis, and the numbers of the step at the cursor.
  label(pen, time, name, [low, high]) {
    const { run } = this, step = stepAt(run, time), lines = linesOf(run, name);
    pen.font = "11px system-ui, sans-serif";
    pen.fillStyle = "#566573";
    const text = lines.some((line) => line.length) ? `${name}, ${short(low)} to ${short(high)}:` : `this run has no ${name}`;
    pen.fillText(text, 8, 12);
    let x = 14 + pen.measureText(text).width;
    for (const [i, line] of lines.entries()) {
      if (!step || line[step - 1] === undefined) continue;
      pen.fillStyle = LINE_COLORS[i % LINE_COLORS.length];
      pen.fillText(short(line[step - 1]), x, 12);
      x += 10 + pen.measureText(short(line[step - 1])).width;
    }
  }
}

// Control steps that are over at a time.
function stepAt(run, time) {
  return Math.min(Math.floor(time / run.dt + 1e-6), run.rewards.length);
}

// What the colours of a value stand for.
function drawColorBar(canvas, palette, name, [low, high]) {
  const pen = penOf(canvas), width = canvas.clientWidth;
  if (!pen) return;
  pen.fillStyle = "rgba(255, 255, 255, 0.82)";
  pen.fillRect(0, 0, width, canvas.clientHeight);
  const bar = pen.createLinearGradient(8, 0, width - 8, 0);
  palette.forEach((color, i) => bar.addColorStop(i / (palette.length - 1), `rgb(${color.map((x) => Math.round(255 * x))})`));
  pen.fillStyle = bar;
  pen.fillRect(8, 18, width - 16, 8);
  pen.fillStyle = "#1d2733";
  pen.font = "11px system-ui, sans-serif";
  pen.textAlign = "left";
  pen.fillText(short(low), 8, 38);
  pen.textAlign = "center";
  pen.fillText(name === "height" ? "height [m]" : name, width / 2, 13);
  pen.textAlign = "right";
  pen.fillText(short(high), width - 8, 38);
  pen.textAlign = "left";
}

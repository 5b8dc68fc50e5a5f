"use strict";
// Pictures (PNG) and videos of what the page shows: scenes, names, colour bars and curves, without the buttons.

const VIDEO_TYPES = ["video/webm;codecs=vp9", "video/webm", "video/mp4"];

// Draw the visible views of a player into a canvas. Call it right after the scenes were drawn.
function compose(canvas, player) {
  const frame = document.getElementById("runs").getBoundingClientRect(), ratio = window.devicePixelRatio || 1;
  const size = [frame.width, frame.height].map((x) => 2 * Math.round(0.5 * ratio * x));  // videos need even numbers
  if (canvas.width !== size[0] || canvas.height !== size[1]) [canvas.width, canvas.height] = size;
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, -frame.left * ratio, -frame.top * ratio);
  pen.fillStyle = "#fff";
  pen.fillRect(frame.left, frame.top, frame.width, frame.height);
  pen.textBaseline = "middle";
  for (const { section, header } of player.visible()) {
    for (const part of section.querySelectorAll("canvas")) {
      const { left, top, width, height } = part.getBoundingClientRect();
      if (width && part.width) pen.drawImage(part, left, top, width, height);
    }
    const { left, top, right, height } = header.getBoundingClientRect(), [name, state] = header.children;
    pen.fillStyle = "#1d2733";
    pen.font = "600 14px system-ui, sans-serif";
    pen.fillText(name.textContent, left + 12, top + height / 2, (right - left) / 2);
    pen.font = "12px system-ui, sans-serif";
    pen.textAlign = "right";
    pen.fillText(state.textContent, right - 12, top + height / 2, (right - left) / 2 - 24);
    pen.textAlign = "left";
  }
  return canvas;
}

function save(blob, name) {
  const link = Object.assign(document.createElement("a"), { download: name }), address = URL.createObjectURL(blob);
  link.setAttribute("href", address);
  link.click();
  setTimeout(() => URL.revokeObjectURL(address), 10_000);
}

const fileName = (player, ending) => `${document.title.replace(/[^\w.-]+/g, "_")}_${player.time.toFixed(2)}s.${ending}`;

function savePicture(player) {
  player.draw();
  return new Promise((resolve) => {
    compose(document.createElement("canvas"), player).toBlob((blob) => {
      save(blob, fileName(player, "png"));
      resolve(blob);
    });
  });
}

// Records what is drawn from `start` to `stop`.
class Recorder {
  constructor(player) {
    this.player = player;
    this.canvas = document.createElement("canvas");
    this.type = window.MediaRecorder && VIDEO_TYPES.find((type) => MediaRecorder.isTypeSupported(type));
  }

  start() {
    const parts = [];
    this.player.draw();
    compose(this.canvas, this.player);
    this.media = new MediaRecorder(this.canvas.captureStream(30), { mimeType: this.type, videoBitsPerSecond: 8e6 });
    this.media.ondataavailable = (event) => parts.push(event.data);
    this.done = new Promise((resolve) => {
      this.media.onstop = () => {
        const blob = new Blob(parts, { type: this.type });
        save(blob, fileName(this.player, this.type.includes("webm") ? "webm" : "mp4"));
        resolve(blob);
      };
    });
    this.media.start();
  }

  get running() {
    return Boolean(this.media && this.media.state === "recording");
  }

  stop() {
    this.media.stop();
    return this.done;
  }
}

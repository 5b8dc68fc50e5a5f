"use strict";
// What a camera of the recording shows: a picture of bytes in a corner of the scene, with a bar of depth or with the
// names of the bodies in it. A click makes it larger or smaller.

const NOTHING = 255, CAPTION = 18, FOOT = 26;

// The titles of all pictures of some runs, each once.
const titlesOf = (runs) => [...new Set(runs.flatMap((run) => run.seen.map((seen) => seen.title)))];

class SeenPane {
  constructor(canvas, run, resize) {
    Object.assign(this, { canvas, run, picture: document.createElement("canvas") });
    canvas.addEventListener("click", resize);
  }

  // Draw the picture with that title; hide the canvas where the run has none.
  draw({ frame, next, part }, { camera, large }) {
    const { canvas } = this, seen = this.run.seen.find(({ title }) => title === camera), { parentElement: scene } = canvas;
    canvas.hidden = !seen;
    if (!seen) return;
    const room = Math.min((large ? 0.75 : 0.36) * scene.clientHeight, (large ? 0.75 : 0.34) * scene.clientWidth);
    const factor = Math.max(room, 48) / Math.max(seen.width, seen.height);
    const width = Math.round(factor * seen.width), height = Math.round(factor * seen.height);
    Object.assign(canvas.style, { width: `${width + 12}px`, height: `${height + CAPTION + FOOT}px` });
    const pen = penOf(canvas);
    if (!pen) return;
    pen.fillStyle = "rgba(255, 255, 255, 0.88)";
    pen.fillRect(0, 0, canvas.clientWidth, canvas.clientHeight);
    pen.fillStyle = "#1d2733";
    pen.font = "11px system-ui, sans-serif";
    pen.textAlign = "left";
    pen.fillText(seen.title, 6, 13, width);
    this.paint(seen, part < 0.5 ? frame : next);
    pen.imageSmoothingEnabled = false;
    pen.drawImage(this.picture, 6, CAPTION, width, height);
    if (seen.names.length) this.drawNames(pen, seen, part < 0.5 ? frame : next, width, CAPTION + height);
    else this.drawScale(pen, seen, width, CAPTION + height);
  }

  // The bytes of a frame, in colours.
  paint({ width, height, pixels, colors }, frame) {
    const { picture } = this, count = width * height;
    if (picture.width !== width || picture.height !== height) [picture.width, picture.height] = [width, height];
    const image = new ImageData(width, height);
    for (let i = 0; i < count; i++) {
      const byte = pixels[frame * count + i];
      for (let c = 0; c < 3; c++) image.data[4 * i + c] = colors[3 * byte + c];
      image.data[4 * i + 3] = 255;
    }
    picture.getContext("2d").putImageData(image, 0, 0);
  }

  drawScale(pen, { near, far, colors }, width, top) {
    const bar = pen.createLinearGradient(6, 0, 6 + width, 0);
    for (let i = 0; i <= 16; i++) bar.addColorStop(i / 16, colorOf(colors, Math.round(i / 16 * (NOTHING - 1))));
    pen.fillStyle = bar;
    pen.fillRect(6, top + 4, width, 6);
    pen.fillStyle = "#1d2733";
    pen.fillText(short(near), 6, top + 21);
    pen.textAlign = "right";
    pen.fillText(short(far), 6 + width, top + 21);
    pen.textAlign = "left";
  }

  // Names of bodies that the frame shows, as many as there is room for.
  drawNames(pen, { width: columns, height: rows, pixels, names, colors }, frame, width, top) {
    const count = rows * columns, shown = new Set(pixels.subarray(frame * count, (frame + 1) * count));
    let x = 6;
    for (const index of [...shown].sort((a, b) => a - b)) {
      if (index >= names.length) continue;
      const length = pen.measureText(names[index]).width + 20;
      if (x > 6 && x + length > width + 12) return;
      pen.fillStyle = colorOf(colors, index);
      pen.fillRect(x, top + 9, 8, 8);
      pen.fillStyle = "#1d2733";
      pen.fillText(names[index], x + 11, top + 17, width - 12);
      x += length;
    }
  }
}

const colorOf = (colors, byte) => `rgb(${colors[3 * byte]}, ${colors[3 * byte + 1]}, ${colors[3 * byte + 2]})`;

"use strict";
// One run in one canvas. A camera is {azimuth, elevation [radians], zoom, shift [x, y in picture heights]}. What is
// shown, `show`, is the same for all runs; player.js says what it holds.

const TANGENT = Math.tan(0.5 * 35 * Math.PI / 180);  // of half the field of view's angle

class Scene {
  constructor(canvas, run) {
    this.canvas = canvas;
    this.run = run;
    const gl = canvas.getContext("webgl2", { alpha: false, stencil: true, antialias: true });
    if (!gl) throw new Error("this browser offers no WebGL 2: use a current Firefox, Chromium or Safari");
    this.gl = gl;
    this.programs = {};
    for (const [name, [vertex, fragment]] of Object.entries(SHADERS)) this.programs[name] = program(gl, vertex, fragment);
    const [right, towards, up] = run.axes;
    this.light = unit(add(add(scale(up, 0.95), scale(right, 0.5)), towards, 0.25));
    this.quad = vertexArray(gl, [[0, new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]), 2]]);
    this.solids = run.solids.map((solid) => ({
      ...solid,
      array: vertexArray(gl, [[0, solid.vertices, 3], [1, solid.normals, 3]], solid.triangles),
      count: solid.triangles.length,
    }));
    this.cloud = run.particles && new Cloud(this, run);
  }

  // Draw a moment: a frame, the next one, and how far it is between them.
  draw(moment, camera, show) {
    const { gl, canvas } = this;
    const ratio = Math.min(window.devicePixelRatio || 1, 2) * show.sharpness;
    const width = Math.max(1, Math.round(canvas.clientWidth * ratio));
    const height = Math.max(1, Math.round(canvas.clientHeight * ratio));
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    gl.viewport(0, 0, width, height);
    const { frame, next, part } = moment;
    this.look(moment, camera, show, width, height);
    gl.depthMask(true);
    gl.clear(gl.DEPTH_BUFFER_BIT | gl.STENCIL_BUFFER_BIT);
    gl.disable(gl.DEPTH_TEST);
    gl.disable(gl.CULL_FACE);
    gl.enable(gl.BLEND);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE);
    this.use("sky", {});
    gl.bindVertexArray(this.quad.array);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
    this.drawGround();
    if (this.cloud) this.cloud.load(moment, show);
    gl.enable(gl.STENCIL_TEST);  // each pixel of the floor is darkened once
    gl.stencilFunc(gl.EQUAL, 0, 255);
    gl.stencilOp(gl.KEEP, gl.KEEP, gl.INCR);
    if (this.cloud) this.cloud.draw(true, height);
    this.drawSolids(frame, next, part, true);
    gl.disable(gl.STENCIL_TEST);
    gl.enable(gl.DEPTH_TEST);
    gl.disable(gl.BLEND);
    if (this.cloud) this.cloud.draw(false, height);
    this.drawSolids(frame, next, part, false);
  }

  // Place the camera. With one scale, all runs have the same number of pixels to a metre, at what they look at.
  look({ frame, next, part }, camera, show, width, height) {
    const { run } = this, [right, towards, up] = run.axes;
    const framing = show.follow ? run.followed : run.still, { targets } = framing;
    const level = add(scale(towards, Math.cos(camera.azimuth)), right, Math.sin(camera.azimuth));
    const back = add(scale(level, Math.cos(camera.elevation)), up, Math.sin(camera.elevation));
    const side = add(scale(right, Math.cos(camera.azimuth)), towards, -Math.sin(camera.azimuth)), above = cross(back, side);
    const aspect = width / height;
    const distance = (show.distance || framing.distance) / camera.zoom * Math.max(1, run.aspect / aspect);
    const target = [0, 1, 2].map((i) => mix(targets[(3 * frame + i) % targets.length], targets[(3 * next + i) % targets.length], part));
    const shifted = add(add(target, side, -2 * TANGENT * distance * camera.shift[0]), above, 2 * TANGENT * distance * camera.shift[1]);
    const eye = add(shifted, back, distance);
    const near = 0.02 * distance, far = 2 * distance + 30 * framing.radius;
    this.spacing = show.spacing || framing.spacing;
    this.reach = 3.2 * framing.radius;
    this.target = target;
    this.back = back;
    this.eye = eye;
    this.shared = {
      view: [side[0], above[0], back[0], 0, side[1], above[1], back[1], 0, side[2], above[2], back[2], 0,
        -dot(side, eye), -dot(above, eye), -dot(back, eye), 1],
      projection: [1 / (TANGENT * aspect), 0, 0, 0, 0, 1 / TANGENT, 0, 0,
        0, 0, -(far + near) / (far - near), -1, 0, 0, -2 * far * near / (far - near), 0],
      up, light: this.light, ground: run.floor, darkness: 0.30,
      lamp: [dot(side, this.light), dot(above, this.light), dot(back, this.light)],
      above: [dot(side, up), dot(above, up), dot(back, up)],
    };
  }

  drawGround() {
    const { gl, run } = this, [right, towards, up] = run.axes;
    const middle = add(this.target, up, run.floor - dot(this.target, up));
    if (dot(this.eye, up) < run.floor) return;
    this.use("ground", { middle, along: right, across: towards, reach: this.reach, spacing: this.spacing });
    gl.bindVertexArray(this.quad.array);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
  }

  drawSolids(frame, next, part, shadow) {
    const { gl } = this;
    const nearest = part < 0.5 ? frame : next;
    const posed = this.solids.filter((solid) => !solid.shown || solid.shown[nearest]).map((solid) => {
      const a = solid.poses.subarray(7 * frame, 7 * frame + 7), b = solid.poses.subarray(7 * next, 7 * next + 7);
      const place = [0, 1, 2].map((i) => a[i] + part * (b[i] - a[i]));
      const same = a[3] * b[3] + a[4] * b[4] + a[5] * b[5] + a[6] * b[6] < 0 ? -1 : 1;
      const turn = [3, 4, 5, 6].map((i) => a[i] + part * (same * b[i] - a[i]));
      return { solid, place, turn: turn.map((x) => x / Math.hypot(...turn)) };
    });
    const behind = (item) => dot(add(item.place, this.eye, -1), this.back);
    const clear = posed.filter((item) => item.solid.opacity < 1).sort((a, b) => behind(a) - behind(b));
    for (const item of [...posed.filter((item) => item.solid.opacity >= 1), ...clear]) {
      const { solid, place, turn } = item, through = solid.opacity < 1;
      if (!shadow) {
        gl[through ? "enable" : "disable"](gl.BLEND);
        gl.depthMask(!through);
        gl.enable(gl.CULL_FACE);
      }
      this.use("solid", { place, turn, paint: [...solid.color, solid.opacity], shadow });
      gl.bindVertexArray(solid.array.array);
      gl.drawElements(gl.TRIANGLES, solid.count, gl.UNSIGNED_INT, 0);
    }
    gl.depthMask(true);
    gl.disable(gl.CULL_FACE);
  }

  // Choose a program and set what it asks for.
  use(name, own) {
    const { gl } = this, { handle, uniforms } = this.programs[name];
    gl.useProgram(handle);
    for (const { key, location, set } of uniforms) {
      const value = key in own ? own[key] : this.shared[key];
      if (value === undefined) throw new Error(`the shader ${name} needs ${key}`);
      set(location, value);
    }
  }
}

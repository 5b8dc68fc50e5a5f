"use strict";
// One run in one canvas. A camera is {azimuth, elevation [radians], zoom, shift [x, y in picture heights]}.

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const add = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
const scale = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => scale(a, 1 / Math.max(Math.hypot(...a), 1e-12));
const TANGENT = Math.tan(0.5 * 35 * Math.PI / 180);  // of half the field of view

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
    if (run.particles) this.prepareCloud(run.particles);
  }

  prepareCloud(cloud) {
    const gl = this.gl, n = cloud.count;
    const frame = (type, size) => [new type(n * size), size];
    this.cloud = vertexArray(gl, [
      [0, ...frame(Uint16Array, 3)], [1, ...frame(Uint16Array, 3)], [2, cloud.colors, 3],
      [3, ...frame(Uint8Array, 1)], [4, ...frame(Uint8Array, 1)], [5, cloud.radii, 1],
    ], cloud.triangles);
  }

  // Draw a moment: a frame and how far it is on the way to the next one.
  // `sharpness` below 1 saves pixels.
  draw(moment, camera, by, sharpness) {
    const { gl, run, canvas } = this;
    const ratio = Math.min(window.devicePixelRatio || 1, 2) * sharpness;
    const width = Math.max(1, Math.round(canvas.clientWidth * ratio));
    const height = Math.max(1, Math.round(canvas.clientHeight * ratio));
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    gl.viewport(0, 0, width, height);
    const { frame, next, part } = moment;
    this.look(frame, next, part, camera, width, height);
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
    if (run.particles) this.loadCloud(frame, next, by);
    gl.enable(gl.STENCIL_TEST);  // each pixel of the floor is darkened once
    gl.stencilFunc(gl.EQUAL, 0, 255);
    gl.stencilOp(gl.KEEP, gl.KEEP, gl.INCR);
    this.drawCloud(part, by, true, height);
    this.drawSolids(frame, next, part, true);
    gl.disable(gl.STENCIL_TEST);
    gl.enable(gl.DEPTH_TEST);
    gl.disable(gl.BLEND);
    this.drawCloud(part, by, false, height);
    this.drawSolids(frame, next, part, false);
  }

  look(frame, next, part, camera, width, height) {
    const { run } = this, [right, towards, up] = run.axes;
    const at = (i) => run.targets.slice(3 * i, 3 * i + 3);
    const level = add(scale(towards, Math.cos(camera.azimuth)), right, Math.sin(camera.azimuth));
    const back = add(scale(level, Math.cos(camera.elevation)), up, Math.sin(camera.elevation));
    const side = unit(cross(up, back)), above = cross(back, side);
    const aspect = width / height, distance = run.distance / camera.zoom * Math.max(1, run.aspect / aspect);
    const target = add(scale(at(frame), 1 - part), at(next), part);
    const shifted = add(add(target, side, -2 * TANGENT * distance * camera.shift[0]), above, 2 * TANGENT * distance * camera.shift[1]);
    const eye = add(shifted, back, distance);
    const near = 0.02 * distance, far = distance + 30 * run.radius;
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
    const reach = 3.2 * run.radius;
    this.use("ground", { middle, along: right, across: towards, reach, spacing: run.spacing });
    gl.bindVertexArray(this.quad.array);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
  }

  loadCloud(frame, next, by) {
    const { gl, run } = this, { particles } = run, n = particles.count, values = particles.values[by];
    const load = (location, source, i, size) => {
      gl.bindBuffer(gl.ARRAY_BUFFER, this.cloud.buffers[location]);
      gl.bufferSubData(gl.ARRAY_BUFFER, 0, source, i * n * size, n * size);
    };
    load(0, particles.positions, frame, 3);
    load(1, particles.positions, next, 3);
    if (!values) return;
    load(3, values.data, frame, 1);
    load(4, values.data, next, 1);
  }

  drawCloud(part, by, shadow, height) {
    const { gl, run } = this, cloud = run.particles;
    if (!cloud) return;
    const name = cloud.triangles ? "surface" : "spheres";
    this.use(name, {
      low: cloud.low, size: cloud.size, part, palette: run.palette.flat(), heights: cloud.heights, shadow,
      by: cloud.values[by] ? 1 : by === "height" ? 2 : 0,
      focal: 0.5 * height / TANGENT, squash: Math.max(dot(this.back, run.axes[2]), 0.15),
    });
    gl.bindVertexArray(this.cloud.array);
    if (cloud.triangles) {
      gl.drawElements(gl.TRIANGLES, cloud.triangles.length, gl.UNSIGNED_INT, 0);
      return;
    }
    if (!shadow) gl.enable(gl.SAMPLE_ALPHA_TO_COVERAGE);  // smooth edges
    gl.drawArrays(gl.POINTS, 0, cloud.count);
    gl.disable(gl.SAMPLE_ALPHA_TO_COVERAGE);
  }

  drawSolids(frame, next, part, shadow) {
    const { gl } = this;
    const posed = this.solids.map((solid) => {
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

function program(gl, vertex, fragment) {
  const handle = gl.createProgram();
  for (const [type, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, text.trim());
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(handle, shader);
  }
  gl.linkProgram(handle);
  if (!gl.getProgramParameter(handle, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(handle));
  const setters = {
    [gl.FLOAT]: (at, x) => gl.uniform1f(at, x), [gl.FLOAT_VEC2]: (at, x) => gl.uniform2fv(at, x),
    [gl.FLOAT_VEC3]: (at, x) => gl.uniform3fv(at, x), [gl.FLOAT_VEC4]: (at, x) => gl.uniform4fv(at, x),
    [gl.FLOAT_MAT4]: (at, x) => gl.uniformMatrix4fv(at, false, x),
    [gl.INT]: (at, x) => gl.uniform1i(at, x), [gl.BOOL]: (at, x) => gl.uniform1i(at, x ? 1 : 0),
  };
  const uniforms = [];
  for (let i = 0; i < gl.getProgramParameter(handle, gl.ACTIVE_UNIFORMS); i++) {
    const { name, type } = gl.getActiveUniform(handle, i);
    uniforms.push({ key: name.replace("[0]", ""), location: gl.getUniformLocation(handle, name), set: setters[type] });
  }
  return { handle, uniforms };
}

// Buffers of vertices: [location, values, numbers per vertex]; whole numbers count as fractions of their largest.
function vertexArray(gl, parts, triangles) {
  const array = gl.createVertexArray(), buffers = {};
  gl.bindVertexArray(array);
  for (const [location, values, size] of parts) {
    buffers[location] = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, buffers[location]);
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.DYNAMIC_DRAW);
    const whole = values instanceof Uint8Array ? gl.UNSIGNED_BYTE : values instanceof Uint16Array ? gl.UNSIGNED_SHORT : 0;
    gl.enableVertexAttribArray(location);
    gl.vertexAttribPointer(location, size, whole || gl.FLOAT, Boolean(whole), 0, 0);
  }
  if (triangles) {
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, triangles, gl.STATIC_DRAW);
  }
  gl.bindVertexArray(null);
  return { array, buffers };
}

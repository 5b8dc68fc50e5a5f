"use strict";
// Vectors as arrays of three numbers, and WebGL: programs, and buffers of vertices.

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const add = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
const scale = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => scale(a, 1 / Math.max(Math.hypot(...a), 1e-12));
const mix = (a, b, t) => a + t * (b - a);

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

// Buffers of vertices: [location, values, numbers per vertex]. Integers reach the shader as fractions of their largest.
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

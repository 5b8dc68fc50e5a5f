"use strict";
// Shaders (GLSL ES 3.00). Positions are in world coordinates; in eye coordinates the camera is at the
// origin and looks along -z.

const SHADE = `
  uniform vec3 lamp, above;  // unit vectors towards the lamp and up, in eye coordinates
  vec3 shade(vec3 n, vec3 color) {
    float light = 0.30 + 0.22 * (0.5 + 0.5 * dot(n, above)) + 0.20 * max(n.z, 0.0) + 0.46 * max(dot(n, lamp), 0.0);
    float gleam = pow(max(dot(n, normalize(lamp + vec3(0.0, 0.0, 1.0))), 0.0), 24.0);
    return light * color + 0.14 * gleam;
  }`;

// Where a point's shadow lies on the floor.
const CAST = `
  uniform bool shadow;
  uniform vec3 up, light;
  uniform float ground;
  vec3 shadowed(vec3 p) { return shadow ? p - light * (dot(p, up) - ground) / dot(light, up) : p; }`;

// Colours: `scaled` of a number between 0 and 1, `tint` of a point by what `by` chooses.
const TINT = `
  uniform vec3 palette[8];
  uniform int by;          // 0: own colour, 1: value, 2: height
  uniform vec2 heights, range;  // ends of the height's scale; slope and offset from a stored value to the scale
  vec3 scaled(float x) {
    float place = clamp(x, 0.0, 1.0) * 7.0;
    int i = int(min(floor(place), 6.0));
    return mix(palette[i], palette[i + 1], place - float(i));
  }
  vec3 tint(vec3 p, vec3 own, float value) {
    if (by == 1) return scaled(range.x * value + range.y);
    if (by == 2) return scaled((dot(p, up) - heights.x) / max(heights.y - heights.x, 1e-9));
    return own;
  }`;

// Vertices of particles: two frames, quantised within a box, and where between them.
const CLOUD = `
  layout(location = 0) in vec3 first;
  layout(location = 1) in vec3 second;
  layout(location = 2) in vec3 own;
  layout(location = 3) in float firstValue;
  layout(location = 4) in float secondValue;
  layout(location = 5) in float radius;
  uniform mat4 view, projection;
  uniform vec3 low, size;
  uniform float part;
  vec3 position() { return low + size * mix(first, second, part); }
  float value() { return mix(firstValue, secondValue, part); }`;

const SHADERS = {
  spheres: [`#version 300 es
    precision highp float;
    ${CAST} ${TINT} ${CLOUD}
    uniform float focal;  // pixels of a length as far away as it is long
    out vec3 color, center;
    out float r;
    void main() {
      vec3 p = position();
      vec4 eye = view * vec4(shadowed(p), 1.0);
      color = tint(p, own, value()); center = eye.xyz; r = radius;
      gl_Position = projection * eye;
      gl_PointSize = 2.0 * radius * focal / max(-eye.z, 1e-6);
    }`, `#version 300 es
    precision highp float;
    ${SHADE}
    uniform bool shadow;
    uniform float squash, darkness;
    uniform mat4 projection;
    in vec3 color, center;
    in float r;
    out vec4 result;
    void main() {
      vec2 q = 2.0 * gl_PointCoord - 1.0;
      gl_FragDepth = gl_FragCoord.z;
      if (shadow) {
        if (dot(q, q / vec2(1.0, squash * squash)) > 1.0) discard;
        result = vec4(0.0, 0.0, 0.0, darkness);
        return;
      }
      float square = dot(q, q);
      if (square > 1.0) discard;
      vec3 n = vec3(q.x, -q.y, sqrt(1.0 - square));
      vec4 at = projection * vec4(center + r * n, 1.0);
      gl_FragDepth = 0.5 * at.z / at.w + 0.5;
      float edge = fwidth(square);
      result = vec4(shade(n, color), 1.0 - smoothstep(1.0 - 1.5 * edge, 1.0, square));
    }`],
  surface: [`#version 300 es
    precision highp float;
    ${CAST} ${TINT} ${CLOUD}
    out vec3 color, at;
    void main() {
      vec3 p = position();
      vec4 eye = view * vec4(shadowed(p), 1.0);
      color = tint(p, own, value()) + 0.0 * radius; at = eye.xyz;
      gl_Position = projection * eye;
    }`, `#version 300 es
    precision highp float;
    ${SHADE}
    uniform bool shadow;
    uniform float darkness;
    in vec3 color, at;
    out vec4 result;
    void main() {
      vec3 n = normalize(cross(dFdx(at), dFdy(at)));
      result = shadow ? vec4(0.0, 0.0, 0.0, darkness) : vec4(shade(n, color), 1.0);
    }`],
  skin: [`#version 300 es
    precision highp float;
    layout(location = 0) in vec3 vertex;
    layout(location = 1) in vec3 normal;
    layout(location = 2) in float shown;
    uniform vec3 paint;
    uniform mat4 view, projection;
    ${CAST} ${TINT}
    out vec3 color, n;
    void main() {
      color = tint(vertex, paint, shown); n = mat3(view) * normal;
      gl_Position = projection * view * vec4(shadowed(vertex), 1.0);
    }`, `#version 300 es
    precision highp float;
    ${SHADE}
    uniform bool shadow;
    uniform float darkness;
    in vec3 color, n;
    out vec4 result;
    void main() { result = shadow ? vec4(0.0, 0.0, 0.0, darkness) : vec4(shade(normalize(n), color), 1.0); }`],
  solid: [`#version 300 es
    precision highp float;
    layout(location = 0) in vec3 vertex;
    layout(location = 1) in vec3 normal;
    ${CAST}
    uniform mat4 view, projection;
    uniform vec3 place;
    uniform vec4 turn;  // unit quaternion x, y, z, w
    out vec3 n;
    vec3 turned(vec3 p) { return p + 2.0 * cross(turn.xyz, cross(turn.xyz, p) + turn.w * p); }
    void main() {
      n = mat3(view) * turned(normal);
      gl_Position = projection * view * vec4(shadowed(place + turned(vertex)), 1.0);
    }`, `#version 300 es
    precision highp float;
    ${SHADE}
    uniform bool shadow;
    uniform float darkness;
    uniform vec4 paint;
    in vec3 n;
    out vec4 result;
    void main() {
      result = shadow ? vec4(0.0, 0.0, 0.0, darkness * paint.a) : vec4(shade(normalize(n), paint.rgb), paint.a);
    }`],
  ground: [`#version 300 es
    precision highp float;
    layout(location = 0) in vec2 corner;
    uniform mat4 view, projection;
    uniform vec3 middle, along, across;
    uniform float reach;
    out vec3 p;
    void main() {
      p = middle + reach * (corner.x * along + corner.y * across);
      gl_Position = projection * view * vec4(p, 1.0);
    }`, `#version 300 es
    precision highp float;
    uniform vec3 middle, along, across;
    uniform float reach, spacing;
    in vec3 p;
    out vec4 result;
    void main() {
      vec2 place = vec2(dot(p, along), dot(p, across)) / spacing;
      vec2 width = max(fwidth(place), 0.012);
      vec2 line = clamp(1.5 - abs(place - round(place)) / width, 0.0, 1.0) * clamp(0.3 / width, 0.0, 1.0);
      vec3 color = vec3(0.80, 0.82, 0.85) * (1.0 - 0.16 * max(line.x, line.y));
      result = vec4(color, 1.0 - pow(clamp(length(p - middle) / reach, 0.0, 1.0), 1.5));
    }`],
  sky: [`#version 300 es
    layout(location = 0) in vec2 corner;
    out float height;
    void main() { height = 0.5 + 0.5 * corner.y; gl_Position = vec4(corner, 0.9999, 1.0); }`, `#version 300 es
    precision highp float;
    in float height;
    out vec4 result;
    void main() { result = vec4(mix(vec3(0.97, 0.98, 0.99), vec3(0.86, 0.90, 0.95), height), 1.0); }`],
};

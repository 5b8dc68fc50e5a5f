"use strict";
// Surfaces of particles, as in surface.py and surface_nets.py: a Gaussian around each particle adds to a density on a
// grid, and a surface net lies where the density is half of the median over the particles.

const CELLS_PER_DIAMETER = 2;
const SMOOTHING = 1;  // standard deviation of the Gaussian, in diameters
const LEVEL = 0.5;
const MARGIN = 4;        // cells between the particles and the end of the grid
const MAX_CELLS = 400_000;

// Arrays that are used again by the next surface, so that playing allocates little.
const reused = {};
function buffer(name, type, size) {
  if (!reused[name] || reused[name].length < size) reused[name] = new type(Math.ceil(1.2 * size));
  return reused[name].subarray(0, size);
}

// The surface of some particles. `points`: x, y, z of each [m]; `values`: a number of each, or null; `detail`: below 1
// takes longer cells. Returns vertices, outward normals, triangles, the value at each vertex, and the indices of
// particles that fly alone, outside the surface.
function particleSurface(points, diameter, values = null, detail = 1) {
  const grid = densityGrid(points, diameter, values, detail), { density, places, shape, cell, low } = grid;
  const nodes = nearestNodes(places, shape), found = Float32Array.from(nodes, (node) => density[node]);
  const level = LEVEL * median(found.slice());
  const net = surfaceNet(density, shape, level);
  const loose = [];
  for (let i = 0; i < found.length; i++) {
    if (found[i] < level && !hasVertexNear(net, shape, places, 3 * i, diameter / cell)) loose.push(i);
  }
  const normals = gradients(density, shape, net.vertices);
  const shades = values && interpolate(grid.weighted, density, shape, net.vertices);
  const { vertices } = net;
  for (let at = 0; at < vertices.length; at += 3) {
    for (let a = 0; a < 3; a++) vertices[at + a] = low[a] + cell * vertices[at + a];
  }
  return { vertices, normals, triangles: net.triangles, values: shades, loose: Uint32Array.from(loose) };
}

// The grid around the particles: its corner, cells, the density at its nodes, the same weighted by values, and where
// the particles are, in cells.
function densityGrid(points, diameter, values, detail) {
  const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
  for (let i = 0; i < points.length; i++) {
    low[i % 3] = Math.min(low[i % 3], points[i]);
    high[i % 3] = Math.max(high[i % 3], points[i]);
  }
  const extent = low.map((x, a) => high[a] - x);
  const volume = extent.reduce((product, x) => product * (x + diameter), 1);
  const cell = Math.max(diameter / (CELLS_PER_DIAMETER * detail), Math.cbrt(volume / MAX_CELLS));
  const shape = extent.map((x) => Math.ceil(x / cell) + 2 * MARGIN + 1), size = shape[0] * shape[1] * shape[2];
  const corner = low.map((x) => x - MARGIN * cell);
  const places = buffer("places", Float32Array, points.length);
  for (let i = 0; i < points.length; i++) places[i] = (points[i] - corner[i % 3]) / cell;
  const density = buffer("density", Float32Array, size).fill(0);
  const weighted = values && buffer("weighted", Float32Array, size).fill(0);
  scatter(places, shape, values, density, weighted);
  for (const numbers of weighted ? [density, weighted] : [density]) smooth(numbers, shape, SMOOTHING * diameter / cell);
  return { density, weighted, places, shape, cell, low: corner };
}

// Share each particle among the eight corners of its cell.
function scatter(places, [, ny, nz], values, density, weighted) {
  for (let p = 0; p < places.length; p += 3) {
    const i = Math.floor(places[p]), j = Math.floor(places[p + 1]), k = Math.floor(places[p + 2]);
    const x = places[p] - i, y = places[p + 1] - j, z = places[p + 2] - k;
    for (let corner = 0; corner < 8; corner++) {
      const a = corner >> 2, b = (corner >> 1) & 1, c = corner & 1;
      const weight = (a ? x : 1 - x) * (b ? y : 1 - y) * (c ? z : 1 - z);
      const node = ((i + a) * ny + j + b) * nz + k + c;
      density[node] += weight;
      if (weighted) weighted[node] += weight * values[p / 3];
    }
  }
}

// Convolve with a Gaussian along each axis, in place. The two outermost layers of nodes become 0, so that surfaces
// are closed and differences at their vertices stay inside the grid.
function smooth(numbers, [nx, ny, nz], sigma) {
  const reach = Math.trunc(3 * sigma + 0.5), kernel = new Float32Array(reach + 1);
  for (let t = 0; t <= reach; t++) kernel[t] = Math.exp(-0.5 * (t / sigma) ** 2);
  const total = kernel.reduce((sum, x) => sum + 2 * x, -kernel[0]);
  kernel.forEach((x, t) => { kernel[t] = x / total; });
  smoothAxis(numbers, nz, 1, ny, nz, nx, ny * nz, kernel);
  smoothAxis(numbers, ny, nz, nz, 1, nx, ny * nz, kernel);
  smoothAxis(numbers, nx, ny * nz, nz, 1, ny, nz, kernel);
}

// Lines of `count` nodes `step` apart begin at all multiples a * first + b * second, a < numFirst, b < numSecond.
function smoothAxis(numbers, count, step, numFirst, first, numSecond, second, kernel) {
  const reach = kernel.length - 1, line = buffer("line", Float32Array, count + 2 * reach).fill(0);
  for (let b = 0; b < numSecond; b++) {
    for (let a = 0; a < numFirst; a++) {
      const start = a * first + b * second;
      let any = 0;
      for (let i = 0; i < count; i++) any += line[reach + i] = numbers[start + i * step];
      if (any === 0) continue;
      for (const i of [0, 1, count - 2, count - 1]) numbers[start + i * step] = 0;
      for (let i = 2; i < count - 2; i++) {
        const at = reach + i;
        let sum = kernel[0] * line[at];
        for (let t = 1; t <= reach; t++) sum += kernel[t] * (line[at - t] + line[at + t]);
        numbers[start + i * step] = sum;
      }
    }
  }
}

function nearestNodes(places, [, ny, nz]) {
  const nodes = new Int32Array(places.length / 3);
  for (let i = 0; i < nodes.length; i++) {
    nodes[i] = (Math.round(places[3 * i]) * ny + Math.round(places[3 * i + 1])) * nz + Math.round(places[3 * i + 2]);
  }
  return nodes;
}

function median(numbers) {
  const sorted = numbers.sort(), middle = sorted.length >> 1;
  return sorted.length % 2 ? sorted[middle] : 0.5 * (sorted[middle - 1] + sorted[middle]);
}

// The net where the density crosses the level: one vertex for each cell with nodes on both sides, the mean of the
// points where its edges cross; two triangles for each edge that crosses. `vertexOf`: the vertex of a cell, or -1.
function surfaceNet(density, shape, level) {
  const [, ny, nz] = shape, steps = [ny * nz, nz, 1];
  const inside = buffer("inside", Uint8Array, density.length), vertexOf = buffer("vertexOf", Int32Array, density.length);
  for (let i = 0; i < inside.length; i++) inside[i] = density[i] > level ? 1 : 0;
  const cells = crossedCells(inside, shape);
  vertexOf.fill(-1);
  const vertices = new Float32Array(3 * cells.length), triangles = buffer("triangles", Uint32Array, 18 * cells.length);
  const corners = [0, 1, 2, 3, 4, 5, 6, 7].map((c) => (c >> 2) * steps[0] + ((c >> 1) & 1) * steps[1] + (c & 1));
  const sum = new Float64Array(3);
  let end = 0;
  for (let v = 0; v < cells.length; v++) {
    const cell = cells[v];
    let count = 0;
    sum.fill(0);
    for (let axis = 0; axis < 3; axis++) {
      for (let c = 0; c < 8; c++) {
        if (c & (4 >> axis)) continue;
        const a = cell + corners[c], b = a + steps[axis];
        if (inside[a] === inside[b]) continue;
        sum[0] += c >> 2; sum[1] += (c >> 1) & 1; sum[2] += c & 1;
        sum[axis] += (level - density[a]) / (density[b] - density[a]);
        count += 1;
      }
    }
    vertexOf[cell] = v;
    vertices[3 * v] = Math.floor(cell / steps[0]) + sum[0] / count;
    vertices[3 * v + 1] = Math.floor(cell / nz) % ny + sum[1] / count;
    vertices[3 * v + 2] = cell % nz + sum[2] / count;
    for (let axis = 0; axis < 3; axis++) {  // the other cells around these edges came earlier and have vertices
      if (inside[cell] === inside[cell + steps[axis]]) continue;
      const b = steps[(axis + 1) % 3], c = steps[(axis + 2) % 3], out = inside[cell];
      const q = vertexOf[out ? cell - b : cell - c], r = vertexOf[cell - b - c], s = vertexOf[out ? cell - c : cell - b];
      triangles[end] = triangles[end + 3] = v;
      triangles[end + 1] = q; triangles[end + 2] = triangles[end + 4] = r; triangles[end + 5] = s;
      end += 6;
    }
  }
  return { vertices, triangles: triangles.subarray(0, end), vertexOf };
}

// Cells with nodes on both sides, in order.
function crossedCells(inside, [nx, ny, nz]) {
  const cells = buffer("cells", Int32Array, inside.length), x = ny * nz;
  let end = 0;
  for (let i = 0; i < nx - 1; i++) for (let j = 0; j < ny - 1; j++) {
    let at = (i * ny + j) * nz, before = 0;
    for (let k = 0; k < nz; k++, at++) {
      const count = inside[at] + inside[at + nz] + inside[at + x] + inside[at + x + nz];
      if (before + count !== 0 && before + count !== 8 && k) cells[end++] = at - 1;
      before = count;
    }
  }
  return cells.subarray(0, end);
}

// Whether a vertex lies within a distance of a particle, all in cells.
function hasVertexNear({ vertices, vertexOf }, [nx, ny, nz], places, at, distance) {
  const [x, y, z] = places.subarray(at, at + 3), reach = Math.ceil(distance) + 1;
  const range = (middle, count) => [Math.max(Math.floor(middle) - reach, 0), Math.min(Math.floor(middle) + reach, count - 1)];
  const [[i0, i1], [j0, j1], [k0, k1]] = [range(x, nx), range(y, ny), range(z, nz)];
  for (let i = i0; i <= i1; i++) for (let j = j0; j <= j1; j++) for (let k = k0; k <= k1; k++) {
    const v = 3 * vertexOf[(i * ny + j) * nz + k];
    if (v < 0) continue;
    const [dx, dy, dz] = [vertices[v] - x, vertices[v + 1] - y, vertices[v + 2] - z];
    if (dx * dx + dy * dy + dz * dz <= distance * distance) return true;
  }
  return false;
}

// The node below a vertex, and what each corner of its cell counts there, into `weights`.
function weigh(vertices, at, [, ny, nz], weights) {
  const i = Math.floor(vertices[at]), j = Math.floor(vertices[at + 1]), k = Math.floor(vertices[at + 2]);
  const x = vertices[at] - i, y = vertices[at + 1] - j, z = vertices[at + 2] - k;
  for (let c = 0; c < 8; c++) weights[c] = (c & 4 ? x : 1 - x) * (c & 2 ? y : 1 - y) * (c & 1 ? z : 1 - z);
  return (i * ny + j) * nz + k;
}

// Unit vectors down the density's gradient: central differences at the corners of each vertex's cell, interpolated.
function gradients(density, shape, vertices) {
  const normals = new Float32Array(vertices.length), y = shape[2], x = shape[1] * y, weights = new Float64Array(8);
  for (let at = 0; at < vertices.length; at += 3) {
    const base = weigh(vertices, at, shape, weights);
    let a = 0, b = 0, c = 0;
    for (let corner = 0; corner < 8; corner++) {
      const node = base + (corner >> 2) * x + ((corner >> 1) & 1) * y + (corner & 1), weight = weights[corner];
      a += weight * (density[node + x] - density[node - x]);
      b += weight * (density[node + y] - density[node - y]);
      c += weight * (density[node + 1] - density[node - 1]);
    }
    const length = -Math.max(Math.sqrt(a * a + b * b + c * c), 1e-30);
    normals[at] = a / length; normals[at + 1] = b / length; normals[at + 2] = c / length;
  }
  return normals;
}

// The mean value around each vertex, weighted by density.
function interpolate(weighted, density, shape, vertices) {
  const values = new Float32Array(vertices.length / 3), y = shape[2], x = shape[1] * y, weights = new Float64Array(8);
  for (let v = 0; v < values.length; v++) {
    const base = weigh(vertices, 3 * v, shape, weights);
    let sum = 0, total = 1e-30;
    for (let corner = 0; corner < 8; corner++) {
      const node = base + (corner >> 2) * x + ((corner >> 1) & 1) * y + (corner & 1);
      sum += weights[corner] * weighted[node];
      total += weights[corner] * density[node];
    }
    values[v] = sum / total;
  }
  return values;
}

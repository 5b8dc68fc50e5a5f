"use strict";
// The particles of one run: as balls, as the surfaces of their materials, or, where they are its vertices, as a mesh.

class Cloud {
  constructor(scene, run) {
    const { gl } = scene, cloud = run.particles, n = cloud.count;
    Object.assign(this, { scene, run, cloud, gl });
    const frame = (type, size) => [new type(n * size), size];
    this.points = vertexArray(gl, [
      [0, ...frame(Uint16Array, 3)], [1, ...frame(Uint16Array, 3)], [2, cloud.colors, 3],
      [3, ...frame(Uint8Array, 1)], [4, ...frame(Uint8Array, 1)], [5, cloud.radii, 1],
    ], cloud.triangles || new Uint32Array(n));
    const nothing = [new Float32Array(0), 3];
    this.skins = cloud.parts.map((part) => ({
      ...part, count: 0, ...vertexArray(gl, [[0, ...nothing], [1, ...nothing], [2, new Float32Array(0), 1]], new Uint32Array(0)),
    }));
  }

  // Take the moment's positions and values; compute surfaces unless they are those of the moment already.
  load(moment, show) {
    const { gl, cloud } = this, n = cloud.count, values = cloud.values[show.by];
    const load = (location, source, i, size) => {
      gl.bindBuffer(gl.ARRAY_BUFFER, this.points.buffers[location]);
      gl.bufferSubData(gl.ARRAY_BUFFER, 0, source, i * n * size, n * size);
    };
    load(0, cloud.positions, moment.frame, 3);
    load(1, cloud.positions, moment.next, 3);
    if (values) {
      load(3, values.data, moment.frame, 1);
      load(4, values.data, moment.next, 1);
    }
    Object.assign(this, { part: moment.part, show, values });
    this.surface = show.surface && !cloud.triangles;
    const key = [moment.frame, moment.part, show.by, show.detail].join();
    if (!this.surface || key === this.key) return;
    const start = performance.now();
    this.key = key;
    const loose = this.skins.flatMap((skin) => this.loadSkin(skin, moment, values, show.detail));
    this.numLoose = loose.length;
    gl.bindVertexArray(this.points.array);
    gl.bufferSubData(gl.ELEMENT_ARRAY_BUFFER, 0, Uint32Array.from(loose));
    gl.bindVertexArray(null);
    this.seconds = (performance.now() - start) / 1000;
  }

  // Compute a material's surface; returns its particles that fly alone.
  loadSkin(skin, { frame, next, part }, values, detail) {
    const { gl, cloud } = this, { members } = skin, n = cloud.count;
    const points = new Float32Array(3 * members.length), own = values && new Float32Array(members.length);
    for (let i = 0; i < members.length; i++) {
      const a = frame * n + members[i], b = next * n + members[i];
      for (let axis = 0; axis < 3; axis++) {
        const place = mix(cloud.positions[3 * a + axis], cloud.positions[3 * b + axis], part) / 65535;
        points[3 * i + axis] = cloud.low[axis] + cloud.size[axis] * place;
      }
      if (own) own[i] = mix(values.data[a], values.data[b], part) / 255;
    }
    const made = particleSurface(points, skin.diameter, own, detail);
    skin.count = made.triangles.length;
    gl.bindVertexArray(skin.array);
    [made.vertices, made.normals, made.values || new Float32Array(made.vertices.length / 3)].forEach((numbers, location) => {
      gl.bindBuffer(gl.ARRAY_BUFFER, skin.buffers[location]);
      gl.bufferData(gl.ARRAY_BUFFER, numbers, gl.DYNAMIC_DRAW);
    });
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, made.triangles, gl.DYNAMIC_DRAW);
    gl.bindVertexArray(null);
    return Array.from(made.loose, (i) => members[i]);
  }

  draw(shadow, height) {
    const { gl, scene, cloud, show, values } = this;
    const [low, high] = show.ranges[show.by] || [0, 1];
    const shared = {
      palette: this.run.palette.flat(), heights: [low, high], shadow, by: values ? 1 : show.by === "height" ? 2 : 0,
      range: values ? [(values.high - values.low) / (high - low), (values.low - low) / (high - low)] : [1, 0],
    };
    for (const skin of this.surface ? this.skins : []) {
      scene.use("skin", { ...shared, paint: skin.color });
      gl.bindVertexArray(skin.array);
      gl.drawElements(gl.TRIANGLES, skin.count, gl.UNSIGNED_INT, 0);
    }
    if (this.surface && !this.numLoose) return;
    scene.use(cloud.triangles ? "surface" : "spheres", {
      ...shared, low: cloud.low, size: cloud.size, part: this.part,
      focal: 0.5 * height / TANGENT, squash: Math.max(dot(scene.back, this.run.axes[2]), 0.15),
    });
    gl.bindVertexArray(this.points.array);
    if (cloud.triangles) return gl.drawElements(gl.TRIANGLES, cloud.triangles.length, gl.UNSIGNED_INT, 0);
    if (!shadow) gl.enable(gl.SAMPLE_ALPHA_TO_COVERAGE);  // smooth edges
    if (this.surface) gl.drawElements(gl.POINTS, this.numLoose, gl.UNSIGNED_INT, 0);
    else gl.drawArrays(gl.POINTS, 0, cloud.count);
    gl.disable(gl.SAMPLE_ALPHA_TO_COVERAGE);
  }
}

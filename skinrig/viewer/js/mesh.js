// The mesh: blend shapes on the processor, normals and tangents of the moved surface, drawing.
Object.assign(V.defaults, {weights: {}, heads: 1});

V.weightsKey = p => JSON.stringify(Object.entries(p.weights).filter(([, w]) => w !== 0).sort());

V.uploadMesh = () => {
  const gl = V.gl;
  const faces = V.scene.mesh.faces;
  V.faceType = faces instanceof Uint16Array ? gl.UNSIGNED_SHORT : gl.UNSIGNED_INT;
  V.staticBuffers = {uv: gl.createBuffer(), faces: V.uploadFaces(faces)};
  gl.bindBuffer(gl.ARRAY_BUFFER, V.staticBuffers.uv);
  gl.bufferData(gl.ARRAY_BUFFER, V.scene.mesh.uv, gl.STATIC_DRAW);
  V.restAngles = V.vertexNormals(V.scene.mesh.positions);
};

// Faces by cell of the texture, so that a vertex of several faces is computed once; from the tip of the
// nose to the back of the head, so that what is hidden is not shaded.
V.ORDER = {CELLS: 48, SLAB_MM: 40};
V.drawingOrder = faces => {
  const {uv, positions} = V.scene.mesh;
  const cells = new Map();
  for (let f = 0; f < faces.length; f += 3) {
    const v = faces[f];
    const [column, row] = [uv[2 * v], uv[2 * v + 1]].map(x => Math.floor(V.ORDER.CELLS * x));
    const key = row * V.ORDER.CELLS + column;
    if (!cells.has(key)) cells.set(key, {slab: Math.round(positions[3 * v + 2] / V.ORDER.SLAB_MM), faces: []});
    cells.get(key).faces.push(faces[f], faces[f + 1], faces[f + 2]);
  }
  return new faces.constructor([...cells.values()].sort((a, b) => b.slab - a.slab).flatMap(cell => cell.faces));
};
V.uploadFaces = faces => {
  const gl = V.gl;
  const buffer = gl.createBuffer();
  gl.bindVertexArray(null);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffer);
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, V.drawingOrder(faces), gl.STATIC_DRAW);
  return {buffer, count: faces.length};
};

// Positions under the weights, the last ones kept; float64 sums so that the order of shapes does not matter.
V.morph = weights => {
  const key = V.weightsKey({weights});
  if (V.morphed?.key === key) return V.morphed.positions;
  const rest = V.scene.mesh.positions;
  const sum = Float64Array.from(rest);
  for (const [name, weight] of Object.entries(weights)) {
    const deltas = V.scene.mesh.shapes[name];
    if (!deltas || weight === 0) continue;
    for (let i = 0; i < sum.length; i++) sum[i] += weight * deltas[i];
  }
  V.morphed = {key, positions: Float32Array.from(sum)};
  return V.morphed.positions;
};

// Normals weighted by the angle of each face; vertices at one place share a normal.
V.vertexNormals = (positions, faces = V.scene.mesh.faces) => {
  const {weld} = V.scene.mesh;
  const sum = new Float64Array(positions.length);
  const e = new Float64Array(9);
  for (let f = 0; f < faces.length; f += 3) {
    for (let k = 0; k < 3; k++) {
      const a = 3 * faces[f + k];
      const b = 3 * faces[f + (k + 1) % 3];
      let length = 0;
      for (let c = 0; c < 3; c++) {
        e[3 * k + c] = positions[b + c] - positions[a + c];
        length += e[3 * k + c] ** 2;
      }
      length = Math.sqrt(length) || 1e-30;
      for (let c = 0; c < 3; c++) e[3 * k + c] /= length;
    }
    let nx = e[1] * e[5] - e[2] * e[4];
    let ny = e[2] * e[3] - e[0] * e[5];
    let nz = e[0] * e[4] - e[1] * e[3];
    const size = Math.sqrt(nx * nx + ny * ny + nz * nz);
    if (!(size > 1e-12)) continue;
    nx /= size; ny /= size; nz /= size;
    for (let k = 0; k < 3; k++) {
      const p = 3 * ((k + 2) % 3);
      const cos = -(e[3 * k] * e[p] + e[3 * k + 1] * e[p + 1] + e[3 * k + 2] * e[p + 2]);
      const angle = Math.acos(Math.min(1, Math.max(-1, cos)));
      const at = 3 * weld[faces[f + k]];
      sum[at] += angle * nx; sum[at + 1] += angle * ny; sum[at + 2] += angle * nz;
    }
  }
  const out = new Float32Array(positions.length);
  for (let v = 0; v < weld.length; v++) {
    const at = 3 * weld[v];
    const size = Math.sqrt(sum[at] ** 2 + sum[at + 1] ** 2 + sum[at + 2] ** 2) || 1;
    for (let c = 0; c < 3; c++) out[3 * v + c] = sum[at + c] / size;
  }
  return out;
};

// Change of the point along u and along v, mean of the faces by their area in the texture.
V.vertexTangents = positions => {
  const {faces, uv} = V.scene.mesh;
  const along = [new Float32Array(positions.length), new Float32Array(positions.length)];
  const area = new Float32Array(uv.length / 2);
  for (let f = 0; f < faces.length; f += 3) {
    const a = faces[f], b = faces[f + 1], c = faces[f + 2];
    const u1 = uv[2 * b] - uv[2 * a];
    const v1 = uv[2 * b + 1] - uv[2 * a + 1];
    const u2 = uv[2 * c] - uv[2 * a];
    const v2 = uv[2 * c + 1] - uv[2 * a + 1];
    const det = u1 * v2 - u2 * v1;
    const sign = Math.sign(det);
    area[a] += Math.abs(det);
    area[b] += Math.abs(det);
    area[c] += Math.abs(det);
    for (let k = 0; k < 3; k++) {
      const p1 = positions[3 * b + k] - positions[3 * a + k];
      const p2 = positions[3 * c + k] - positions[3 * a + k];
      const du = sign * (p1 * v2 - p2 * v1);
      const dv = sign * (p2 * u1 - p1 * u2);
      along[0][3 * a + k] += du;
      along[0][3 * b + k] += du;
      along[0][3 * c + k] += du;
      along[1][3 * a + k] += dv;
      along[1][3 * b + k] += dv;
      along[1][3 * c + k] += dv;
    }
  }
  for (let v = 0; v < area.length; v++) {
    const scale = area[v] > 0 ? 1 / area[v] : 0;
    for (let k = 0; k < 3; k++) { along[0][3 * v + k] *= scale; along[1][3 * v + k] *= scale; }
  }
  return along;
};

// The moved mesh of a side, computed where its weights changed.
V.movedMesh = (side, p) => {
  const key = V.moveKey(p);
  if (side.mesh?.key === key) return side.mesh;
  const gl = V.gl;
  const mesh = side.mesh ?? {
    vao: gl.createVertexArray(),
    buffers: ["position", "normal", "tangent", "bitangent"].map(() => gl.createBuffer()),
  };
  const open = V.lidsOpen(p);
  const positions = V.moveLids(V.morph(p.weights), p);
  const turned = V.vertexNormals(positions, open ? V.openFaces : V.scene.mesh.faces);
  const rest = open ? V.openAngles : V.restAngles;
  const normals = V.scene.mesh.normals.map((n, i) => n + turned[i] - rest[i]);
  if (open) V.lids.forEach(lid => lid.vertices.forEach(v => normals.set(turned.subarray(3 * v, 3 * v + 3), 3 * v)));
  for (let i = 0; i < normals.length; i += 3) {
    const size = Math.sqrt(normals[i] ** 2 + normals[i + 1] ** 2 + normals[i + 2] ** 2) || 1;
    for (let c = 0; c < 3; c++) normals[i + c] /= size;
  }
  const [tangent, bitangent] = V.vertexTangents(positions);
  gl.bindVertexArray(mesh.vao);
  const names = ["a_position", "a_normal", "a_tangent", "a_bitangent"];
  [positions, normals, tangent, bitangent].forEach((data, i) => {
    gl.bindBuffer(gl.ARRAY_BUFFER, mesh.buffers[i]);
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(V.ATTRIBUTES[names[i]]);
    gl.vertexAttribPointer(V.ATTRIBUTES[names[i]], 3, gl.FLOAT, false, 0, 0);
  });
  gl.bindBuffer(gl.ARRAY_BUFFER, V.staticBuffers.uv);
  gl.enableVertexAttribArray(V.ATTRIBUTES.a_uv);
  gl.vertexAttribPointer(V.ATTRIBUTES.a_uv, 2, gl.FLOAT, false, 0, 0);
  side.mesh = {faces: open ? V.staticBuffers.openFaces : V.staticBuffers.faces, vao: mesh.vao,
    buffers: mesh.buffers, key, positions, normals, tangent, bitangent};
  return side.mesh;
};

V.drawMesh = (side, p, faces = null) => {
  const mesh = V.movedMesh(side, p);
  const {buffer, count} = faces ?? mesh.faces;
  V.gl.bindVertexArray(mesh.vao);
  V.gl.bindBuffer(V.gl.ELEMENT_ARRAY_BUFFER, buffer);
  V.gl.drawElements(V.gl.TRIANGLES, count, V.faceType, 0);
};

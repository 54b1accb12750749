// Strain of the moved mesh (Nagano 2015, eqs. 10 to 13): a tensor at each vertex, in float64 on the
// processor and only where weights changed; its principal axes at each pixel are the shader's.
//
// The definition is model/microstructure/mesh_strain.py's, whose kernels this follows step by step: the right
// stretch tensor less 1 of each triangle, turned into the vertex's plane, averaged by rest areas;
// and the symmetric part of the map from skin to texture. What does not depend on the movement is
// computed once.
V.strain = {SLIVER: 1e-6, FINE: 0, DEGENERATE: 1, NO_TEXTURE: 2};

// Vertices that coincide before and after the movement share an index; `weld` has the index before.
V.strain.places = (moved, weld) => {
  const place = new Int32Array(weld.length);
  const split = new Map();
  let places = 0;
  for (let v = 0; v < weld.length; v++) {
    const first = weld[v];
    const others = first === v ? [] : split.get(first) ?? [first];
    const same = others.find(o => moved[3 * o] === moved[3 * v]
      && moved[3 * o + 1] === moved[3 * v + 1] && moved[3 * o + 2] === moved[3 * v + 2]);
    place[v] = same === undefined ? places++ : place[same];
    if (same === undefined && first !== v) split.set(first, [...others, v]);
  }
  return {place, places};
};

// Triangles at rest: kind, basis (9), twice the area, edges a = (x, 0) and b = (u, v) in the plane, Q (4).
V.strain.triangles = (rest, faces, uv) => {
  const count = faces.length / 3;
  const out = {
    kind: new Uint8Array(count), basis: new Float64Array(9 * count), area: new Float64Array(count),
    plane: new Float64Array(3 * count), toUv: new Float64Array(4 * count),
  };
  const {kind, basis, area, plane, toUv} = out;
  const dot = V.strain.dot;
  const [a, b, c, n] = Array.from({length: 4}, () => new Float64Array(3));
  for (let f = 0; f < count; f++) {
    const i = faces[3 * f], j = faces[3 * f + 1], k = faces[3 * f + 2];
    V.strain.edge(a, rest, i, j);
    V.strain.edge(b, rest, i, k);
    V.strain.edge(c, rest, j, k);
    const aa = dot(a, a);
    let longest = Math.max(aa, dot(b, b), dot(c, c));
    n[0] = a[1] * b[2] - a[2] * b[1];
    n[1] = a[2] * b[0] - a[0] * b[2];
    n[2] = a[0] * b[1] - a[1] * b[0];
    const twice = Math.sqrt(dot(n, n));
    if (!(twice > V.strain.SLIVER * longest)) { kind[f] = V.strain.DEGENERATE; continue; }
    // on axes e1 = a / |a|, e2 = n x e1
    const x = Math.sqrt(aa);
    const u = dot(a, b) / x;
    const v = twice / x;
    plane.set([x, u, v], 3 * f);
    const at = 9 * f;
    for (let m = 0; m < 3; m++) { basis[at + m] = a[m] / x; basis[at + 6 + m] = n[m] / twice; }
    const [nx, ny, nz] = [basis[at + 6], basis[at + 7], basis[at + 8]];
    const [ex, ey, ez] = [basis[at], basis[at + 1], basis[at + 2]];
    basis[at + 3] = ny * ez - nz * ey;
    basis[at + 4] = nz * ex - nx * ez;
    basis[at + 5] = nx * ey - ny * ex;
    area[f] = twice;
    const ua = uv[2 * j] - uv[2 * i], va = uv[2 * j + 1] - uv[2 * i + 1];
    const ub = uv[2 * k] - uv[2 * i], vb = uv[2 * k + 1] - uv[2 * i + 1];
    longest = Math.max(ua * ua + va * va, ub * ub + vb * vb, (ub - ua) ** 2 + (vb - va) ** 2);
    if (!(Math.abs(ua * vb - va * ub) > V.strain.SLIVER * longest)) {
      kind[f] = V.strain.NO_TEXTURE;
      continue;
    }
    // rows u, v; columns e1, e2
    toUv[4 * f] = ua / x;
    toUv[4 * f + 2] = va / x;
    toUv[4 * f + 1] = (ub - toUv[4 * f] * u) / v;
    toUv[4 * f + 3] = (vb - toUv[4 * f + 2] * u) / v;
  }
  return out;
};
V.strain.dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
V.strain.edge = (into, p, i, j) => {
  into[0] = p[3 * j] - p[3 * i];
  into[1] = p[3 * j + 1] - p[3 * i + 1];
  into[2] = p[3 * j + 2] - p[3 * i + 2];
};

// Stretch less 1 of each triangle on its axes, three numbers.
V.strain.changes = (rest, moved, faces, {kind, plane}) => {
  const change = new Float64Array(faces.length);
  const {dot, edge} = V.strain;
  const [a, b, A, B, da, db, sa, sb] = Array.from({length: 8}, () => new Float64Array(3));
  for (let f = 0; f < kind.length; f++) {
    if (kind[f] === V.strain.DEGENERATE) continue;
    const i = faces[3 * f], j = faces[3 * f + 1], k = faces[3 * f + 2];
    const x = plane[3 * f], u = plane[3 * f + 1], v = plane[3 * f + 2];
    edge(a, rest, i, j);
    edge(b, rest, i, k);
    // changes of the edges' inner products, without cancellation
    edge(A, moved, i, j);
    edge(B, moved, i, k);
    for (let m = 0; m < 3; m++) {
      da[m] = A[m] - a[m];
      db[m] = B[m] - b[m];
      sa[m] = A[m] + a[m];
      sb[m] = B[m] + b[m];
    }
    const gaa = dot(da, sa);
    const gab = dot(da, B) + dot(a, db);
    const gbb = dot(db, sb);
    // C - 1 = X^-T [gaa gab; gab gbb] X^-1 with X = [x u; 0 v]
    const p = gaa / (x * x);
    const q = (gab / x - p * u) / v;
    const r = (gbb / v - u * (p * u / v + 2 * q)) / v;
    // U - 1 of U = sqrt(C), Cayley-Hamilton: (C + J) / s, s^2 = tr C + 2 J
    const det = p * r - q * q;
    const J = Math.sqrt(Math.max(1 + p + r + det, 0));
    const s = Math.sqrt(Math.max(2 + p + r + 2 * J, 0));
    if (s > 0) {
      const rest_of_it = det / (1 + J + s);
      change[3 * f] = (p + rest_of_it) / s;
      change[3 * f + 1] = q / s;
      change[3 * f + 2] = (r + rest_of_it) / s;
    } else {
      change[3 * f] = -1;
      change[3 * f + 2] = -1;
    }
  }
  return change;
};

// A triangle's axes rotated by the smallest angle to the plane perpendicular to `normal`: six numbers,
// valid until the next call.
V.strain.turned = new Float64Array(6);
V.strain.carried = (basis, at, n, m) => {
  const c = basis[at + 6] * n[m] + basis[at + 7] * n[m + 1] + basis[at + 8] * n[m + 2];
  const sign = c >= 0 ? 1 : -1;
  const scale = 1 / (1 + Math.abs(c));
  const out = V.strain.turned;
  for (let e = 0; e < 2; e++) {
    const b = at + 3 * e;
    const d = (basis[b] * n[m] + basis[b + 1] * n[m + 1] + basis[b + 2] * n[m + 2]) * scale;
    for (let i = 0; i < 3; i++) {
      out[3 * e + i] = basis[b + i] - d * (sign * basis[at + 6 + i] + n[m + i]);
    }
  }
  return out;
};

// What does not move, for vertices that share places: of each corner its place and the map from the axes
// of its triangle to those of the vertex (4); of each vertex the axes of the texture (4), the metric
// (11, 12, 22) and whether both hold.
V.strain.frames = (place, places, triangles, faces) => {
  const {kind, basis, area, toUv} = triangles;
  const count = place.length;
  const normal = new Float64Array(3 * places);
  const widest = new Int32Array(places).fill(-1);
  for (let f = 0; f < kind.length; f++) {
    if (kind[f] === V.strain.DEGENERATE) continue;
    for (let corner = 0; corner < 3; corner++) {
      const w = place[faces[3 * f + corner]];
      if (widest[w] < 0 || area[f] > area[widest[w]]) widest[w] = f;
      for (let m = 0; m < 3; m++) normal[3 * w + m] += area[f] * basis[9 * f + 6 + m];
    }
  }
  const axes = new Float64Array(6 * places);
  for (let w = 0; w < places; w++) {
    if (widest[w] < 0) continue;
    const length = Math.hypot(normal[3 * w], normal[3 * w + 1], normal[3 * w + 2]);
    const flat = length <= 1e-6 * area[widest[w]]; // normals of the triangles cancel
    for (let m = 0; m < 3; m++) {
      normal[3 * w + m] = flat ? basis[9 * widest[w] + 6 + m] : normal[3 * w + m] / length;
    }
    axes.set(V.strain.carried(basis, 9 * widest[w], normal, 3 * w), 6 * w);
  }
  const maps = new Float64Array(4 * faces.length);
  const weight = new Float64Array(places);
  // mirrored and unmirrored textures separately, as folded parts would cancel
  const both = new Float64Array(8 * count);
  const share = new Float64Array(2 * count);
  for (let corner = 0; corner < faces.length; corner++) {
    const f = Math.floor(corner / 3);
    if (kind[f] === V.strain.DEGENERATE) continue;
    const vertex = faces[corner];
    const w = place[vertex];
    const here = V.strain.carried(basis, 9 * f, normal, 3 * w);
    const a = 6 * w;
    const b00 = axes[a] * here[0] + axes[a + 1] * here[1] + axes[a + 2] * here[2];
    const b01 = axes[a] * here[3] + axes[a + 1] * here[4] + axes[a + 2] * here[5];
    const b10 = axes[a + 3] * here[0] + axes[a + 4] * here[1] + axes[a + 5] * here[2];
    const b11 = axes[a + 3] * here[3] + axes[a + 4] * here[4] + axes[a + 5] * here[5];
    maps.set([b00, b01, b10, b11], 4 * corner);
    weight[w] += area[f];
    if (kind[f] === V.strain.NO_TEXTURE) continue;
    const m00 = toUv[4 * f] * b00 + toUv[4 * f + 1] * b01;
    const m01 = toUv[4 * f] * b10 + toUv[4 * f + 1] * b11;
    const m10 = toUv[4 * f + 2] * b00 + toUv[4 * f + 3] * b01;
    const m11 = toUv[4 * f + 2] * b10 + toUv[4 * f + 3] * b11;
    const side = m00 * m11 - m01 * m10 > 0 ? 0 : 1;
    const at = 8 * vertex + 4 * side;
    share[2 * vertex + side] += area[f];
    both[at] += area[f] * m00;
    both[at + 1] += area[f] * m01;
    both[at + 2] += area[f] * m10;
    both[at + 3] += area[f] * m11;
  }
  const turn = new Float64Array(4 * count);
  const metric = new Float32Array(3 * count);
  const valid = new Uint8Array(count);
  for (let vertex = 0; vertex < count; vertex++) {
    const side = share[2 * vertex] >= share[2 * vertex + 1] ? 0 : 1;
    const part = share[2 * vertex + side];
    if (weight[place[vertex]] === 0 || part === 0) continue;
    const [m00, m01, m10, m11] = [0, 1, 2, 3].map(i => both[8 * vertex + 4 * side + i] / part);
    // polar decomposition m = metric rotation: the rotation nearest to m, with reflection if mirrored
    let c = side === 0 ? m00 + m11 : m00 - m11;
    let s = side === 0 ? m10 - m01 : m10 + m01;
    const length = Math.hypot(c, s);
    c /= length;
    s /= length;
    const [o00, o10] = [c, s];
    const [o01, o11] = side === 0 ? [-s, c] : [s, -c];
    turn.set([o00, o01, o10, o11], 4 * vertex);
    metric[3 * vertex] = m00 * o00 + m01 * o01;
    metric[3 * vertex + 2] = m10 * o10 + m11 * o11;
    metric[3 * vertex + 1] = 0.5 * (m00 * o10 + m01 * o11 + m10 * o00 + m11 * o01);
    valid[vertex] = 1;
  }
  return {place, places, maps, weight, turn, metric, valid};
};

// Frames at rest; those of a movement are the last ones as long as the same vertices stay together.
V.strain.framesOf = moved => {
  const {faces, uv, weld, positions} = V.scene.mesh;
  V.strain.rest ??= Float64Array.from(positions);
  V.strain.fixed ??= V.strain.triangles(V.strain.rest, faces, uv);
  const {place, places} = V.strain.places(moved, weld);
  const last = V.strain.framed;
  if (last?.places === places && last.place.every((one, v) => one === place[v])) return last;
  V.strain.framed = V.strain.frames(place, places, V.strain.fixed, faces);
  return V.strain.framed;
};

// Tensor T - 1 at each vertex, three numbers (11, 12, 22).
V.strain.tensors = (moved, {place, places, maps, weight, turn, valid}) => {
  const {faces} = V.scene.mesh;
  const {kind, area} = V.strain.fixed;
  const change = V.strain.changes(V.strain.rest, moved, faces, V.strain.fixed);
  const sum = new Float64Array(3 * places);
  for (let f = 0; f < kind.length; f++) {
    if (kind[f] === V.strain.DEGENERATE) continue;
    const p = change[3 * f], q = change[3 * f + 1], r = change[3 * f + 2];
    for (let corner = 3 * f; corner < 3 * f + 3; corner++) {
      const at = 3 * place[faces[corner]];
      const b00 = maps[4 * corner], b01 = maps[4 * corner + 1];
      const b10 = maps[4 * corner + 2], b11 = maps[4 * corner + 3];
      sum[at] += area[f] * (b00 * b00 * p + 2 * b00 * b01 * q + b01 * b01 * r);
      sum[at + 1] += area[f] * (b00 * b10 * p + (b00 * b11 + b01 * b10) * q + b01 * b11 * r);
      sum[at + 2] += area[f] * (b10 * b10 * p + 2 * b10 * b11 * q + b11 * b11 * r);
    }
  }
  const tensor = new Float32Array(3 * place.length);
  for (let vertex = 0; vertex < place.length; vertex++) {
    if (!valid[vertex]) continue;
    const w = place[vertex];
    const t0 = sum[3 * w] / weight[w], t1 = sum[3 * w + 1] / weight[w], t2 = sum[3 * w + 2] / weight[w];
    const o00 = turn[4 * vertex], o01 = turn[4 * vertex + 1];
    const o10 = turn[4 * vertex + 2], o11 = turn[4 * vertex + 3];
    tensor[3 * vertex] = o00 * o00 * t0 + 2 * o00 * o01 * t1 + o01 * o01 * t2;
    tensor[3 * vertex + 1] = o00 * o10 * t0 + (o00 * o11 + o01 * o10) * t1 + o01 * o11 * t2;
    tensor[3 * vertex + 2] = o10 * o10 * t0 + 2 * o10 * o11 * t1 + o11 * o11 * t2;
  }
  return tensor;
};

// Positions in float64, as displacements of a micrometer would be lost in float32 sums.
V.strain.moved = weights => {
  const sum = Float64Array.from(V.scene.mesh.positions);
  for (const [name, weight] of Object.entries(weights)) {
    const deltas = V.scene.mesh.shapes[name];
    if (!deltas || weight === 0) continue;
    for (let i = 0; i < sum.length; i++) sum[i] += weight * deltas[i];
  }
  return sum;
};

// Vertex arrays of the strain of a side, computed where its weights changed.
V.strain.upload = (side, p) => {
  const key = V.weightsKey(p);
  if (side.strain?.key === key) return side.strain;
  const gl = V.gl;
  const begin = performance.now();
  const moved = V.strain.moved(p.weights);
  const frames = V.strain.framesOf(moved);
  const tensor = V.strain.tensors(moved, frames);
  V.statistics.strain_ms = performance.now() - begin;
  const made = side.strain ?? {
    vao: gl.createVertexArray(), tensor: gl.createBuffer(), metric: gl.createBuffer(),
    faces: gl.createBuffer(),
  };
  gl.bindVertexArray(made.vao);
  const same = made.frames === frames;
  [["a_tensor", made.tensor, tensor, 3], ["a_metric", made.metric, same ? null : frames.metric, 3],
    ["a_uv", V.staticBuffers.uv, null, 2]].forEach(([name, buffer, data, width]) => {
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    if (data) gl.bufferData(gl.ARRAY_BUFFER, data, gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(V.ATTRIBUTES[name]);
    gl.vertexAttribPointer(V.ATTRIBUTES[name], width, gl.FLOAT, false, 0, 0);
  });
  side.strain = {...made, key, frames};
  if (same) return side.strain;
  // a pixel of several triangles belongs to that of the lowest index, which is drawn last
  const {faces} = V.scene.mesh;
  const drawn = new Uint32Array(faces.length);
  let count = 0;
  for (let f = faces.length - 3; f >= 0; f -= 3) {
    const a = faces[f], b = faces[f + 1], c = faces[f + 2];
    if (!(frames.valid[a] && frames.valid[b] && frames.valid[c])) continue;
    drawn[count++] = a;
    drawn[count++] = b;
    drawn[count++] = c;
  }
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, made.faces);
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, drawn.subarray(0, count), gl.DYNAMIC_DRAW);
  side.strain.count = count;
  return side.strain;
};
V.ATTRIBUTES.a_tensor = 6;
V.ATTRIBUTES.a_metric = 7;

V.strain.draw = (ctx, program, uniforms) => {
  const gl = V.gl;
  const made = V.strain.upload(ctx.side, ctx.p);
  ctx.clear(0, 0, 0, 0);
  V.use(program, ctx.side, ctx.p, uniforms);
  gl.bindVertexArray(made.vao);
  gl.drawElements(gl.TRIANGLES, made.count, gl.UNSIGNED_INT, 0);
};

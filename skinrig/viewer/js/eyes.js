// Eyes of the simulated head, which are not skin: lids that open around the eyeballs, and what is seen
// between them. A ray is traced through the cornea to the iris per pixel.
//
//   V.lids         null, or the tables of both eyes; rigsim/face_parts/eyelids.py defines them
//   p.eyes_open    0: the skin is as without eyes; 1: open, to which expressions add
//   p.eyes_follow  1: both eyes look at the camera as far as they can turn
Object.assign(V.defaults, {eyes_open: 0, eyes_follow: 1});
// Rows of the drawn grid; farthest turns of the gaze, degrees; distance of skin from the eye; depth of
// the conjunctiva behind the corners, and difference in depth below which it joins the sclera.
V.EYES = {ROWS: 11, YAW: 26, UP: 16, DOWN: 20, MARGIN_MM: 0.35, SHEET_MM: 1.2, JOIN_MM: 3};

// Colors of hair and iris: of a gallery, each person's own.
V.partColors = p => V.scene.facts.people_parts?.[p.person] ?? V.scene.facts.face_parts;
V.lidsOpen = p => Boolean(V.lids) && p.eyes_open > 0;
V.opening = p => {
  const gains = V.scene.facts.face_parts.opening;
  const change = Object.entries(p.weights).reduce((sum, [n, w]) => sum + w * (gains[n] ?? 0), 0);
  return p.eyes_open * Math.min(1.15, Math.max(0.2, 1 + change));
};
V.moveKey = p => `${V.weightsKey(p)}|${V.lidsOpen(p) ? p.eyes_open : 0}`;

V.start.push(() => {
  const parts = V.scene.facts.face_parts;
  if (!parts) return;
  const {faces, positions} = V.scene.mesh;
  const table = name => V.scene.tables[name].data;
  const omitted = new Set();
  V.lids = parts.eyes.map(eye => {
    for (const face of table(`lid_faces_${eye.name}`)) omitted.add(face);
    return {center: eye.center_mm, vertices: table(`lid_vertices_${eye.name}`),
      moves: table(`lid_moves_${eye.name}`), margins: table(`lid_margins_${eye.name}`)};
  });
  const kept = faces.filter((_, i) => !omitted.has(Math.floor(i / 3)));
  const edges = parts.eyes.flatMap(eye => [...table(`lid_edges_${eye.name}`)]);
  V.openFaces = new faces.constructor([...kept, ...edges]);
  V.staticBuffers.openFaces = V.uploadFaces(V.openFaces);
  V.openAngles = V.vertexNormals(positions, V.openFaces);
  V.surface.parts.push(V.drawEyes);
  V.surface.keys.push(p => [p.eyes_open, p.eyes_follow].join());
});

// Lids around the eyeballs; skin that an expression moves into the eye rests on it.
V.moveLids = (closed, p) => {
  if (!V.lidsOpen(p)) return closed;
  const positions = closed.slice();
  const {lid_steps_per_mm: steps, apex_mm: apex} = V.scene.facts.face_parts;
  const w = V.opening(p);
  const radius = apex + V.EYES.MARGIN_MM;
  for (const lid of V.lids) {
    lid.vertices.forEach((v, i) => {
      const off = [0, 1, 2].map(k => {
        const arc = w * (1 - w) * lid.moves[6 * i + 3 + k];
        return positions[3 * v + k] + (w * lid.moves[6 * i + k] + arc) / steps - lid.center[k];
      });
      const length = Math.hypot(...off);
      const scale = length < radius ? radius / length : 1;
      for (let k = 0; k < 3; k++) positions[3 * v + k] = lid.center[k] + scale * off[k];
    });
  }
  return positions;
};

// Direction of the gaze from a head, unit; `eye` is the camera's place in the head's frame.
V.gaze = (p, center, eye) => {
  if (p.eyes_follow < 0.5) return [0, 0, 1];
  const to = eye.map((one, k) => one - center[k]);
  const yaw = Math.atan2(to[0], to[2]) / V.RAD;
  const pitch = Math.atan2(to[1], Math.hypot(to[0], to[2])) / V.RAD;
  const limit = (x, low, high) => Math.min(high, Math.max(low, x));
  // behind the head: straight ahead
  const share = Math.abs(yaw) > 60 ? Math.max(0, (100 - Math.abs(yaw)) / 40) : 1;
  return V.direction(share * limit(yaw, -V.EYES.YAW, V.EYES.YAW), share * limit(pitch, -V.EYES.DOWN, V.EYES.UP));
};

// What is seen of an eye: a grid from the lower margin's edge over the eye to the upper one's.
V.eyeGrid = (mesh, lid) => {
  const {sclera_radius_mm: radius} = V.scene.facts.face_parts;
  const count = lid.margins.length / 2;
  const {ROWS: rows, SHEET_MM: deep, JOIN_MM: join} = V.EYES;
  const at = v => [0, 1, 2].map(k => mesh.positions[3 * v + k]);
  const ends = [1, count - 2].map(i => at(lid.margins[2 * i]));
  const out = {position: [], seen: []};
  for (let i = 0; i < count; i++) {
    const [up, low] = [at(lid.margins[2 * i]), at(lid.margins[2 * i + 1])];
    const share = (up[0] - ends[0][0]) / (ends[1][0] - ends[0][0]);
    for (let r = 0; r < rows + 2; r++) {
      const part = Math.min(1, Math.max(0, (r - 1) / (rows - 1)));
      const [x, y] = [0, 1].map(k => low[k] + part * (up[k] - low[k]));
      const flat = (x - lid.center[0]) ** 2 + (y - lid.center[1]) ** 2;
      const sphere = lid.center[2] + Math.sqrt(Math.max(radius * radius - flat, 0));
      const sheet = ends[0][2] + share * (ends[1][2] - ends[0][2]) - deep;
      const h = Math.max(join - Math.abs(sphere - sheet), 0) / join;
      const z = Math.max(sphere, sheet) + 0.25 * join * h * h;
      const edge = r === 0 ? low : r === rows + 1 ? up : null;
      const outside = i === 0 || i === count - 1;
      out.position.push(...(edge ?? [x, y, outside ? Math.min(z, up[2] - 0.8) : z]));
      out.seen.push(up[1] - y, edge ? (r ? 1 : -1) : 0, share);
    }
  }
  return out;
};

V.eyeBuffers = (side, p) => {
  const mesh = V.movedMesh(side, p);
  if (side.eyes?.key === mesh.key) return side.eyes;
  const gl = V.gl;
  const rows = V.EYES.ROWS + 2;
  const made = side.eyes ?? {list: V.lids.map(lid => {
    const columns = lid.margins.length / 2;
    const index = [];
    for (let i = 0; i + 1 < columns; i++) {
      for (let r = 0; r + 1 < rows; r++) {
        const a = i * rows + r;
        index.push(a, a + 1, a + rows, a + 1, a + rows + 1, a + rows);
      }
    }
    const one = {vao: gl.createVertexArray(), position: gl.createBuffer(), seen: gl.createBuffer(),
      faces: gl.createBuffer(), count: index.length};
    gl.bindVertexArray(one.vao);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, one.faces);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, new Uint16Array(index), gl.STATIC_DRAW);
    return one;
  })};
  made.list.forEach((one, i) => {
    const grid = V.eyeGrid(mesh, V.lids[i]);
    gl.bindVertexArray(one.vao);
    for (const [name, data] of [["position", grid.position], ["seen", grid.seen]]) {
      const place = V.ATTRIBUTES[name === "seen" ? "a_normal" : "a_position"];
      gl.bindBuffer(gl.ARRAY_BUFFER, one[name]);
      gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(data), gl.DYNAMIC_DRAW);
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, 3, gl.FLOAT, false, 0, 0);
    }
  });
  side.eyes = {list: made.list, key: mesh.key};
  return side.eyes;
};

V.eyeDefines = () => {
  const f = V.scene.facts.face_parts;
  const number = x => x.toFixed(6);
  return {PI: "3.14159265358979", SCLERA: number(f.sclera_radius_mm), CORNEA: number(f.cornea_radius_mm),
    CORNEA_AT: number(f.cornea_center_mm), LIMBUS: number(f.limbus_mm), IRIS: number(f.iris_mm)};
};

// Draw both eyes of a head into the buffers of the surface, or into those of the inspection.
V.drawEyes = (ctx, side, p, frame, fragment = "eye_fragment") => {
  if (!V.lidsOpen(p)) return;
  const gl = V.gl;
  const plain = fragment !== "eye_fragment";
  const program = V.program(["mesh_attributes", "mesh_vertex"],
    ["surface_varyings", ...(plain ? [] : ["further_lights", "environment_light", "shadow_lookup", "eye_noise"]),
      fragment], plain ? {} : {...V.eyeDefines(), ...V.lightDefines(p)});
  V.eyeBuffers(side, p).list.forEach((one, i) => {
    const {center} = V.lids[i];
    V.use(program, side, p, {...frame, u_ball: center, u_gaze: V.gaze(p, center, frame.u_eye),
      u_iris: V.partColors(p).iris});
    gl.bindVertexArray(one.vao);
    gl.drawElements(gl.TRIANGLES, one.count, gl.UNSIGNED_SHORT, 0);
  });
};

// Hair of the simulated head, which is not skin: ribbons that face the camera, blended from far to near
// over the scattered light, on an undercoat that darkens covered skin.
//
//   hair           radiance of hair times its coverage, and coverage
//   p.brows        1: brows and lashes are drawn
//   p.hair         1: the scalp's hair is drawn
Object.assign(V.defaults, {brows: 0, hair: 0});
V.ATTRIBUTES.a_fiber = 8;
V.ATTRIBUTES.a_coverage = 9;
V.HAIR_POINTS = 5;
V.SEGMENT = [0, 1, 2, 3, 2, 1];

V.haired = p => Boolean(V.hair) && (p.brows > 0.5 || p.hair > 0.5);
V.hairKey = p => [V.moveKey(p), p.brows, p.hair, V.cameraKey(p), p.heads, p.crowd, p.gallery, p.person].join();

V.registerFaceParts = () => {
  const at = V.groups.findIndex(([id]) => id === "expression") + 1;
  V.groups.splice(at, 0, ["parts", "Eyes and hair", V.scene.facts.face_parts.label, true]);
  V.controls.push(
    {group: "parts", kind: "range", path: ["eyes_open"], min: 0, max: 1, label: "Eyes open", show: V.percent,
      help: "Opening of the lids; expressions add to it. 0 %: closed."},
    {group: "parts", kind: "toggle", path: ["eyes_follow"], label: "Eyes follow the camera",
      off: p => !V.lidsOpen(p), help: "Both eyes turn to the camera, up to 26° sideways."},
    {group: "parts", kind: "toggle", path: ["brows"], label: "Brows and lashes"},
    ...(V.scene.facts.face_parts.counts.scalp ? [{group: "parts", kind: "toggle", path: ["hair"],
      label: "Hair of the scalp"}] : []),
  );
};

V.start.push(() => {
  const parts = V.scene.facts.face_parts;
  if (!parts) return;
  V.registerFaceParts();
  const gl = V.gl;
  const table = name => V.scene.tables[name].data;
  const roots = table("hair_roots");
  const kinds = Object.entries(parts.counts)
    .flatMap(([kind, count]) => Array(count).fill(kind));
  const fiber = [];
  for (let s = 0; s < roots.length; s++) {
    const seed = (s * 0.61803398875) % 1;
    for (let k = 0; k < V.HAIR_POINTS; k++) {
      const t = k / (V.HAIR_POINTS - 1);
      const width = parts.width_mm[kinds[s]] * (kinds[s] === "scalp" ? -1 : 1);
      for (const one of [-1, 1]) fiber.push(one, t, seed, width);
    }
  }
  V.hair = {roots, kinds, count: roots.length, points: table("hair_points"),
    opening: table("hair_opening"), fiber: gl.createBuffer(), coverage: gl.createBuffer()};
  // faces of the undercoat, with closed and with open lids; 2/255 is not drawn
  const coverage = table("hair_coverage");
  const isCovered = (_, i, all) => [0, 1, 2].some(k => {
    const v = all[i - i % 3 + k];
    return Math.max(coverage[2 * v], coverage[2 * v + 1]) > 2;
  });
  V.hair.covered = [V.scene.mesh.faces, V.openFaces].map(faces => V.uploadFaces(faces.filter(isCovered)));
  gl.bindVertexArray(null);
  gl.bindBuffer(gl.ARRAY_BUFFER, V.hair.fiber);
  gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(fiber), gl.STATIC_DRAW);
  gl.bindBuffer(gl.ARRAY_BUFFER, V.hair.coverage);
  gl.bufferData(gl.ARRAY_BUFFER, coverage, gl.STATIC_DRAW);
  V.passes.push({
    name: "hair", after: ["surface", "shadow"], enabled: V.haired, depth: "surface",
    key: p => [V.hairKey(p), V.lightsKey(p), p.ambient, V.shadowed(p)].join(),
    targets: () => ({hair: {format: "RGBA16F", size: V.screen(), space: "screen", filter: "nearest"}}),
    draw: ctx => {
      ctx.clear(0, 0, 0, 0);
      const lights = V.lightUniforms(ctx.p);
      gl.enable(gl.BLEND);
      gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
      V.headShifts(ctx.p).forEach((shift, i) => {
        const camera = V.camera(ctx.p, ctx.size, shift);
        const p = V.headParams(ctx.p, i);
        const {absorption, multiple_scattering: multiple} = V.partColors(p);
        V.drawHair(ctx, V.headSide(ctx.side, ctx.p, i), p, {u_view: camera.view,
          u_projection: camera.projection, u_eye: camera.eye, u_pixels: camera.pixelsPerMmAt1,
          u_absorption: absorption, u_multiple: multiple, ...lights});
      });
      gl.disable(gl.BLEND);
    },
    cost: () => ({taps: V.screen()[0] * V.screen()[1], bytes: 8 * V.screen()[0] * V.screen()[1]}),
  });
});

// Curves of a pose: points, tangents and the skin's normals at the roots.
V.hairCurves = (mesh, p) => {
  const {roots, count, points, opening, kinds} = V.hair;
  const steps = V.scene.facts.face_parts.hair_steps_per_mm;
  const n = V.HAIR_POINTS;
  const first = kinds.indexOf("lash");
  const w = V.lidsOpen(p) ? V.opening(p) : 0;
  const at = new Float32Array(3 * n * count);
  for (let s = 0; s < count; s++) {
    const opened = kinds[s] === "lash" ? w : 0;
    for (let k = 0; k < 3 * n; k++) {
      const more = opened && opened * opening[3 * n * (s - first) + k];
      at[3 * n * s + k] = mesh.positions[3 * roots[s] + k % 3] + (points[3 * n * s + k] + more) / steps;
    }
  }
  return at;
};

V.hairBuffers = (side, p) => {
  const mesh = V.movedMesh(side, p);
  const gl = V.gl;
  const n = V.HAIR_POINTS;
  const {count, roots, kinds} = V.hair;
  const made = side.hair ?? {vao: gl.createVertexArray(),
    buffers: ["position", "tangent", "normal", "faces"].map(() => gl.createBuffer())};
  side.hair = made;
  gl.bindVertexArray(made.vao);
  if (made.moved !== mesh.key) {
    const at = V.hairCurves(mesh, p);
    const [position, tangent, normal] = [0, 1, 2].map(() => new Float32Array(6 * n * count));
    for (let here = 0; here < at.length; here += 3) {
      const k = here / 3 % n;
      const root = 3 * roots[Math.floor(here / 3 / n)];
      const before = k ? here - 3 : here;
      const after = k < n - 1 ? here + 3 : here;
      for (let c = 0; c < 6; c++) {
        position[2 * here + c] = at[here + c % 3];
        tangent[2 * here + c] = at[after + c % 3] - at[before + c % 3];
        normal[2 * here + c] = mesh.normals[root + c % 3];
      }
    }
    [position, tangent, normal].forEach((data, i) => {
      const place = V.ATTRIBUTES[["a_position", "a_tangent", "a_normal"][i]];
      gl.bindBuffer(gl.ARRAY_BUFFER, made.buffers[i]);
      gl.bufferData(gl.ARRAY_BUFFER, data, gl.DYNAMIC_DRAW);
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, 3, gl.FLOAT, false, 0, 0);
    });
    gl.bindBuffer(gl.ARRAY_BUFFER, V.hair.fiber);
    gl.enableVertexAttribArray(V.ATTRIBUTES.a_fiber);
    gl.vertexAttribPointer(V.ATTRIBUTES.a_fiber, 4, gl.FLOAT, false, 0, 0);
    [made.moved, made.at, made.order] = [mesh.key, at, null];
  }
  // from far to near along the camera's axis
  const order = [V.cameraKey(p), p.brows, p.hair].join();
  if (made.order !== order) {
    const back = V.direction(p.camera_yaw_deg, p.camera_pitch_deg);
    const middle = 3 * (n >> 1);
    const depth = Float64Array.from(kinds, (_, s) =>
      back.reduce((sum, b, c) => sum + b * made.at[3 * n * s + middle + c], 0));
    const drawn = Uint32Array.from(kinds.keys())
      .filter(s => (kinds[s] === "scalp" ? p.hair : p.brows) > 0.5).sort((a, b) => depth[a] - depth[b]);
    // both triangles of a segment name its four corners first, which are then computed at once
    const index = new Uint32Array(6 * (n - 1) * drawn.length);
    drawn.forEach((s, i) => {
      for (let k = 0; k < 6 * (n - 1); k++) {
        index[6 * (n - 1) * i + k] = 2 * n * s + 2 * Math.floor(k / 6) + V.SEGMENT[k % 6];
      }
    });
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, made.buffers[3]);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, index, gl.DYNAMIC_DRAW);
    [made.order, made.indices] = [order, index.length];
  }
  return made;
};

V.drawHair = (ctx, side, p, uniforms) => {
  const gl = V.gl;
  const mesh = V.movedMesh(side, p);
  const frame = {...uniforms, ...V.lightFrame(side, p)};
  const defines = {PI: "3.14159265358979", ...V.lightDefines(p)};
  V.use(V.program(["mesh_attributes", "hair_place", "undercoat_vertex"], ["surface_varyings", "further_lights",
    "environment_light", "undercoat_fragment"], defines), side, p, {...frame, u_shown: [p.hair, p.brows]});
  gl.bindVertexArray(mesh.vao);
  gl.bindBuffer(gl.ARRAY_BUFFER, V.hair.coverage);
  gl.enableVertexAttribArray(V.ATTRIBUTES.a_coverage);
  gl.vertexAttribPointer(V.ATTRIBUTES.a_coverage, 2, gl.UNSIGNED_BYTE, true, 0, 0);
  V.drawMesh(side, p, V.hair.covered[Number(V.lidsOpen(p))]);
  const made = V.hairBuffers(side, p);
  V.use(V.program(["hair_place", "hair_light", "hair_vertex"],
    ["further_lights", "environment_light", "hair_fragment"], defines), side, p, frame);
  gl.bindVertexArray(made.vao);
  gl.drawElements(gl.TRIANGLES, made.indices, gl.UNSIGNED_INT, 0);
};

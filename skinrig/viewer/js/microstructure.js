// Microstructure (Nagano 2015): a window of a large displacement, grown from a patch or fetched as
// tiles, convolved along the axes of strain in two passes, as slopes for the highlight.
//
//   relief             neutral heights of the window, um
//   window_tensor, window_metric, window_cover, window_pad   strain of the window (strain.js)
//   kernel_s, kernel_t axis, alpha, sigma of both passes, on demand: the passes look them up
//   convolved_s, convolved   heights after the first and the second pass
//   microstructure     derivatives after the strain, and of the neutral relief on the same skin
//
// Drawn again only if weights or the window changed. The window follows the center of the canvas, in
// steps of an eighth of its side, at the level whose pixels have the size of the screen's, or the
// coarsest. Where detail.js proves the effect invisible, it is omitted and all variance of the slopes
// is in the roughness.
V.microstructure = {};
Object.assign(V.defaults, {
  microstructure: 2,          // 0 none, 1 static, 2 dynamic, 3 all three side by side
  microstructure_sampling: 1, // 0 bilinear, 1 cubic
  microstructure_window_px: 0,  // side of the window; 0: as the canvas needs it
  microstructure_at: null,    // [u, v, level] holds the window; null: it follows the view
  microstructure_place: [0, 0, 0, 0],  // column, row (from the bottom), level, whether drawn
  microstructure_side_px: 512, microstructure_virtual_px: 8, microstructure_margin_px: 0, microstructure_variance: [0, 0],
  microstructure_split_px: 256, variance_stretch: [0.5, 1.5, 33], strain_px: 512,
});

// Intersection of the canvas center with the moved mesh: {uv, mm}; null if there is none.
V.microstructure.aim = p => {
  const key = V.weightsKey(p) + V.cameraKey(p) + V.screen().join();
  if (V.microstructure.aimed?.key === key) return V.microstructure.aimed.found;
  const {faces, uv} = V.scene.mesh;
  const x = V.morph(p.weights);
  const camera = V.camera(p, V.screen());
  const d = V.direction(p.camera_yaw_deg, p.camera_pitch_deg).map(c => -c);
  const o = camera.eye;
  let found = null;
  let nearest = Infinity;
  for (let f = 0; f < faces.length; f += 3) {
    const [i, j, k] = [3 * faces[f], 3 * faces[f + 1], 3 * faces[f + 2]];
    const ax = x[j] - x[i], ay = x[j + 1] - x[i + 1], az = x[j + 2] - x[i + 2];
    const bx = x[k] - x[i], by = x[k + 1] - x[i + 1], bz = x[k + 2] - x[i + 2];
    const px = d[1] * bz - d[2] * by, py = d[2] * bx - d[0] * bz, pz = d[0] * by - d[1] * bx;
    const det = ax * px + ay * py + az * pz;
    if (Math.abs(det) < 1e-12) continue;
    const tx = o[0] - x[i], ty = o[1] - x[i + 1], tz = o[2] - x[i + 2];
    const s = (tx * px + ty * py + tz * pz) / det;
    if (s < 0 || s > 1) continue;
    const qx = ty * az - tz * ay, qy = tz * ax - tx * az, qz = tx * ay - ty * ax;
    const t = (d[0] * qx + d[1] * qy + d[2] * qz) / det;
    if (t < 0 || s + t > 1) continue;
    const far = (bx * qx + by * qy + bz * qz) / det;
    if (far <= 0 || far >= nearest) continue;
    nearest = far;
    const [a, b, c] = [2 * faces[f], 2 * faces[f + 1], 2 * faces[f + 2]];
    const at = n => (1 - s - t) * uv[a + n] + s * uv[b + n] + t * uv[c + n];
    found = {uv: [at(0), at(1)], mm: far / camera.pixelsPerMmAt1};
  }
  V.microstructure.aimed = {key, found};
  return found;
};

// Side of a window that covers the canvas and its fading margins.
V.microstructure.side = p => {
  if (p.microstructure_window_px) return p.microstructure_window_px;
  const needed = Math.max(...V.screen()) / 0.75 + 2 * (p.microstructure_margin_px + 24);
  return Math.min(Math.max(128 * Math.ceil(needed / 128), 256), V.microstructure.MOST_PX);
};
V.microstructure.MOST_PX = 1024;

// Column and row of the window's lower left pixel, its level, and whether anything is drawn.
V.microstructure.place = p => {
  const facts = V.microstructure.facts;
  const n = p.microstructure_side_px;
  let aim = null;
  let level = 0;
  if (p.microstructure_at) {
    aim = p.microstructure_at;
    level = Math.min(Math.max(Math.round(aim[2]), 0), facts.levels - 1);
  } else {
    const found = V.microstructure.aim(p);
    if (!found) return [0, 0, 0, 0];
    aim = found.uv;
    const error = V.detail.microstructureError(p, found.mm);
    const left = p.detail > 0.5 && error < p.detail_tolerance;
    V.detail.state.microstructure = {pixel_mm: found.mm, error, left_out: left};
    if (left) return [0, 0, facts.levels - 1, 0];
    // window pixels of at least 3/4 of a screen pixel: finer ones would be averaged
    level = Math.max(0, Math.ceil(Math.log2(0.75e3 * found.mm / facts.pixel_um)));
    level = Math.min(level, facts.levels - 1);
  }
  const whole = Math.floor(p.microstructure_virtual_px / 2 ** level);
  const corner = u => {
    const first = Math.round((u * whole - n / 2) / (n / 8)) * (n / 8);
    return Math.max(0, Math.min(first, whole - n));
  };
  return [corner(aim[0]), corner(aim[1]), level, 1];
};

// Levels of the patch side by side: what the shader of growth reads.
V.microstructure.patch = () => {
  const t = V.scene.textures.relief_patch;
  const side = t.width;
  const [low, span] = [Math.fround(t.low[0]), Math.fround(t.high[0]) - Math.fround(t.low[0])];
  let level = Float32Array.from(t.data, word => low + Math.fround(span) * Math.fround(word / 65535));
  const {levels} = V.microstructure.facts;
  const width = 2 * side;
  const out = new Float32Array(width * side);
  let first = 0;
  for (let l = 0, n = side; l < levels; l++, n /= 2) {
    for (let y = 0; y < n; y++) out.set(level.subarray(y * n, (y + 1) * n), y * width + first);
    first += n;
    const half = n / 2;
    const next = new Float32Array(half * half);
    for (let y = 0; y < half; y++) {
      for (let x = 0; x < half; x++) {
        const at = 2 * y * n + 2 * x;
        next[y * half + x] = (level[at] + level[at + 1] + level[at + n] + level[at + n + 1]) / 4;
      }
    }
    level = next;
  }
  return V.newTexture("R32F", [width, side], {data: out, filter: "nearest"});
};

// The scene's table of kernels in the shader's layout.
V.microstructure.table = () => {
  const {kernel_alpha_breaks, kernel_alpha_lines, kernel_sigma_lines_mm} = V.scene.tables;
  const {stretch_range, alpha_limits} = V.microstructure.facts;
  const breaks = [...kernel_alpha_breaks.data];
  const lines = [...kernel_alpha_lines.data];
  return {
    u_breaks: [...breaks, ...Array(8 - breaks.length).fill(1e9)],
    u_lines: [...lines, ...Array(18 - lines.length).fill(0)],
    u_break_count: breaks.length, u_sigma_lines: [...kernel_sigma_lines_mm.data],
    u_ends: stretch_range, u_limits: alpha_limits,
  };
};

V.microstructure.windowKey = p =>
  [...p.microstructure_place, p.microstructure_side_px].join();

// Lower left corner and sides of the window in texture coordinates.
V.microstructure.window = p => {
  const [x, y, level] = p.microstructure_place;
  const whole = Math.floor(p.microstructure_virtual_px / 2 ** level);
  const n = p.microstructure_side_px;
  return [x / whole, y / whole, n / whole, n / whole];
};

V.microstructure.drawn = p => p.microstructure > 0.5 && p.microstructure_place[3] > 0.5;
V.microstructure.moves = p => V.microstructure.drawn(p) && p.microstructure > 1.5;

V.start.push(() => {
  const map = (format, size, more = {}) => ({format, size: [size, size], space: "uv",
    filter: "nearest", ...more});
  V.passes.push({
    name: "strain", after: [], key: V.weightsKey,
    targets: p => ({strain_tensor: map("RGBA32F", p.strain_px, {filter: "linear"})}),
    draw: ctx => V.strain.draw(ctx, V.program(["strain_vertex"], ["strain_fragment"]),
      {u_window: [0, 0, 1, 1]}),
    cost: p => ({taps: 0, bytes: 16 * p.strain_px ** 2}),
  }, {
    name: "strain metric", after: [], demanded: true, key: V.weightsKey,
    targets: p => ({strain_metric: map("RGBA32F", p.strain_px)}),
    draw: ctx => V.strain.draw(ctx, V.program(["strain_vertex"], ["metric_fragment"]),
      {u_window: [0, 0, 1, 1]}),
    cost: p => ({taps: 0, bytes: 16 * p.strain_px ** 2}),
  }, {
    name: "strain view", after: ["strain", "strain metric"], demanded: true, key: () => "",
    targets: p => ({strain: map("RGBA32F", p.strain_px)}),
    draw: ctx => ctx.full(V.program(["full_vertex"], ["principal", "strain_view"]),
      {u_pixels: ctx.size}),
    cost: p => ({taps: 2 * p.strain_px ** 2, bytes: 16 * p.strain_px ** 2}),
  });
  if (!V.scene.facts.microstructure) return;
  const facts = V.microstructure.facts = V.scene.facts.microstructure;
  const patch = facts.tiles ? null : V.microstructure.patch();
  const table = V.microstructure.table();
  Object.assign(V.params, {
    microstructure_virtual_px: facts.virtual_px, microstructure_margin_px: 2 * facts.reach_px,
    variance_stretch: [...facts.variance_stretch_range, V.scene.tables.strained_variance.shape[0]],
  });
  const drawGraph = V.drawGraph;
  V.drawGraph = (side, p, demand) => {
    p.microstructure_side_px = V.microstructure.side(p);
    p.microstructure_place = V.microstructure.place(p);
    const [, , level, shown] = p.microstructure_place;
    // detail averaged by pixels larger than the window's is also unresolved
    const seen = p.microstructure_at ? level : Math.max(level,
      Math.log2(0.75e3 * (V.microstructure.aim(p)?.mm ?? 1) / facts.pixel_um));
    p.microstructure_variance = [facts.slope_rms[0] ** 2 / 2,
      shown ? V.detail.between(facts.slope_rms, seen) ** 2 / 2 : 0];
    p.microstructure_split_px = V.screen()[0];
    drawGraph(side, p, demand);
  };
  const {windowKey, drawn, moves} = V.microstructure;
  const n2 = p => p.microstructure_side_px ** 2;
  const side = p => p.microstructure_side_px;
  const chunks = ["principal", "kernel_lookup"];
  const first = p => `${p.microstructure_sampling}`;
  // lines of a pixel are up to 64 pixels long, and a cubic two more
  const nearBorder = p => {
    const [x, y, level] = p.microstructure_place;
    const last = Math.floor(p.microstructure_virtual_px / 2 ** level) - side(p) - 66;
    return Math.min(x, y) < 66 || Math.max(x, y) > last;
  };
  // taps of a Gaussian along a line at the largest kernel, an upper bound
  const taps = p => n2(p) * (1 + 2 * (facts.reach_px - 2) * (p.microstructure_sampling ? 16 : 4));
  const pass = (name, source, axis) => ({
    name, after: [source, "window strain", "window pad"], enabled: moves,
    key: p => [windowKey(p), first(p)].join(),
    targets: p => ({[name]: map("R32F", side(p))}),
    draw: ctx => ctx.full(V.program(["full_vertex"], [...chunks, "line_convolution"],
      {CUBIC: Number(ctx.p.microstructure_sampling > 0.5), MIRRORED: Number(nearBorder(ctx.p))}),
      {u_source: ctx.side.buffers.get(source).texture, u_axis: axis, ...table}),
    cost: p => ({taps: taps(p), bytes: 4 * n2(p)}),
  });
  V.passes.push({
    name: "relief", after: [], key: p => [windowKey(p), V.tiles.arrived].join(), enabled: drawn,
    targets: p => ({relief: map("R32F", side(p))}),
    draw: ctx => {
      if (facts.tiles) { V.tiles.fill(ctx); return; }
      const [x, y, level] = ctx.p.microstructure_place;
      const whole = Math.floor(ctx.p.microstructure_virtual_px / 2 ** level);
      ctx.full(V.program(["full_vertex"], ["relief_fragment"]), {
        u_patch: patch, u_origin: [x, whole - y - side(ctx.p)],
        u_growth: [facts.cell_px, facts.choices],
        u_seed: [facts.seed % 65536, Math.floor(facts.seed / 65536)],
      });
    },
    cost: p => ({taps: 3 * n2(p), bytes: 4 * n2(p)}),
  }, {
    name: "window cover", after: [], key: windowKey, enabled: drawn,
    targets: p => ({window_cover: map("R8", side(p))}),
    draw: ctx => V.strain.draw(ctx, V.program(["strain_vertex"], ["strain_cover"]),
      {u_window: V.microstructure.window(ctx.p)}),
    cost: p => ({taps: 0, bytes: n2(p)}),
  }, {
    name: "window pad", after: ["window cover"], key: windowKey, enabled: drawn,
    targets: p => ({window_pad: map("RGBA16F", side(p))}),
    draw: ctx => ctx.full(V.program(["full_vertex"], ["pad_fragment"])),
    cost: p => ({taps: 81 * n2(p), bytes: 8 * n2(p)}),
  }, {
    name: "window strain", after: [], enabled: drawn,
    key: p => [windowKey(p), V.weightsKey(p)].join(),
    targets: p => ({window_tensor: map("RGBA32F", side(p)), window_metric: map("RGBA32F", side(p))}),
    draw: ctx => V.strain.draw(ctx, V.program(["strain_vertex"], ["strain_fragment"]),
      {u_window: V.microstructure.window(ctx.p)}),
    cost: p => ({taps: 0, bytes: 32 * n2(p)}),
  }, {
    name: "kernels", after: ["window strain", "window pad"], demanded: true, enabled: drawn,
    key: windowKey,
    targets: p => ({kernel_s: map("RGBA32F", side(p)), kernel_t: map("RGBA32F", side(p))}),
    draw: ctx => ctx.full(V.program(["full_vertex"], [...chunks, "kernel_fragment"]), table),
    cost: p => ({taps: 3 * n2(p), bytes: 32 * n2(p)}),
  },
  pass("convolved_s", "relief", 0), pass("convolved", "convolved_s", 1), {
    name: "microstructure", after: ["relief", "convolved", "window strain", "window pad"],
    enabled: drawn, key: p => [windowKey(p), moves(p)].join(),
    targets: p => ({microstructure: map("RGBA16F", side(p), {filter: "linear", mip: true})}),
    draw: ctx => {
      const at = name => ctx.side.buffers.get(name).texture;
      ctx.full(V.program(["full_vertex"], ["relief_derivatives"]),
        {u_moved: at(moves(ctx.p) ? "convolved" : "relief"), u_neutral: at("relief")});
    },
    cost: p => ({taps: 11 * n2(p), bytes: 11 * n2(p)}),
  });
  V.surface.chunks.push("microstructure_surface");
  V.surface.defines.push(p => ({MICROSTRUCTURE: Number(drawn(p))}));
  V.surface.adjust.push("adjustMicrostructure");
  V.surface.after.push("microstructure", "strain");
  V.surface.keys.push(p => [p.microstructure, windowKey(p), V.weightsKey(p)].join());
});

// Start: load, draw, and the interface shared by tests and controls.
V.merged = (base, change) => {
  const out = {...base};
  for (const [name, value] of Object.entries(change)) {
    const plain = value && typeof value === "object" && !Array.isArray(value);
    out[name] = plain && base[name] && typeof base[name] === "object"
      ? {...base[name], ...value} : value;
  }
  return out;
};

V.demand = new Set();

// Change parameters; drawing waits for the next frame of the screen unless `now`.
V.set = (change, now = false) => {
  for (const name of Object.keys(change)) {
    if (!(name in V.params)) throw new Error(`parameter ${name} does not exist`);
  }
  V.params = V.merged(V.params, change);
  V.changed.forEach(fn => fn(V.params));
  if (now) V.drawFrame();
  else V.requestDraw();
};
V.requestDraw = () => {
  if (V.waiting) return;
  V.waiting = true;
  requestAnimationFrame(() => { V.waiting = false; V.drawFrame(); });
};

// Wait until the device has drawn.
V.finish = () => {
  V.gl.bindFramebuffer(V.gl.FRAMEBUFFER, null);
  V.gl.readPixels(0, 0, 1, 1, V.gl.RGBA, V.gl.UNSIGNED_BYTE, new Uint8Array(4));
};

// Size of the canvas in device pixels.
V.resize = (width, height) => {
  V.canvas.width = width;
  V.canvas.height = height;
  V.drawFrame();
  V.finish();
};

V.base64 = floats => {
  const bytes = new Uint8Array(floats.buffer, floats.byteOffset, floats.byteLength);
  let text = "";
  for (let i = 0; i < bytes.length; i += 32768) {
    text += String.fromCharCode(...bytes.subarray(i, i + 32768));
  }
  return btoa(text);
};

V.readNow = name => {
  if (!V.bufferNames(V.params).includes(name)) throw new Error(`buffer ${name} does not exist`);
  V.demand.add(name);
  V.drawGraph(V.sideA, V.params, V.demand);
  V.demand.delete(name);
  return V.read(V.sideA, name);
};

// Draw n frames; return the time of each and the cost of every pass. All passes are drawn or, with
// `light`, those affected by a rotation of the light.
V.bench = (n, {light = false} = {}) => {
  const azimuth = V.params.light_azimuth_deg;
  const frames = [];
  const before = {draws: V.statistics.draws, skipped: V.statistics.skipped};
  for (let i = 0; i < n; i++) {
    if (light) V.params.light_azimuth_deg += 1;
    else V.forgetDrawn(V.sideA);
    const begun = performance.now();
    V.drawFrame();
    V.finish();
    frames.push(performance.now() - begun);
  }
  const passes = {};
  for (const pass of V.ordered()) {
    if (!V.sideA.targets.has(pass.name)) continue;
    passes[pass.name] = V.costOf(pass, V.params);
  }
  const draws = (V.statistics.draws - before.draws) / n;
  const skipped = (V.statistics.skipped - before.skipped) / n;
  V.params.light_azimuth_deg = azimuth;
  return {frames_ms: frames, draws, skipped, passes};
};

window.viewer = {
  get params() { return JSON.parse(JSON.stringify(V.params)); },
  set: change => { V.set(change, true); V.finish(); return window.viewer.params; },
  buffers: () => V.bufferNames(V.params),
  read: name => {
    const {width, height, channels, values} = V.readNow(name);
    return {width, height, channels, data: V.base64(values)};
  },
  readings: (x, y) => V.readings(x, y),
  bench: V.bench,
  mesh: () => {
    const {positions, normals} = V.movedMesh(V.sideA, V.params);
    return {positions: V.base64(positions), normals: V.base64(normals)};
  },
  resize: V.resize,
  get scene() { return V.scene; },
  statistics: V.statistics,
  ready: (async () => {
    try {
      V.canvas = document.getElementById("view");
      V.openContext(V.canvas);
      await V.load();
      V.params = V.merged(V.merged({}, V.defaults), V.scene.params);
      V.uploadMesh();
      V.sideA = V.newSide();
      V.start.forEach(fn => fn());
      V.buildScattering();
      V.drawFrame();
      V.finish();
      document.documentElement.dataset.ready = "true";
    } catch (error) {
      document.documentElement.dataset.ready = "failed";
      document.getElementById("message").textContent = error.message.split("\n")[0];
      throw error;
    }
  })(),
};

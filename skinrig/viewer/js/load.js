// The packed scene: one gzip stream of arrays, undone into typed arrays.
V.TYPES = {u1: Uint8Array, u2: Uint16Array, u4: Uint32Array, i2: Int16Array, i4: Int32Array,
  f4: Float32Array, f2: Uint16Array, f8: Float64Array};

V.inflate = async text => {
  const raw = atob(text);
  const bytes = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).arrayBuffer();
};

V.unpackArray = (buffer, entry) => {
  const Type = V.TYPES[entry.type];
  const count = entry.shape.reduce((a, b) => a * b, 1);
  const size = Type.BYTES_PER_ELEMENT;
  if (entry.predictor === "raw") return new Type(buffer, entry.offset, count);
  // low bytes first, then high ones
  const bytes = new Uint8Array(buffer, entry.offset, count * size);
  const out = new Type(count);
  for (let b = 0; b < size; b++) {
    const shift = 8 * b;
    const from = b * count;
    for (let i = 0; i < count; i++) out[i] |= bytes[from + i] << shift;
  }
  const shape = entry.shape.length === 2 ? [1, entry.shape[0], 1, entry.shape[1]]
    : [1, ...entry.shape].slice(-4);
  const [layers, height, width, channels] = shape;
  const row = width * channels;
  for (let l = 0; l < layers; l++) {
    const start = l * height * row;
    if (entry.predictor === "up" || entry.predictor === "plane") {
      for (let i = start + row; i < start + height * row; i++) out[i] += out[i - row];
    }
    if (entry.predictor === "left" || entry.predictor === "plane") {
      for (let y = 0; y < height; y++) {
        const begin = start + y * row;
        for (let i = begin + channels; i < begin + row; i++) out[i] += out[i - channels];
      }
    }
  }
  return out;
};

V.load = async () => {
  const header = JSON.parse(document.getElementById("header").textContent);
  const buffer = await V.inflate(document.getElementById("payload").textContent);
  document.getElementById("payload").textContent = "";
  const array = entry => V.unpackArray(buffer, entry);
  const mesh = header.mesh;
  const shapes = {};
  for (const [name, shape] of Object.entries(mesh.shapes)) {
    const step = Math.fround(shape.step);
    shapes[name] = Float32Array.from(array(shape.deltas), word => word * step);
  }
  V.scene = {
    ...header,
    mesh: {
      positions: array(mesh.positions), uv: array(mesh.uv), faces: array(mesh.faces),
      weld: array(mesh.weld), normals: Float32Array.from(array(mesh.normals), n => n / 32767),
      shapes,
    },
    textures: Object.fromEntries(Object.entries(header.textures)
      .map(([name, t]) => [name, {...t, data: array(t.data)}])),
    tables: Object.fromEntries(Object.entries(header.tables)
      .map(([name, t]) => [name, {shape: t.shape, data: array(t)}])),
  };
};

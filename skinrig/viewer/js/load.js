// Decode the packed scene: one gzip stream of arrays, into typed arrays.
V.TYPES = {u1: Uint8Array, u2: Uint16Array, u4: Uint32Array, i2: Int16Array, i4: Int32Array,
  f4: Float32Array, f2: Uint16Array, f8: Float64Array};

// Characters of seven bits each; larger ones stand for one that is unsafe in a page and the next.
V.UNSAFE = [0, 8, 9, 10, 11, 12, 13, 26, 27, 34, 38, 60, 127];
V.bytesOf = (text, count) => {
  const out = new Uint8Array(count);
  let [held, bits, at] = [0, 0, 0];
  const put = code => {
    held = ((held << 7) | code) & 0x3fff;
    bits += 7;
    if (bits >= 8) {
      bits -= 8;
      if (at < count) out[at++] = held >> bits;
    }
  };
  for (let i = 0; i < text.length; i++) {
    const code = text.charCodeAt(i);
    if (code >= 128) put(V.UNSAFE[(code >> 7) - 1]);
    put(code & 127);
  }
  return out;
};

V.inflate = async (text, count) => {
  const stream = new Blob([V.bytesOf(text, count)]).stream()
    .pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).arrayBuffer();
};

// Words of half the resolution, upsampled linearly in integers, plus the steps of the finest octave;
// as skinrig.viewer.packing.join_octave.
V.joinOctaves = (buffer, entry) => {
  const coarse = V.unpackArray(buffer, entry.coarse);
  const steps = new Int8Array(V.unpackArray(buffer, entry.steps).buffer);
  const [layers, h, w, channels] = entry.coarse.shape;
  const out = new Uint8Array(4 * coarse.length);
  for (let l = 0; l < layers; l++) {
    for (let y = 0; y < 2 * h; y++) {
      const near = y >> 1;
      const far = Math.min(Math.max(near + (y & 1 ? 1 : -1), 0), h - 1);
      for (let x = 0; x < 2 * w; x++) {
        const mid = x >> 1;
        const side = Math.min(Math.max(mid + (x & 1 ? 1 : -1), 0), w - 1);
        const to = ((l * 2 * h + y) * 2 * w + x) * channels;
        const a = ((l * h + near) * w + mid) * channels;
        const b = ((l * h + near) * w + side) * channels;
        const c = ((l * h + far) * w + mid) * channels;
        const d = ((l * h + far) * w + side) * channels;
        for (let k = 0; k < channels; k++) {
          const sum = 9 * coarse[a + k] + 3 * (coarse[b + k] + coarse[c + k]) + coarse[d + k];
          const word = ((sum + 8) >> 4) + entry.fine * steps[to + k];
          out[to + k] = word < 0 ? 0 : word > 255 ? 255 : word;
        }
      }
    }
  }
  return out;
};

V.unpackArray = (buffer, entry) => {
  if (entry.predictor === "octaves") return V.joinOctaves(buffer, entry);
  const Type = V.TYPES[entry.type];
  const count = entry.shape.reduce((a, b) => a * b, 1);
  const size = Type.BYTES_PER_ELEMENT;
  if (entry.predictor === "raw") return new Type(buffer, entry.offset, count);
  const Word = {1: Uint8Array, 2: Uint16Array, 4: Uint32Array}[size];
  // low bytes first, then high ones
  const bytes = new Uint8Array(buffer, entry.offset, count * size);
  const out = new Word(count);
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
  return new Type(out.buffer);
};

V.load = async () => {
  const header = JSON.parse(document.getElementById("header").textContent);
  const buffer = await V.inflate(document.getElementById("payload").textContent,
    header.packed_bytes);
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
      weld: array(mesh.weld), normals: Float32Array.from(array(mesh.normals), n => n / 8191),
      shapes,
    },
    textures: Object.fromEntries(Object.entries(header.textures)
      .map(([name, t]) => [name, {...t, data: array(t.data)}])),
    tables: Object.fromEntries(Object.entries(header.tables)
      .map(([name, t]) => [name, {shape: t.shape, data: array(t)}])),
  };
};

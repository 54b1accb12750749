// Tiles of a large displacement, fetched from the page's server, only those within the window. Until
// they arrive, the window has the coarser level's heights if available.
V.tiles = {arrived: 0, held: new Map(), asked: new Set(), failed: 0, MOST: 96};

V.tiles.name = (level, row, column) => `${level}/${row}/${column}`;

// Heights of a tile, um, row 0 at the top; null while it is being fetched.
V.tiles.of = (level, row, column) => {
  const name = V.tiles.name(level, row, column);
  const held = V.tiles.held.get(name);
  if (held) {
    V.tiles.held.delete(name);  // moved to the end: least recently used tiles are dropped first
    V.tiles.held.set(name, held);
    return held;
  }
  if (!V.tiles.asked.has(name)) {
    V.tiles.asked.add(name);
    // failed tiles are not requested again; the coarser level is kept
    V.tiles.fetch(name).catch(() => {
      V.tiles.failed += 1;
      V.announce?.("A displacement tile is missing; check that the server is running.");
    });
  }
  return null;
};

V.tiles.fetch = async name => {
  const answer = await fetch(`tiles/${name}`);
  if (!answer.ok) throw new Error(`tile ${name}: ${answer.status}`);
  const {tile_px, low, high} = V.microstructure.facts.tiles;
  const words = new Uint16Array(await answer.arrayBuffer());
  if (words.length !== tile_px ** 2) throw new Error(`tile ${name}: ${words.length} words`);
  V.tiles.held.set(name, Float32Array.from(words, word => low + (high - low) * (word / 65535)));
  V.tiles.asked.delete(name);
  if (V.tiles.held.size > V.tiles.MOST) V.tiles.held.delete(V.tiles.held.keys().next().value);
  V.tiles.arrived += 1;
  V.requestDraw();
};

// Copy the available tiles of the window to the buffer being drawn.
V.tiles.fill = ctx => {
  const gl = V.gl;
  const {tile_px} = V.microstructure.facts.tiles;
  const {levels, virtual_px} = V.microstructure.facts;
  const [left, bottom, level] = ctx.p.microstructure_place;
  const n = ctx.p.microstructure_side_px;
  const whole = virtual_px / 2 ** level;
  const top = whole - bottom - n;
  const out = new Float32Array(n * n);
  const tiles = whole / tile_px;
  const range = first => [Math.floor(first / tile_px), Math.floor((first + n - 1) / tile_px)]
    .map(i => Math.min(Math.max(i, 0), tiles - 1));
  const [rows, columns] = [range(top), range(left)];
  for (let row = rows[0]; row <= rows[1]; row++) {
    for (let column = columns[0]; column <= columns[1]; column++) {
      const tile = V.tiles.of(level, row, column);
      const coarse = tile || level + 1 >= levels ? null
        : V.tiles.held.get(V.tiles.name(level + 1, row >> 1, column >> 1));
      const y0 = Math.max(top, row * tile_px);
      const y1 = Math.min(top + n, (row + 1) * tile_px);
      const x0 = Math.max(left, column * tile_px);
      const x1 = Math.min(left + n, (column + 1) * tile_px);
      for (let y = y0; y < y1; y++) {
        // rows of the buffer count from the bottom
        const to = (n - 1 - (y - top)) * n - left;
        for (let x = x0; x < x1; x++) {
          if (tile) out[to + x] = tile[(y % tile_px) * tile_px + (x % tile_px)];
          else if (coarse) out[to + x] = coarse[((y >> 1) % tile_px) * tile_px + ((x >> 1) % tile_px)];
        }
      }
    }
  }
  gl.activeTexture(gl.TEXTURE0);
  gl.bindTexture(gl.TEXTURE_2D, ctx.side.buffers.get("relief").texture);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, n, n, gl.RED, gl.FLOAT, out);
};

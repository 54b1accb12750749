// A probe: values of the buffers at one pixel, in their own units.
V.probe = null;

// One pixel of some buffers, x to the right and y down; arrays of four numbers.
V.pixels = (names, x, y) => {
  const gl = V.gl;
  const wanted = names.filter(name => V.bufferNames(V.params).includes(name));
  const demand = new Set([V.params.view, ...V.demand, ...wanted]);
  V.drawGraph(V.sideA, V.params, demand);
  const found = {};
  for (const name of wanted) {
    const buffer = V.sideA.buffers.get(name);
    if (!buffer) continue;
    gl.bindFramebuffer(gl.FRAMEBUFFER, buffer.target.frame);
    gl.readBuffer(gl.COLOR_ATTACHMENT0 + buffer.index);
    const bytes = V.FORMATS[buffer.format][1] === "UNSIGNED_BYTE";
    const four = bytes ? new Uint8Array(4) : new Float32Array(4);
    gl.readPixels(x, buffer.size[1] - 1 - y, 1, 1, gl.RGBA, bytes ? gl.UNSIGNED_BYTE : gl.FLOAT, four);
    gl.readBuffer(gl.COLOR_ATTACHMENT0);
    found[name] = Array.from(four, value => bytes ? value / 255 : value);
  }
  return found;
};

V.fraction = value => `${(100 * value).toFixed(2)} %`;
V.triple = values => values.slice(0, 3).map(value => value.toFixed(3)).join(" ");

// Rows [what, value]; empty outside the face.
V.readings = (x, y) => {
  const found = V.pixels(["inspect", "normal", "albedo", "irradiance", "specular", "hair"], x, y);
  if (found.hair?.[3] > 0.5) return [["Hair", "not skin"]];
  if (!found.irradiance || found.irradiance[3] <= 0) return [];
  const depth = ["Depth", `${found.irradiance[3].toFixed(1)} mm`];
  if (found.normal?.slice(0, 3).every(value => value === 0)) return [["Eye", "not skin"], depth];
  const rows = [];
  if (found.inspect) {
    rows.push(["Melanosome volume fraction", V.fraction(found.inspect[2])], ["Blood volume fraction", V.fraction(found.inspect[3])]);
  }
  if (found.albedo) rows.push(["Albedo (linear sRGB)", V.triple(found.albedo)]);
  if (found.specular) rows.push(["Specular", V.triple(found.specular)]);
  if (found.normal) rows.push(["Normal", V.triple(found.normal)]);
  if (found.inspect) rows.push(["Texture coordinates u, v", found.inspect.slice(0, 2).map(v => v.toFixed(3)).join(" ")]);
  rows.push(depth);
  return rows;
};

V.placeCross = () => {
  const cross = document.getElementById("cross");
  cross.hidden = !V.probe;
  if (!V.probe) return;
  const {left, top, scale} = V.shown();
  cross.style.left = `${left + (V.probe[0] + 0.5) * scale}px`;
  cross.style.top = `${top + (V.probe[1] + 0.5) * scale}px`;
};

V.readAt = (x, y) => {
  V.probe = [x, y];
  V.placeCross();
  const rows = V.readings(x, y);
  const list = document.getElementById("reading");
  list.hidden = false;
  list.replaceChildren(...(rows.length ? rows : [["Outside the face", "–"]]).map(([what, value]) =>
    V.element("div", {}, V.element("dt", {}, what), V.element("dd", {}, value))));
  V.announce(rows.length ? rows.slice(0, 2).map(row => row.join(" ")).join(", ") : "Outside the face");
  return rows;
};
V.moveProbe = (right, down) => {
  const [x, y] = V.probe ?? [V.canvas.width >> 1, V.canvas.height >> 1];
  V.readAt(V.limit(x + right, 0, V.canvas.width - 1), V.limit(y + down, 0, V.canvas.height - 1));
};
V.showProbe = () => V.gl && V.sideA?.buffers.size && V.moveProbe(0, 0);
V.hideProbe = () => {
  V.probe = null;
  V.placeCross();
  document.getElementById("reading").hidden = true;
};
V.changed.push(() => {
  if (!V.probe) return;
  clearTimeout(V.probing);
  V.probing = setTimeout(() => V.probe && V.moveProbe(0, 0), 120);
});

// Tone mapping, and choice of the displayed buffer.
Object.assign(V.defaults, {
  exposure: 0.8, filmic: false, background: [0.09, 0.1, 0.11], view: "display", view_low: 0,
  view_high: 1, split: 0.5, compare: null,
});

V.start.push(() => V.passes.push({
  name: "display", after: ["radiance", "hair"], key: p => [p.exposure, p.filmic, p.background].join(),
  targets: () => ({display: {format: "RGBA8", size: V.screen(), space: "screen"}}),
  draw: ctx => ctx.full(V.program(["full_vertex"], ["tone", "display_fragment"])),
  cost: () => ({taps: V.screen()[0] * V.screen()[1], bytes: 4 * V.screen()[0] * V.screen()[1]}),
}));

// Draw a frame: side A, side B where two parameter sets are compared, and the canvas.
V.drawFrame = () => {
  const gl = V.gl;
  const p = V.params;
  const view = V.bufferNames(p).includes(p.view) ? p.view : "display";
  const demand = new Set([view, ...V.demand]);
  V.drawGraph(V.sideA, p, demand);
  const first = V.sideA.buffers.get(view);
  let second = first;
  if (p.compare) {
    V.sideB ??= V.newSide();
    const other = V.merged(p, p.compare);
    V.drawGraph(V.sideB, other, demand);
    second = V.sideB.buffers.get(view) ?? first;
  }
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  gl.viewport(0, 0, V.canvas.width, V.canvas.height);
  gl.disable(gl.DEPTH_TEST);
  const plain = view === "display";
  V.use(V.program(["full_vertex"], ["show_fragment"]), V.sideA, p, {
    u_first: first.texture, u_second: second.texture, u_split: p.compare ? p.split : 2,
    u_low: plain ? 0 : p.view_low, u_high: plain ? 1 : p.view_high,
    u_difference: p.compare ? p.difference_gain : 0, u_channels: V.FORMATS[first.format][2],
  });
  gl.bindVertexArray(V.vao);
  gl.drawArrays(gl.TRIANGLES, 0, 3);
};

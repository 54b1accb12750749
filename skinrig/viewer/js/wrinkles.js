// Wrinkles (Jimenez 2011): zones' strengths from the weights, derivatives in the texture, hybrid
// normals. Drawn again only where a weight changed.
Object.assign(V.defaults, {
  wrinkles: 1, wrinkle_clamp: "unit", detail_wrinkles: 1, hybrid_normals: 0,
  hybrid_sigma_mm: [1.18, 0.26, 0.16],
});
V.wrinkles = {};

// Each layer's zones: sums over blend shapes, held in [0, 1] or [-1, 1]; eight numbers a layer.
V.wrinkles.zones = p => {
  const low = p.wrinkle_clamp === "signed" ? -1 : 0;
  return (V.scene.facts.wrinkles?.layers ?? []).flatMap(layer => {
    const sums = Array(8).fill(0);
    for (const [name, weight] of Object.entries(p.weights)) {
      (layer.rows[name] ?? []).forEach((row, zone) => { sums[zone] += weight * row; });
    }
    return sums.map(sum => Math.min(Math.max(sum, low), 1));
  });
};

// Texels of the softened normals a millimeter of skin has, the median over the face.
V.wrinkles.texelsPerMm = () => {
  if (V.wrinkles.perMm) return V.wrinkles.perMm;
  const {metric, valid} = V.strain.framesOf(Float64Array.from(V.scene.mesh.positions));
  const roots = [];
  valid.forEach((good, v) => {
    const [a, b, c] = metric.subarray(3 * v, 3 * v + 3);
    if (good) roots.push(Math.sqrt(Math.abs(a * c - b * b)));
  });
  roots.sort((a, b) => a - b);
  V.wrinkles.perMm = V.wrinkles.HYBRID_PX * (roots[roots.length >> 1] ?? 1 / 250);
  return V.wrinkles.perMm;
};
V.wrinkles.HYBRID_PX = 512;

V.start.push(() => {
  const {textures} = V.scene;
  const layers = textures.wrinkle_maps?.layers ?? 0;
  if (layers) {
    const side = (textures.wrinkle_base ?? textures.wrinkle_maps).width;
    if (textures.wrinkle_base) V.params.relief = 0;  // the fitted base has this face's own
    V.passes.push({
      name: "wrinkles", after: [], key: p => [V.wrinkles.zones(p), p.wrinkles].join(),
      targets: () => ({wrinkle_derivatives:
        {format: "RGBA16F", size: [side, side], space: "uv", mip: true}}),
      draw: ctx => ctx.full(V.program(["full_vertex"], ["wrinkle_functions", "wrinkle_fragment"],
        {WRINKLE_LAYERS: layers}), {u_zones: V.wrinkles.zones(ctx.p)}),
      cost: () => ({taps: (1 + 3 * layers) * side ** 2, bytes: 8 * side ** 2 * 4 / 3}),
    });
    V.surface.slopes.push("wrinkleSlope");
    V.surface.chunks.push("wrinkle_surface");
    V.surface.adjust.push("adjustWrinkles");
    V.surface.after.push("wrinkles");
    V.surface.keys.push(p => p.detail_wrinkles);
  }
  const side = V.wrinkles.HYBRID_PX;
  const hybrid = p => p.hybrid_normals > 0.5;
  const shape = {format: "RGBA16F", size: [side, side], space: "uv"};
  const radius = p => Math.ceil(3 * Math.max(...p.hybrid_sigma_mm) * V.wrinkles.texelsPerMm());
  const soften = (name, before, direction, defines) => ({
    name, after: [before], enabled: hybrid, key: p => p.hybrid_sigma_mm.join(),
    targets: () => ({[`${name}_red_green`]: shape, [`${name}_blue`]: shape}),
    draw: ctx => ctx.full(V.program(["full_vertex"], ["soften_fragment"], defines), {
      u_direction: direction,
      u_sigma_px: ctx.p.hybrid_sigma_mm.map(mm => mm * V.wrinkles.texelsPerMm()),
    }),
    cost: p => ({taps: 3 * (2 * radius(p) + 1) * side ** 2, bytes: 16 * side ** 2}),
  });
  V.passes.push({
    name: "hybrid_source", after: ["wrinkles"], enabled: hybrid,
    key: p => [V.weightsKey(p), p.relief].join(), targets: () => ({hybrid_source: shape}),
    draw: ctx => {
      ctx.clear(0, 0, 0, 0);
      ctx.mesh(V.program(["mesh_attributes", "uv_vertex"],
        ["surface_varyings", "surface_point", "static_relief", "hybrid_source_fragment"],
        V.surfaceDefines(ctx.p)));
    },
    cost: () => ({taps: 5 * side ** 2, bytes: 8 * side ** 2}),
  }, soften("softening", "hybrid_source", [1, 0], {}),
  soften("softened", "softening", [0, 1], {FROM_SOFTENING: 1}));
  V.surface.chunks.push("hybrid_surface");
  V.surface.defines.push(p => ({HYBRID: Number(hybrid(p))}));
  V.surface.adjust.push("adjustHybridNormals");
  V.surface.after.push("softened");
  V.surface.keys.push(p => p.hybrid_normals);
  // softened normals stand for what scattering would do: both would soften twice
  const drawGraph = V.drawGraph;
  V.drawGraph = (at, p, demand) =>
    drawGraph(at, hybrid(p) ? {...p, scattering: false} : p, demand);
});

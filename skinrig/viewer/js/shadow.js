// Shadows of the key light: one depth pass along the light, drawn again only if mesh or light changed,
// and a filtered look-up per pixel. A head casts shadows on itself, not on its neighbors.
//
//   shadow_depth   height of the surface towards the light, mm; far below where there is none
//   lit            fraction of the light that reaches a pixel, on demand
Object.assign(V.defaults, {shadows: 1, shadow_px: 1024, shadow_softness_mm: 2.5});
V.start.push(() => { if (V.software()) V.params.shadow_px = 512; });

// Frame of the light around the moved mesh: right, up and towards the light; scale is 1 over the
// side of the square that holds it, mm.
V.lightFrame = (side, p) => {
  const mesh = V.movedMesh(side, p);
  if (!mesh.ball) {
    const low = [Infinity, Infinity, Infinity];
    const high = [-Infinity, -Infinity, -Infinity];
    const x = mesh.positions;
    for (let i = 0; i < x.length; i++) {
      low[i % 3] = Math.min(low[i % 3], x[i]);
      high[i % 3] = Math.max(high[i % 3], x[i]);
    }
    const center = low.map((one, k) => 0.5 * (one + high[k]));
    let far = 0;
    for (let i = 0; i < x.length; i += 3) {
      far = Math.max(far, (x[i] - center[0]) ** 2 + (x[i + 1] - center[1]) ** 2 + (x[i + 2] - center[2]) ** 2);
    }
    mesh.ball = {center, radius: 1.02 * Math.sqrt(far) + 1};
  }
  const {center, radius} = mesh.ball;
  const right = V.direction(p.light_azimuth_deg + 90, 0);
  const to = V.direction(p.light_azimuth_deg, p.light_elevation_deg);
  const up = [to[1] * right[2] - to[2] * right[1], to[2] * right[0] - to[0] * right[2],
    to[0] * right[1] - to[1] * right[0]];
  return {u_light_center: center, u_light_right: right, u_light_up: up, u_light_to: to,
    u_light_scale: 0.5 / radius};
};

V.shadowed = p => p.shadows > 0.5 && p.light_intensity > 0;

V.start.push(() => {
  V.passes.push({
    name: "shadow", after: [], depth: true, enabled: V.shadowed,
    key: p => [V.moveKey(p), p.light_azimuth_deg, p.light_elevation_deg].join(),
    targets: p => ({shadow_depth: {format: "R32F", size: [p.shadow_px, p.shadow_px], space: "light",
      filter: "nearest"}}),
    draw: ctx => {
      ctx.clear(-1e9, 0, 0, 0);
      ctx.mesh(V.program(["mesh_attributes", "light_vertex"], ["shadow_fragment"]),
        V.lightFrame(ctx.side, ctx.p));
    },
    cost: p => ({taps: 0, bytes: 8 * p.shadow_px ** 2}),
  }, {
    name: "lit", after: ["shadow"], depth: true, demanded: true,
    key: p => [V.meshKey(p), p.light_azimuth_deg, p.light_elevation_deg, V.shadowed(p),
      p.shadow_softness_mm].join(),
    targets: () => ({lit: {format: "R32F", size: V.screen(), space: "screen", filter: "nearest"}}),
    draw: ctx => {
      ctx.clear(0, 0, 0, 0);
      V.drawHeads(ctx, V.program(["mesh_attributes", "mesh_vertex"],
        ["surface_varyings", "shadow_lookup", "lit_fragment"], V.lightDefines(ctx.p)));
    },
    cost: p => ({taps: 25 * V.shadowed(p) * V.screen()[0] * V.screen()[1], bytes: 4 * V.screen()[0] * V.screen()[1]}),
  });
  V.surface.after.push("shadow");
  V.surface.keys.push(p => [V.shadowed(p), p.shadow_softness_mm].join());
});

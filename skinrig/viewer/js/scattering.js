// Screen-space scattering: a sum of Gaussians, each blurred from the one before.
Object.assign(V.defaults, {scattering: true, texturing: "post", scattering_scale: 1});

V.POWERS = {post: [0, 1], pre: [1, 0], both: [0.5, 0.5]};
V.SCATTER_TAPS = 6;

V.start.push(() => {
  const {variances_mm2, weights} = V.scene.facts.scattering;
  const pixels = () => V.screen()[0] * V.screen()[1];
  const screen = {format: "RGBA16F", space: "screen"};
  V.passes.push({
    name: "scatter_source", after: ["surface"], key: p => p.texturing,
    targets: () => ({scatter_source: {...screen, size: V.screen()}}),
    draw: ctx => ctx.full(V.program(["full_vertex"], ["scatter_source_fragment"]),
      {u_pre: V.POWERS[ctx.p.texturing][0]}),
    cost: () => ({taps: 2 * pixels(), bytes: 8 * pixels()}),
  });
  let source = "scatter_source";
  variances_mm2.forEach((variance, i) => {
    const sigma = Math.sqrt(variance - (i ? variances_mm2[i - 1] : 0));
    for (const axis of ["x", "y"]) {
      const name = `scatter_${i}_${axis}`;
      const from = source;
      V.passes.push({
        name, after: [from, "surface"], enabled: p => Boolean(p.scattering),
        key: p => [p.scattering_scale, V.cameraKey(p)].join(),
        targets: () => ({[name]: {...screen, size: V.screen()}}),
        draw: ctx => ctx.full(
          V.program(["full_vertex"], ["scatter_fragment"], {TAPS: V.SCATTER_TAPS}), {
            u_source: ctx.side.buffers.get(from).texture,
            u_step: axis === "x" ? [1 / ctx.size[0], 0] : [0, 1 / ctx.size[1]],
            u_sigma_mm: sigma * ctx.p.scattering_scale,
            u_pixels: V.camera(ctx.p, ctx.size).pixelsPerMmAt1,
          }),
        cost: () => ({taps: (4 * V.SCATTER_TAPS + 2) * pixels(), bytes: 8 * pixels()}),
      });
      source = name;
    }
  });
  const last = variances_mm2.map((_, i) => `scatter_${i}_y`);
  const number = value => value.toFixed(8);
  const vector = rgb => `vec3(${rgb.map(number).join(", ")})`;
  V.glsl.radiance_scattered = V.glsl.radiance_fragment.replace("SUM",
    last.map((n, i) => `  light += ${vector(weights[i])} * texel_${n}(at).rgb;`).join("\n"));
  V.glsl.radiance_plain = V.glsl.radiance_fragment.replace("SUM",
    "  light = texel_scatter_source(at).rgb;");
  V.passes.push({
    name: "radiance", after: ["surface", "scatter_source", ...last],
    key: p => [p.texturing, p.scattering].join(),
    targets: () => ({radiance: {...screen, size: V.screen()}}),
    draw: ctx => ctx.full(V.program(["full_vertex"],
      [ctx.p.scattering ? "radiance_scattered" : "radiance_plain"]),
      {u_post: V.POWERS[ctx.p.texturing][1]}),
    cost: () => ({taps: (2 + last.length) * pixels(), bytes: 8 * pixels()}),
  });
});

// Screen-space scattering: a sum of Gaussians, each blurred from the one before.
Object.assign(V.defaults, {scattering: true, texturing: "post", scattering_scale: 1});

// Powers of the albedo before and after the blur; "both" blurs a measured map twice.
V.POWERS = {post: [0, 1], pre: [1, 0], both: [0.5, 0.5]};
V.SCATTER = {taps: 3, reach: 2.5, slantLimit: 4, interpolation: 0.75 ** 4, leastPx: 0.25};

// Profiles {variances_mm2, weights: [[r, g, b], ...]} by name; other scripts may add their own and
// a function that chooses: V.profileName = p => name.
V.profiles = {};
V.profileName = () => "default";
V.diffusionProfile = p => V.profiles[V.profileName(p)] ?? V.profiles.default;

// Truncation and sampling narrow a Gaussian; this factor compensates.
V.scatterWidening = () => {
  const {taps, reach} = V.SCATTER;
  let [sum, squares] = [1, 0];
  for (let i = 1; i <= taps; i++) {
    const t = reach * i / taps;
    sum += 2 * Math.exp(-0.5 * t * t);
    squares += 2 * t * t * Math.exp(-0.5 * t * t);
  }
  return Math.sqrt(sum / squares);
};

V.start.push(() => {
  V.profiles.default = V.scene.facts.scattering;
});

// Number of Gaussians, from the narrowest on, that leave the light as it is: those below leastPx at the
// nearest point; all without scattering.
V.unblurred = p => {
  const {variances_mm2: variances} = V.diffusionProfile(p);
  if (!p.scattering) return variances.length;
  const least = V.SCATTER.leastPx * V.detail.footprint(p) / p.scattering_scale;
  return variances.filter(one => Math.sqrt(one) < least).length;
};

// Called at the start, after all scripts have registered their profiles.
V.buildScattering = () => {
  const pixels = () => V.screen()[0] * V.screen()[1];
  const screen = {format: "RGBA16F", space: "screen"};
  const most = Math.max(...Object.values(V.profiles).map(one => one.variances_mm2.length));
  const sigma = (p, i) => {
    const {variances_mm2: variances} = V.diffusionProfile(p);
    return Math.sqrt(variances[i] - (i > V.unblurred(p) ? variances[i - 1] : 0));
  };
  V.passes.push({
    name: "scatter_source", after: ["surface"], key: p => p.texturing, depth: "surface",
    targets: () => ({scatter_source: {...screen, size: V.screen()}}),
    draw: ctx => {
      ctx.clear(0, 0, 0, 0);
      ctx.full(V.program(["full_vertex"], ["scatter_source_fragment"]), {u_pre: V.POWERS[ctx.p.texturing][0]});
    },
    cost: () => ({taps: 2 * pixels(), bytes: 8 * pixels()}),
  });
  const {taps, reach, slantLimit, interpolation} = V.SCATTER;
  const defines = {TAPS: taps, REACH: reach.toFixed(4), SLANT_LIMIT: slantLimit.toFixed(4),
    INTERPOLATION: interpolation.toFixed(8)};
  const widening = V.scatterWidening();
  const levels = Array.from({length: most}, (_, i) => `scatter_${i}_y`);
  for (let i = 0; i < most; i++) {
    for (const axis of ["x", "y"]) {
      const name = `scatter_${i}_${axis}`;
      const from = p => axis === "y" ? `scatter_${i}_x` : i > V.unblurred(p) ? levels[i - 1] : "scatter_source";
      V.passes.push({
        name, after: ["surface", "scatter_source", axis === "y" ? `scatter_${i}_x` : levels[i - 1] ?? "surface"],
        enabled: p => i >= V.unblurred(p) && i < V.diffusionProfile(p).variances_mm2.length, depth: "surface",
        key: p => [p.scattering_scale, sigma(p, i), V.cameraKey(p)].join(),
        targets: () => ({[name]: {...screen, size: V.screen()}}),
        draw: ctx => {
          ctx.clear(0, 0, 0, 0);
          ctx.full(V.program(["full_vertex"], ["scatter_fragment"], defines), {
            u_source: ctx.side.buffers.get(from(ctx.p)).texture,
            u_axis: axis === "x" ? [1, 0] : [0, 1],
            u_sigma_mm: widening * sigma(ctx.p, i) * ctx.p.scattering_scale,
            u_pixels: V.camera(ctx.p, ctx.size).pixelsPerMmAt1,
          });
        },
        cost: () => ({taps: (4 * taps + 5) * pixels(), bytes: 8 * pixels()}),
      });
    }
  }
  // light as it is, with the weights of the Gaussians that do not blur, and the blurred levels
  const {radiance_fragment: text} = V.glsl;
  const chunk = p => {
    const read = ["scatter_source", ...levels.slice(V.unblurred(p), V.diffusionProfile(p).weights.length)];
    const name = `radiance_of_${read.join("_")}`;
    V.glsl[name] ??= text.replace("SUM",
      read.map((one, i) => `  light += u_weights[${i}] * texel_${one}(at).rgb;`).join("\n"));
    return [name, read.length];
  };
  V.passes.push({
    name: "radiance", after: ["surface", "scatter_source", ...levels], depth: "surface",
    key: p => [p.texturing, V.unblurred(p), V.diffusionProfile(p).weights].join(),
    targets: () => ({radiance: {...screen, size: V.screen()}}),
    draw: ctx => {
      const {weights} = V.diffusionProfile(ctx.p);
      const blurred = weights.slice(V.unblurred(ctx.p));
      const rest = [0, 1, 2].map(c => blurred.reduce((sum, one) => sum - one[c], 1));
      const [name, count] = chunk(ctx.p);
      ctx.clear(0, 0, 0, 0);
      ctx.full(V.program(["full_vertex"], [name], {LEVELS: count}),
        {u_post: V.POWERS[ctx.p.texturing][1], u_weights: [rest, ...blurred].flat()});
    },
    cost: p => ({taps: (3 + V.diffusionProfile(p).weights.length - V.unblurred(p)) * pixels(), bytes: 8 * pixels()}),
  });
};

// Screen-space scattering: a sum of Gaussians, each blurred from the one before.
Object.assign(V.defaults, {scattering: true, texturing: "post", scattering_scale: 1});

// Powers of the albedo before and after the blur; "both" blurs a measured map twice.
V.POWERS = {post: [0, 1], pre: [1, 0], both: [0.5, 0.5]};
V.SCATTER = {taps: 4, reach: 2.5, slantLimit: 4, interpolation: 0.75 ** 4};

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

// Called at the start, after all scripts have registered their profiles.
V.buildScattering = () => {
  const pixels = () => V.screen()[0] * V.screen()[1];
  const screen = {format: "RGBA16F", space: "screen"};
  const most = Math.max(...Object.values(V.profiles).map(one => one.variances_mm2.length));
  const sigma = (p, i) => {
    const {variances_mm2: variances} = V.diffusionProfile(p);
    return Math.sqrt(variances[i] - (i ? variances[i - 1] : 0));
  };
  V.passes.push({
    name: "scatter_source", after: ["surface"], key: p => p.texturing,
    targets: () => ({scatter_source: {...screen, size: V.screen()}}),
    draw: ctx => ctx.full(V.program(["full_vertex"], ["scatter_source_fragment"]),
      {u_pre: V.POWERS[ctx.p.texturing][0]}),
    cost: () => ({taps: 2 * pixels(), bytes: 8 * pixels()}),
  });
  const {taps, reach, slantLimit, interpolation} = V.SCATTER;
  const defines = {TAPS: taps, REACH: reach.toFixed(4), SLANT_LIMIT: slantLimit.toFixed(4),
    INTERPOLATION: interpolation.toFixed(8)};
  const widening = V.scatterWidening();
  let source = "scatter_source";
  for (let i = 0; i < most; i++) {
    for (const axis of ["x", "y"]) {
      const name = `scatter_${i}_${axis}`;
      const from = source;
      V.passes.push({
        name, after: [from, "surface"],
        enabled: p => Boolean(p.scattering) && i < V.diffusionProfile(p).variances_mm2.length,
        key: p => [p.scattering_scale, sigma(p, i), V.cameraKey(p)].join(),
        targets: () => ({[name]: {...screen, size: V.screen()}}),
        draw: ctx => ctx.full(V.program(["full_vertex"], ["scatter_fragment"], defines), {
          u_source: ctx.side.buffers.get(from).texture,
          u_axis: axis === "x" ? [1, 0] : [0, 1],
          u_sigma_mm: widening * sigma(ctx.p, i) * ctx.p.scattering_scale,
          u_pixels: V.camera(ctx.p, ctx.size).pixelsPerMmAt1,
        }),
        cost: () => ({taps: (4 * taps + 5) * pixels(), bytes: 8 * pixels()}),
      });
      source = name;
    }
  }
  const last = Array.from({length: most}, (_, i) => `scatter_${i}_y`);
  V.glsl.radiance_plain = V.glsl.radiance_fragment.replace("SUM",
    "  light = texel_scatter_source(at).rgb;").replace(/uniform vec3 u_weights.*\n/, "");
  for (let count = 1; count <= most; count++) {
    V.glsl[`radiance_${count}`] = V.glsl.radiance_fragment.replace("SUM",
      last.slice(0, count).map((n, i) => `  light += u_weights[${i}] * texel_${n}(at).rgb;`)
        .join("\n"));
  }
  V.passes.push({
    name: "radiance", after: ["surface", "scatter_source", ...last],
    key: p => [p.texturing, p.scattering, V.diffusionProfile(p).weights].join(),
    targets: () => ({radiance: {...screen, size: V.screen()}}),
    draw: ctx => {
      const {weights} = V.diffusionProfile(ctx.p);
      const plain = !ctx.p.scattering;
      ctx.full(V.program(["full_vertex"], [plain ? "radiance_plain" : `radiance_${weights.length}`],
        {GAUSSIANS: weights.length}),
      {u_post: V.POWERS[ctx.p.texturing][1], u_weights: weights.flat()});
    },
    cost: p => ({taps: (2 + (p.scattering ? V.diffusionProfile(p).weights.length : 1)) * pixels(),
      bytes: 8 * pixels()}),
  });
};

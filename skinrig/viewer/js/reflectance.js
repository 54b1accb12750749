// Fitted reflectance (Weyrich et al. 2006): weights of tabulated basis BRDFs edited by surface traits,
// albedo edited by its traits, and the choice between fitted and analytic specular reflection.
Object.assign(V.defaults, {traits: {}, measured_translucency: false, lobe_slope_rms: 0});

V.profileName = p => p.measured_translucency && V.profiles.fitted ? "fitted" : "default";

V.shareCount = () => 4 * (V.scene.textures.lobe_shares?.layers ?? 0);

// Sum of the surface traits' products with the basis BRDFs, one number per BRDF.
V.traitPull = p => {
  const pull = new Float32Array(V.shareCount());
  const traits = V.scene.facts.surface_traits?.traits ?? {};
  for (const [name, amount] of Object.entries(p.traits)) {
    (traits[name]?.pull ?? []).forEach((one, k) => { pull[k] += Math.fround(amount) * one; });
  }
  return pull;
};

// Pad a matrix of K basis BRDFs to the number of channels; padding has no effect.
V.paddedGram = () => {
  const count = V.shareCount();
  const {gram, scale} = V.scene.facts.surface_traits ?? {gram: [], scale: []};
  const out = new Float32Array(count * count);
  for (let i = 0; i < count; i++) {
    out[count * i + i] = 1;
    for (let j = 0; i < scale.length && j < scale.length; j++) {
      out[count * i + j] = gram[scale.length * i + j];
    }
  }
  return {gram: out, scale: Float32Array.from({length: count}, (_, i) => scale[i] ?? 1)};
};

// Amounts of the layers of albedo traits: two per trait, for amounts below and above 0.
V.albedoAmounts = p => (V.scene.facts.albedo_traits?.layers ?? [])
  .map(({name, end}) => Math.max(0, end * (p.traits[name] ?? 0)));

V.start.push(() => {
  V.surface.keys.push(p => [p.measured_translucency, p.lobe_slope_rms].join());
  if (V.scene.facts.profile) V.profiles.fitted = V.scene.facts.profile;
  if (V.scene.textures.translucency) {
    V.surface.chunks.push("translucency_width");
    V.surface.width = "translucencyWidth";
  }
  const shares = V.scene.textures.lobe_shares;
  if (shares) {
    const {width, height, layers} = shares;
    const padded = V.paddedGram();
    const sweeps = V.scene.facts.surface_traits?.sweeps ?? 1;
    const active = p => Number(V.traitPull(p).some(one => one !== 0));
    V.passes.push({
      name: "surface_traits", after: [], key: p => V.traitPull(p).join(),
      targets: () => Object.fromEntries(Array.from({length: layers}, (_, i) => [
        `lobe_shares_${i}`, {format: "RGBA16F", size: [width, height], space: "uv"},
      ])),
      draw: ctx => ctx.full(V.program(["full_vertex"], ["lobe_share_pass"],
        {SHARE_COUNT: 4 * layers, SHARE_GROUPS: layers, SWEEPS: sweeps}), {
        u_gram: Array.from(padded.gram), u_scale: Array.from(padded.scale),
        u_pull: Array.from(V.traitPull(ctx.p)),
        u_active: active(ctx.p),
      }),
      cost: () => ({taps: layers * width * height, bytes: 8 * layers * width * height}),
    });
    V.surface.chunks.push("fitted_brdf");
    V.surface.specular.fitted = "fittedSpecular";
    V.surface.after.push("surface_traits");
  }
  const factors = V.scene.textures.albedo_traits;
  if (factors) {
    const {width, height, layers} = factors;
    V.passes.push({
      name: "albedo_traits", after: [], key: p => V.albedoAmounts(p).join(),
      targets: () => ({albedo_factor: {format: "RGBA16F", size: [width, height], space: "uv"}}),
      draw: ctx => ctx.full(V.program(["full_vertex"], ["albedo_trait_pass"],
        {TRAIT_LAYERS: layers}), {u_amounts: V.albedoAmounts(ctx.p)}),
      cost: p => ({
        taps: V.albedoAmounts(p).filter(amount => amount !== 0).length * width * height,
        bytes: 8 * width * height,
      }),
    });
  }
});

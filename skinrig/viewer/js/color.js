// Jimenez 2010: hemoglobin blended from small scale and bias maps, color from the table.
Object.assign(V.defaults, {melanin_gain: 1, hemoglobin_gain: 1});

// Weights of the rig's states in the order of the layers; the neutral has the rest to 1.
V.stateWeights = p => {
  const names = V.scene.facts.facial_color.states;
  const weights = names.map(name => p.weights[name] ?? 0);
  weights[0] = 1 - weights.slice(1).reduce((a, b) => a + b, 0);
  return weights;
};
V.weighted = weights => [...weights.keys()].filter(i => weights[i] !== 0);
V.stateGain = p => {
  const gains = V.scene.facts.facial_color.gains;
  return 1 + Object.entries(gains).reduce((sum, [n, g]) => sum + (p.weights[n] ?? 0) * (g - 1), 0);
};
V.colorDefines = () => {
  const {c_m_max, c_hd_max} = V.scene.facts.color_table;
  return {C_M_MAX: c_m_max.toFixed(6), C_HD_MAX: c_hd_max.toFixed(6),
    TABLE_SIZE: V.scene.tables.skin_color.shape[0].toFixed(1)};
};
V.colorKey = p => [p.person, p.melanin_gain, p.hemoglobin_gain].join();

V.start.push(() => {
  if (V.scene.textures.facial_states) {
    const {width, height, layers} = V.scene.textures.facial_states;
    V.passes.push({
      name: "hemoglobin_rig", after: [],
      key: p => [p.person, ...V.stateWeights(p), V.stateGain(p)].join(),
      targets: () => ({hemoglobin_rig: {format: "RGBA32F", size: [width, height], space: "uv"}}),
      draw: ctx => {
        const weights = V.stateWeights(ctx.p);
        const drawn = V.weighted(weights);
        const filled = values => [...values, ...Array(layers - values.length).fill(0)];
        ctx.full(V.program(["full_vertex"], ["hemoglobin_rig_fragment"], {STATES: layers}), {
          u_weights: filled(drawn.map(i => weights[i])), u_layers: filled(drawn), u_count: drawn.length,
          u_gain: V.stateGain(ctx.p)});
      },
      cost: p => ({taps: (V.weighted(V.stateWeights(p)).length + 1) * width * height, bytes: 16 * width * height}),
    });
  }
  const {width, height} = V.scene.textures.chromophores;
  V.passes.push({
    name: "color_uv", after: ["hemoglobin_rig", "albedo_traits"], demanded: true, key: V.colorKey,
    targets: () => ({
      chromophores: {format: "RGBA32F", size: [width, height], space: "uv"},
      color: {format: "RGBA32F", size: [width, height], space: "uv"},
    }),
    draw: ctx => ctx.full(V.program(["full_vertex"],
      ["uv_varying", "skin_color", "color_uv_fragment"], V.colorDefines())),
    cost: () => ({taps: 6 * width * height, bytes: 32 * width * height}),
  });
});

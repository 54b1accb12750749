// Contents of the panel.
V.has = (...names) => names.every(name => name in V.params);
V.only = (...values) => values.filter(Boolean);

V.BUFFERS = {
  display: "Final image", radiance: "Radiance before tone mapping", irradiance: "Irradiance; depth in alpha",
  albedo: "Albedo", specular: "Specular reflection", normal: "Normals", inspect: "Texture coordinates, melanin",
  hemoglobin_rig: "Hemoglobin: scale, bias", chromophores: "Melanosome and blood volume fractions", color: "Skin color",
  scatter_source: "Irradiance before scattering", relief: "Surface topography", albedo_factor: "Albedo factor of the traits",
};
V.bufferLabel = name => {
  const blur = /^scatter_(\d+)_([xy])$/.exec(name);
  if (blur) return `Scattering: Gaussian ${Number(blur[1]) + 1} along ${blur[2]}`;
  const shares = /^lobe_shares_(\d+)$/.exec(name);
  if (shares) return `Basis BRDF weights ${4 * shares[1] + 1} to ${4 * shares[1] + 4}`;
  return V.BUFFERS[name] ?? V.capital(V.words(name));
};

// Display range of a buffer: 2nd to 98th percentile over non-empty pixels.
V.rangeOf = name => {
  if (name === "display") return {view_low: 0, view_high: 1};
  const {values, channels} = V.readNow(name);
  const kept = [];
  const step = Math.max(1, Math.floor(values.length / channels / 20000)) * channels;
  for (let i = 0; i < values.length; i += step) {
    for (let c = 0; c < Math.min(channels, 3); c++) {
      const value = values[i + c];
      if (value !== 0 && Number.isFinite(value)) kept.push(value);
    }
  }
  if (!kept.length) return {view_low: 0, view_high: 1};
  kept.sort((a, b) => a - b);
  const low = kept[Math.floor(0.02 * (kept.length - 1))];
  const high = kept[Math.ceil(0.98 * (kept.length - 1))];
  return {view_low: low < 0 ? low : 0, view_high: high > low ? high : low + 1};
};

V.weightNames = () => [...new Set([...Object.keys(V.scene.mesh.shapes), ...Object.keys(V.params.weights)])];
V.globalStates = () => V.scene.facts.facial_color?.global_states ?? [];

V.registerView = () => V.controls.push(
  {group: "view", kind: "choice", path: ["view"], label: "Buffer",
    help: "Values are scaled from black (minimum) to white (maximum).",
    options: () => V.bufferNames(V.params).map(name => [name, V.bufferLabel(name)])
      .sort(([a], [b]) => (b === "display") - (a === "display")),
    change: name => ({view: name, ...V.rangeOf(name)})},
  {group: "view", kind: "own", build: V.buildComparison},
);

V.registerPeople = () => {
  const people = V.scene.facts.people ?? [];
  if (people.length < 2) return;
  V.controls.push(
    {group: "people", kind: "choice", path: ["person"], label: "Person",
      options: () => people.map((name, i) => [i, `Phototype ${name}`]), off: p => p.gallery && p.heads > 1},
    {group: "people", kind: "own", build: box => {
      const all = V.element("button", {type: "button", "aria-pressed": "false"}, "Side by side");
      all.onclick = () => {
        const on = !(V.params.gallery && V.params.heads > 1);
        V.set(on ? {gallery: 1, person: (people.length - 1) >> 1, heads: people.length, ...V.framed(people.length)}
          : {gallery: 0, person: 0, heads: 1, camera_distance_mm: V.initial.camera_distance_mm});
        V.announce(on ? `Phototypes ${people.join(", ")} side by side` : "One person");
      };
      box.append(V.element("div", {className: "buttons"}, all));
      return p => all.setAttribute("aria-pressed", String(p.gallery > 0.5 && p.heads > 1));
    }},
  );
};

V.registerSize = () => V.controls.push(
  {group: "cost", kind: "choice", path: ["heads"], label: "Heads",
    help: "Jimenez et al. (2010) measure speed with five heads.",
    options: () => [[1, "One"], [2, "Two"], [3, "Three"], [5, "Five"]],
    change: heads => ({heads, ...V.framed(heads)})},
  {group: "cost", kind: "toggle", path: ["crowd"], label: "An expression for each head", off: p => p.heads < 2,
    help: "The middle head follows the controls. The other heads add one expression each."},
  {group: "cost", kind: "choice", path: ["resolution"], label: "Resolution",
    help: "Automatic: fewer pixels without a graphics processor.",
    options: () => [[0, "Automatic"], [256, "256 pixels"], [384, "384 pixels"], [512, "512 pixels"],
      [768, "768 pixels"], [1024, "1024 pixels"]]},
);

V.registerExpression = () => {
  V.controls.push({group: "expression", kind: "own", build: V.buildPresets},
    {group: "expression", kind: "own", build: V.buildTimeline, when: () => V.timelineKeys().length > 1});
  for (const name of V.weightNames().filter(one => !V.globalStates().includes(one))) {
    V.controls.push({group: "expression", kind: "range", path: ["weights", name], min: 0, max: 1.5,
      label: V.capital(V.words(name)), show: V.percent});
  }
};

V.registerBlood = () => {
  const why = {exercise: "Vasodilation of the whole face, strongest on the cheeks.",
    alcohol: "Vasodilation of the whole face, strongest on nose and cheeks."};
  for (const name of V.globalStates()) {
    V.controls.push({group: "blood", kind: "range", path: ["weights", name], min: 0, max: 1.5,
      label: V.capital(V.words(name)), show: V.percent, help: why[name]});
  }
  V.controls.push(
    {group: "blood", kind: "range", path: ["hemoglobin_gain"], min: 0, max: 3, zero: 1, label: "Blood volume fraction",
      show: v => `× ${v.toFixed(2)}`, help: "Factor on the blood volume fraction of the whole face."},
    {group: "blood", kind: "range", path: ["melanin_gain"], min: 0, max: 4, zero: 1, label: "Melanosome volume fraction",
      show: v => `× ${v.toFixed(2)}`, help: "Factor on the melanosome volume fraction of the whole face."},
  );
};

V.registerReflection = () => {
  const fitted = () => Boolean(V.surface.specular.fitted);
  const fit = V.scene.facts.reflectance;
  const error = fit ? ` The table of ${fit.lobes} basis BRDFs has an RMS error of ` +
    `${(100 * fit.rms_error).toFixed(2)} % (${Math.round(fit.table_bytes / 1024)} KB, ${fit.lookups} look-ups).` : "";
  const origin = fit?.origin === "population" ? "the mean basis BRDFs of simulated people"
    : "the basis BRDFs fitted to this face";
  V.controls.push(
    {group: "reflection", kind: "choice", path: ["specular_model"], label: "Specular model", when: fitted,
      help: `The formula of Kelemen and Szirmay-Kalos, or ${origin}.${error}`,
      options: () => [["analytic", "Analytic (Kelemen, Szirmay-Kalos)"], ["fitted", "Fitted basis BRDFs (Weyrich)"]]},
    {group: "reflection", kind: "range", path: ["roughness"], min: 0.3, max: 2.5, zero: 1, label: "Roughness",
      show: v => `× ${v.toFixed(2)}`, off: p => p.specular_model !== "analytic",
      help: "Factor on the roughness map (analytic model only)."},
    {group: "reflection", kind: "range", path: ["lobe_slope_rms"], min: 0, max: 0.5, step: 0.005, when: fitted,
      label: "RMS of unresolved slopes", show: v => v.toFixed(3), off: p => p.specular_model !== "fitted",
      help: "Fitted basis BRDFs are averaged over these slopes."},
    {group: "reflection", kind: "range", path: ["specular_intensity"], min: 0, max: 3, zero: 1, label: "Intensity",
      show: v => `× ${v.toFixed(2)}`, help: "Factor on the intensity map."},
    {group: "reflection", kind: "range", path: ["f0"], min: 0, max: 0.1, step: 0.001, zero: 0.028,
      label: "Reflectance at normal incidence", show: v => v.toFixed(3),
      off: p => p.specular_model !== "analytic", help: "Skin: 0.028 (refractive index 1.4)."},
  );
};

V.registerScattering = () => {
  const profile = V.scene.facts.profile;
  const edge = profile ? (100 * Math.max(...profile.edge_error)).toFixed(2) : "";
  V.controls.push(
    {group: "scattering", kind: "toggle", path: ["scattering"], label: "Subsurface scattering",
      help: "Screen-space sum of Gaussians; widths follow depth and slope."},
    {group: "scattering", kind: "range", path: ["scattering_scale"], min: 0, max: 3, zero: 1, label: "Width",
      show: v => `× ${v.toFixed(2)}`, off: p => !p.scattering, help: "Factor on all widths."},
    {group: "scattering", kind: "toggle", path: ["measured_translucency"], label: "Diffuse mean free path of this face",
      when: () => Boolean(profile), off: p => !p.scattering,
      help: profile ? `Widths from 1/σtr: ${profile.origin}. The edge response of the Gaussians is within ` +
        `${edge} % of the dipole.` : ""},
    {group: "scattering", kind: "choice", path: ["texturing"], label: "Texturing", off: p => !p.scattering,
      help: "A measured color map already contains scattering. Post-scatter texturing does not blur it twice.",
      options: () => [["post", "Post-scatter: color after the blur"], ["pre", "Pre-scatter: color before the blur"],
        ["both", "Half before, half after"]]},
  );
};

V.registerTraits = () => {
  const surface = V.scene.facts.surface_traits?.traits ?? {};
  const albedo = V.scene.facts.albedo_traits?.traits ?? {};
  for (const name of Object.keys(V.scene.params.traits ?? {})) {
    const errors = V.only(
      surface[name] && `surface error: ${surface[name].held_error.map(V.percent).join(" (less), ")} (more)`,
      albedo[name] && `albedo error: ${(100 * albedo[name].between_error).toFixed(1)} % of R_d at half strength`,
    );
    V.controls.push({group: "traits", kind: "range", path: ["traits", name], min: -1, max: 1,
      label: V.capital(name), show: V.signed, help: V.capital(errors.join("; ")) + ".",
      off: p => !albedo[name] && p.specular_model !== "fitted"});
  }
  if (Object.keys(surface).length) {
    V.controls.push({group: "traits", kind: "own", build: box => {
      const use = V.element("button", {type: "button"}, "Use fitted basis BRDFs");
      use.onclick = () => { V.set({specular_model: "fitted"}); V.announce("Specular model: fitted basis BRDFs"); };
      box.append(V.element("p", {className: "help"},
        "Surface traits change the fitted basis BRDFs only."),
      V.element("div", {className: "buttons"}, use));
      return p => { box.hidden = p.specular_model === "fitted"; };
    }});
  }
};

V.registerRelief = () => V.controls.push(
  {group: "relief", kind: "range", path: ["relief"], min: 0, max: 2, zero: 1, label: "Neutral pores and lines",
    show: v => `× ${v.toFixed(2)}`, help: "Factor on the slopes of the static surface topography."},
  {group: "relief", kind: "range", path: ["wrinkles"], min: 0, max: 2, zero: 1, label: "Wrinkles",
    show: v => `× ${v.toFixed(2)}`, when: () => Boolean(V.scene.facts.wrinkles),
    help: "Eight zones; each weight is the sum over expressions."},
  {group: "relief", kind: "choice", path: ["wrinkle_clamp"], label: "Weights of the zones",
    when: () => Boolean(V.scene.facts.wrinkles),
    options: () => [["unit", "Clamped to 0 to 1"], ["signed", "Clamped to −1 to 1; negative weights smooth the skin"]]},
  {group: "relief", kind: "toggle", path: ["hybrid_normals"], label: "Hybrid normals",
    help: "Diffuse normals are blurred per color by its scattering; specular normals are not."},
  {group: "relief", kind: "choice", path: ["microstructure"], label: "Microstructure",
    help: "Surface topography at ten micrometers; strain sharpens or blurs it. Visible at close range.",
    options: () => [[0, "None (mesostructure)"], [1, "Static"], [2, "Dynamic: follows the strain"],
      [3, "Side by side: none, static, dynamic"]]},
  {group: "relief", kind: "choice", path: ["microstructure_sampling"], label: "Sampling of the convolution",
    options: () => [[0, "Bilinear"], [1, "Cubic"]]},
  {group: "relief", kind: "toggle", path: ["detail"], label: "Level of detail",
    help: "At a distance, wrinkles and microstructure without visible effect are omitted."},
);

V.registerLight = () => V.controls.push(
  {group: "light", kind: "own", build: V.buildLightings},
  {group: "light", kind: "range", path: ["light_azimuth_deg"], min: -180, max: 180, step: 1,
    label: "Light azimuth", show: V.degrees, help: "Also by dragging with the tool Light."},
  {group: "light", kind: "range", path: ["light_elevation_deg"], min: -89, max: 89, step: 1,
    label: "Light elevation", show: V.degrees},
  {group: "light", kind: "range", path: ["light_intensity"], min: 0, max: 10, step: 0.1, label: "Light intensity"},
  {group: "light", kind: "range", path: ["fill"], min: 0, max: 1, label: "Fill light", show: V.percent,
    help: "Fraction of the key light, from its other side."},
  {group: "light", kind: "range", path: ["rim"], min: 0, max: 2, label: "Rim light", show: V.percent,
    help: "Fraction of the key light, from behind."},
  {group: "light", kind: "choice", path: ["environment"], label: "Environment",
    help: "Light from all directions, by spherical harmonics up to band 2; without shadows.",
    options: () => [["none", "None"], ["overcast", "Overcast sky"], ["window", "Room with a window"],
      ["uniform", "Integrating sphere"]]},
  {group: "light", kind: "range", path: ["environment_intensity"], min: 0, max: 3, zero: 1, label: "Environment intensity",
    off: p => p.environment === "none", help: "Irradiance over π of the brightest direction, at most."},
  {group: "light", kind: "range", path: ["environment_azimuth_deg"], min: -180, max: 180, step: 1,
    label: "Environment rotation", show: V.degrees, off: p => p.environment === "none"},
  {group: "light", kind: "toggle", path: ["shadows"], label: "Shadows",
    help: "Shadows of the head on itself from the key light, from one depth map."},
  {group: "light", kind: "range", path: ["shadow_softness_mm"], min: 0, max: 8, step: 0.1, label: "Shadow softness",
    zero: 0, show: v => `${v.toFixed(1)} mm`, off: p => !p.shadows},
  {group: "light", kind: "range", path: ["ambient"], min: 0, max: 1, label: "Ambient light"},
  {group: "light", kind: "range", path: ["camera_distance_mm"], min: 45, max: V.FARTHEST_MM, step: 5, label: "Camera distance",
    show: v => `${Math.round(v)} mm`, help: "Also by wheel, pinch, + and −."},
  {group: "light", kind: "range", path: ["exposure"], min: 0.1, max: 4, zero: 1, label: "Exposure",
    show: v => `× ${v.toFixed(2)}`},
  {group: "light", kind: "toggle", path: ["filmic"], label: "Filmic tone map",
    help: "Off: linear sRGB, clipped at white."},
);

V.buildPresets = box => {
  const buttons = V.element("div", {className: "buttons", role: "group", "aria-label": "Presets"});
  const same = (p, weights) => V.weightNames().every(name => (p.weights[name] ?? 0) === (weights[name] ?? 0));
  const made = Object.entries(V.presetsInOrder()).map(([name, preset]) => {
    const button = V.element("button", {type: "button", "aria-pressed": "false"}, V.capital(name));
    button.onclick = () => {
      const weights = Object.fromEntries(V.weightNames().map(one => [one, preset.weights?.[one] ?? 0]));
      V.playing = false;
      V.set({...preset, weights});
      V.announce(`Expression: ${name}`);
    };
    buttons.append(button);
    return [button, preset.weights ?? {}];
  });
  box.append(buttons);
  return p => made.forEach(([button, weights]) => button.setAttribute("aria-pressed", same(p, weights)));
};
// Lights of the whole scene, one button each.
V.LIGHTINGS = {
  "Key light": {light_intensity: 3.2, ambient: 0.12, fill: 0, rim: 0, environment: "none"},
  "Three-point": {light_intensity: 2.2, ambient: 0.12, fill: 0.3, rim: 0.3, environment: "none"},
  "Overcast sky": {light_intensity: 0, ambient: 0, fill: 0, rim: 0, environment: "overcast", environment_intensity: 2.4},
  "Room with a window": {light_intensity: 0, ambient: 0, fill: 0, rim: 0, environment: "window", environment_intensity: 2.4},
};
V.buildLightings = box => {
  const buttons = V.element("div", {className: "buttons", role: "group", "aria-label": "Lightings"});
  const made = Object.entries(V.LIGHTINGS).map(([name, lighting]) => {
    const button = V.element("button", {type: "button", "aria-pressed": "false"}, name);
    button.onclick = () => { V.set(lighting); V.announce(`Light: ${name}`); };
    buttons.append(button);
    return [button, lighting];
  });
  box.append(buttons);
  return p => made.forEach(([button, lighting]) => button.setAttribute("aria-pressed",
    Object.entries(lighting).every(([key, value]) => p[key] === value)));
};

// Presets are packed without order; the neutral face is listed first.
V.presetsInOrder = () => {
  const order = ["neutral", "happiness", "sadness", "surprise", "fear", "anger", "disgust", "smile", "sad smile",
    "anger and surprise", "exercise", "after exercise", "alcohol"];
  const rank = name => (order.indexOf(name) + 1 || order.length + 1);
  return Object.fromEntries(Object.entries(V.scene.presets ?? {}).sort(([a], [b]) => rank(a) - rank(b)));
};

V.describeSource = () => {
  const {provenance = {}, facts, left_out: leftOut = [], added = []} = V.scene;
  const title = provenance.title ?? (provenance.kind === "procedural"
    ? `Simulated head, phototype ${provenance.preset}` : (provenance.appearances ?? ["Face"]).join(", "));
  document.title = `${title} — skin viewer`;
  document.getElementById("title").textContent = title;
  document.getElementById("source").textContent = provenance.source ?? "";
  V.controls.push({group: "about", kind: "own", build: box => {
    const list = V.element("ul", {className: "facts"});
    const add = (name, text) => list.append(V.element("li", {}, V.element("b", {}, `${name}: `), text));
    for (const [name, value] of Object.entries(provenance)) {
      add(V.capital(V.words(name)), [].concat(value).map(one =>
        typeof one === "object" ? JSON.stringify(one) : String(one)).join(", "));
    }
    if (facts.albedo_color) add("Color of R_d", facts.albedo_color);
    const vertices = V.scene.mesh.positions.length / 3;
    if (V.scene.page === "head") add("Geometry", `${vertices} vertices, ${V.scene.mesh.faces.length / 3} triangles, ` +
      `${Object.keys(V.scene.mesh.shapes).length} blend shapes`);
    const errors = Object.entries(V.scene.quantization_error ?? {}).filter(([name]) => !name.startsWith("shape "));
    if (errors.length) {
      add("Largest quantization error of the maps", errors.map(([name, error]) =>
        `${V.words(name)} ${V.plain(error)}`).join(", "));
    }
    if (facts.reflectance) {
      add("Fitted basis BRDFs", `table of ${facts.reflectance.slabs} slabs, RMS error ` +
        `${(100 * facts.reflectance.rms_error).toFixed(3)} %, 95th percentile of strong values ` +
        `${(100 * facts.reflectance.strong_error).toFixed(3)} %`);
    }
    added.forEach(([what, how]) => add(`Not measured: ${what}`, how));
    leftOut.forEach(([what, why]) => add(`Omitted: ${what}`, why));
    box.append(list);
  }});
};
V.describeScene = () => {
  V.describeSource();
  [V.registerView, V.registerPeople, V.registerExpression, V.registerBlood, V.registerReflection, V.registerScattering,
    V.registerTraits, V.registerRelief, V.registerLight, V.registerSize].forEach(register => register());
};

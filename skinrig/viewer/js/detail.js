// Level of detail: wrinkles and microstructure are omitted where a bound proves their visible effect
// small; the variance of their slopes remains in the roughness.
//
// A pixel shows the mean slope over its footprint. The RMS of this mean over the face is tabulated by
// size of footprint, for each zone of each wrinkle map and for the microstructure (facts: slope_rms by
// level). The derivative of the reflection by a slope is maximized below over all normals that face the
// camera under this light. This maximum times the slopes' RMS bounds, to first order, the RMS error of
// omitting them, in radiance where 1 is a white surface. V.detail.state has this error; if it is below
// the tolerance, they are omitted.
Object.assign(V.defaults, {detail: 1, detail_tolerance: 2 / 255});
V.detail = {ALBEDO: 0.8, NORMALS: 400, state: {}, found: new Map(), near: new Map()};
V.statistics.detail = V.detail.state;

// The same for all lights. Fill and rim light reach part of the face: their derivatives are RMS over the
// visible normals of a ball, by projected area, in place of the maximum. The environment adds its diffuse part.
V.detail.sensitivity = p => {
  const key = V.detail.sensitivityOf(p);
  const sum = {...key};
  for (const {to: [x, y, z], intensity} of V.furtherLights(p)) {
    if (!(intensity > 0)) continue;
    const one = V.detail.sensitivityOf({...p, light_intensity: intensity,
      light_azimuth_deg: Math.atan2(x, z) / V.RAD, light_elevation_deg: Math.asin(y) / V.RAD});
    sum.diffuse += one.diffuseRms;
    sum.specular += one.specularRms;
  }
  // irradiance over pi is at most the intensity, and falls off no faster than a cosine
  if (V.surrounded(p)) sum.diffuse += p.environment_intensity * V.detail.ALBEDO;
  return sum;
};

// Maximum derivative of diffuse and specular radiance by a slope, over normals and directions, for one light.
V.detail.sensitivityOf = p => {
  const key = [p.light_azimuth_deg, p.light_elevation_deg, p.light_intensity, p.roughness,
    p.specular_intensity, p.f0, p.camera_yaw_deg, p.camera_pitch_deg].join();
  const known = V.detail.found.get(key);
  if (known) return known;
  const l = V.direction(p.light_azimuth_deg, p.light_elevation_deg);
  const v = V.direction(p.camera_yaw_deg, p.camera_pitch_deg);
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const unit = a => { const n = Math.hypot(...a); return a.map(c => c / n); };
  const whole = l.map((c, i) => c + v[i]);
  const h = unit(whole);
  const fresnel = p.f0 + (1 - p.f0) * (1 - dot(v, h)) ** 5;
  const maps = V.scene.textures.surface_maps;
  const m2 = (p.roughness * (maps ? maps.low[0] : 1)) ** 2;
  const strength = Math.PI * p.light_intensity * p.specular_intensity * fresnel
    / Math.max(dot(whole, whole), 1e-3);
  const specular = n => {
    const c2 = Math.max(dot(n, h), 1e-3) ** 2;
    return strength * Math.max(dot(n, l), 0) * Math.exp((c2 - 1) / (c2 * m2))
      / (Math.PI * m2 * c2 * c2);
  };
  let [largest, squares, lit, seen] = [0, 0, 0, 0];
  for (let i = 0; i < V.detail.NORMALS; i++) {
    const y = 1 - (2 * i + 1) / V.detail.NORMALS;
    const turn = i * Math.PI * (3 - Math.sqrt(5));
    const n = [Math.sqrt(1 - y * y) * Math.cos(turn), y, Math.sqrt(1 - y * y) * Math.sin(turn)];
    if (dot(n, v) <= 0) continue;
    const t = unit(Math.abs(n[1]) < 0.9 ? [n[2], 0, -n[0]] : [0, n[2], -n[1]]);
    const b = [n[1] * t[2] - n[2] * t[1], n[2] * t[0] - n[0] * t[2], n[0] * t[1] - n[1] * t[0]];
    const step = 1e-3;
    const change = axis => (specular(unit(n.map((c, j) => c + step * axis[j])))
      - specular(unit(n.map((c, j) => c - step * axis[j])))) / (2 * step);
    const found = Math.hypot(change(t), change(b));
    largest = Math.max(largest, found);
    squares += dot(n, v) * found ** 2;
    lit += dot(n, v) * (dot(n, l) > 0);
    seen += dot(n, v);
  }
  // the derivative of a cosine is at most 1
  if (V.detail.found.size > 8) V.detail.found.clear();
  const diffuse = p.light_intensity * V.detail.ALBEDO;
  const found = {diffuse, specular: largest, diffuseRms: diffuse * Math.sqrt(lit / seen),
    specularRms: Math.sqrt(squares / seen)};
  V.detail.found.set(key, found);
  return found;
};

// Interpolate a list by level, linearly in the logarithm, as its entries decrease geometrically.
V.detail.between = (list, level) => {
  const at = Math.min(Math.max(level, 0), list.length - 1);
  const first = Math.floor(at);
  const next = Math.min(first + 1, list.length - 1);
  const log = value => Math.log(Math.max(value, 1e-12));
  const inside = Math.exp(log(list[first]) + (at - first) * (log(list[next]) - log(list[first])));
  return level > list.length - 1 ? inside * 0.5 ** (level - list.length + 1) : inside;
};

// Size of a canvas pixel at the nearest point of the heads, mm.
V.detail.footprint = p => {
  const key = [V.meshKey(p), V.screen()].join();
  if (V.detail.near.has(key)) return V.detail.near.get(key);
  const positions = V.morph(p.weights);
  let depth = Infinity;
  let scale = 1;
  for (const shift of V.headShifts(p)) {
    const camera = V.camera(p, V.screen(), shift);
    scale = camera.pixelsPerMmAt1;
    const [x, y, z, w] = [2, 6, 10, 14].map(i => camera.view[i]);
    for (let i = 0; i < positions.length; i += 3) {
      const d = -(x * positions[i] + y * positions[i + 1] + z * positions[i + 2] + w);
      if (d > 1 && d < depth) depth = d;
    }
  }
  if (V.detail.near.size > 8) V.detail.near.clear();
  V.detail.near.set(key, depth / scale);
  return depth / scale;
};

// RMS change of radiance by omitting the microstructure, by pixel size. Its slopes are isotropic: the
// variance along one direction is half of the sum of both.
V.detail.microstructureError = (p, mm) => {
  const {slope_rms, pixel_um} = V.scene.facts.microstructure;
  const level = Math.log2(1e3 * mm / pixel_um);
  return Math.SQRT1_2 * V.detail.sensitivity(p).specular * V.detail.between(slope_rms, level);
};

// Zones may overlap: the sum over zones bounds their joint effect.
V.detail.wrinkleError = (p, mm) => {
  const side = V.scene.textures.wrinkle_maps.width;
  const texel = V.wrinkles.HYBRID_PX / V.wrinkles.texelsPerMm() / side;
  const {diffuse, specular} = V.detail.sensitivity(p);
  const strengths = V.wrinkles.zones(p);
  const slope = V.scene.facts.wrinkles.slope_rms.reduce((sum, levels, zone) =>
    sum + Math.abs(strengths[zone]) * V.detail.between(levels, Math.log2(mm / texel)), 0);
  return (diffuse + specular) * p.wrinkles * slope;
};

V.start.push(() => {
  if (!V.scene.textures.wrinkle_maps || !V.scene.facts.wrinkles) return;
  const drawGraph = V.drawGraph;
  V.drawGraph = (side, p, demand) => {
    const mm = V.detail.footprint(p);
    const error = V.detail.wrinkleError(p, mm);
    const left = p.detail > 0.5 && p.specular_model === "analytic" && error < p.detail_tolerance;
    p.detail_wrinkles = left ? 0 : 1;
    V.detail.state.wrinkles = {pixel_mm: mm, error, left_out: left};
    drawGraph(side, p, demand);
  };
});

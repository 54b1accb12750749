// Light in addition to the key light: a fill and a rim light, which follow the key light, and an environment.
//
// The environment is a radiance in closed form, projected on spherical harmonics up to band 2
// (Ramamoorthi and Hanrahan 2001). Its diffuse part is exact to 1.1 % of the largest irradiance for the
// radiances below; the highlight is the environment blurred by the lobe, times the lobe's directional
// albedo, which is tabulated. Fill and rim light are shadowed by a ball around the head alone, the environment by nothing.
Object.assign(V.defaults, {
  fill: 0, rim: 0, environment: "none", environment_intensity: 1, environment_azimuth_deg: 0,
});
V.FILL = {azimuth: -80, elevation: 8};  // degrees from the key light; elevation from the horizon
V.RIM = {azimuth: 185, elevation: 20};

// Further directional lights: intensity is a fraction of the key light's.
V.furtherLights = p => [["fill", V.FILL], ["rim", V.RIM]].map(([name, place]) => ({
  to: V.direction(p.light_azimuth_deg + place.azimuth, place.elevation),
  intensity: p[name] * p.light_intensity,
}));

// Radiance by direction, linear sRGB; irradiance over pi is at most 1.
//   uniform    an integrating sphere
//   overcast   sky of Moon and Spencer 1942, (1 + 2 sin(elevation)) / 3, above ground of albedo 0.2
//   window     a dim room of warm walls, with a soft bright window to the right of the face
const OVERCAST_ZENITH = 9 / 7; // makes the horizontal irradiance over pi 1
V.ENVIRONMENTS = {
  none: () => [0, 0, 0],
  uniform: () => [1, 1, 1],
  overcast: ([, y]) => Array(3).fill(y > 0 ? OVERCAST_ZENITH * (1 + 2 * y) / 3 : 0.2),
  window: ([x, y, z]) => {
    const toward = Math.exp(6 * (0.8 * x + 0.25 * y + 0.545 * z - 1));
    return [0.12 + 2.1 * toward, 0.11 + 2.2 * toward, 0.1 + 2.4 * toward];
  },
};
V.surrounded = p => Object.hasOwn(V.ENVIRONMENTS, p.environment) && p.environment !== "none";
V.harmonics = ([x, y, z]) => [
  0.2820948, 0.4886025 * y, 0.4886025 * z, 0.4886025 * x, 1.0925484 * x * y, 1.0925484 * y * z,
  0.3153916 * (3 * z * z - 1), 1.0925484 * x * z, 0.5462742 * (x * x - y * y),
];

// Directions of equal solid angle (Fibonacci lattice).
V.lattice = count => Array.from({length: count}, (_, i) => {
  const z = 1 - (2 * i + 1) / count;
  const turn = i * Math.PI * (3 - Math.sqrt(5));
  const r = Math.sqrt(1 - z * z);
  return [r * Math.cos(turn), r * Math.sin(turn), z];
});

V.environmentCache = new Map();
V.environmentHarmonics = p => {
  const key = [p.environment, p.environment_azimuth_deg, p.environment_intensity].join();
  if (V.environmentCache.has(key)) return V.environmentCache.get(key);
  const out = new Array(27).fill(0);
  if (!V.surrounded(p)) return out;
  const turn = p.environment_azimuth_deg * V.RAD;
  const [cos, sin] = [Math.cos(turn), Math.sin(turn)];
  const places = V.lattice(4000);
  for (const [x, y, z] of places) {
    const light = V.ENVIRONMENTS[p.environment]([cos * x - sin * z, y, sin * x + cos * z]);
    V.harmonics([x, y, z]).forEach((basis, k) => light.forEach((one, c) => {
      out[3 * k + c] += p.environment_intensity * one * basis * 4 * Math.PI / places.length;
    }));
  }
  V.environmentCache.clear();
  V.environmentCache.set(key, out);
  return out;
};

V.lightsKey = p => [p.light_azimuth_deg, p.light_elevation_deg, p.light_intensity, p.fill, p.rim, p.environment,
  p.environment_intensity, p.environment_azimuth_deg].join();

// Programs are built for the lights that shine: a software renderer computes both sides of each branch.
V.shiningLights = p => V.furtherLights(p).filter(one => one.intensity > 0);
V.lightDefines = p => ({FURTHER: V.shiningLights(p).length, SURROUNDED: Number(V.surrounded(p)),
  SHADOWED: Number(V.shadowed(p))});
V.lightUniforms = p => {
  const shining = V.shiningLights(p);
  const further = shining.length ? shining : V.furtherLights(p).slice(0, 1);
  return {
    u_to_light: V.direction(p.light_azimuth_deg, p.light_elevation_deg),
    u_further_to: further.flatMap(one => one.to),
    u_further_intensity: further.map(one => one.intensity),
    u_environment: V.environmentHarmonics(p),
  };
};

// Directional albedo of the analytic highlight (kelemen_specular) without Fresnel's factor, and with that of
// Schlick: columns by cosine of the view, rows by roughness m; by sums over half vectors.
V.ENVIRONMENT_ROWS = 12;
V.ENVIRONMENT_COLUMNS = 24;
V.LEAST_TABLE_M = 0.08;
V.MOST_TABLE_M = 1;
V.highlightAlbedo = (cosine, m) => {
  const view = [Math.sqrt(1 - cosine * cosine), 0, cosine];
  const [rings, turns] = [40, 32];
  let [plain, grazing] = [0, 0];
  for (let i = 0; i < rings; i++) {
    // slopes of Beckmann's density: tan^2 = -m^2 ln(1 - u)
    const tan2 = -m * m * Math.log(1 - (i + 0.5) / rings);
    const cosH = 1 / Math.sqrt(1 + tan2);
    const sinH = Math.sqrt(1 - cosH * cosH);
    for (let j = 0; j < turns; j++) {
      const turn = 2 * Math.PI * (j + 0.5) / turns;
      const h = [sinH * Math.cos(turn), sinH * Math.sin(turn), cosH];
      const across = h[0] * view[0] + h[2] * view[2];
      const up = 2 * across * h[2] - view[2];
      if (across <= 0 || up <= 0) continue;
      // D cos(h) is sampled; D F / |l + v|^2, with |l + v| = 2 (v h), and dl = 4 (v h) dh
      const one = up / (across * cosH) / (rings * turns);
      plain += one;
      grazing += one * (1 - across) ** 5;
    }
  }
  return [plain - grazing, grazing];
};
V.start.push(() => {
  const [rows, columns] = [V.ENVIRONMENT_ROWS, V.ENVIRONMENT_COLUMNS];
  const data = new Float32Array(rows * columns * 2);
  for (let i = 0; i < rows; i++) {
    const m = V.LEAST_TABLE_M + (V.MOST_TABLE_M - V.LEAST_TABLE_M) * i / (rows - 1);
    for (let j = 0; j < columns; j++) data.set(V.highlightAlbedo(Math.max(j / (columns - 1), 0.02), m), 2 * (i * columns + j));
  }
  V.scene.tables.environment_brdf = {shape: [rows, columns, 2], data};
});

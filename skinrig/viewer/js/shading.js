// The shaded surface: irradiance, albedo and specular reflection in buffers of their own.
Object.assign(V.defaults, {
  roughness: 1, specular_intensity: 1, relief: 1, f0: 0.028, specular_model: "analytic",
});

// Hooks by which other scripts extend the surface:
//   chunks     GLSL pieces that hold the functions named below
//   defines    functions of p: preprocessor values
//   slopes     names of `vec2 f(vec2 uv)`: slopes of relief, summed
//   adjust     names of `void f(inout SurfacePoint s)`, called in order
//   specular   by value of p.specular_model: name of `vec3 f(SurfacePoint s)`, 1/sr
//   width      name of `float f(vec2 uv)`: width of scattering relative to the profile, or null
//   parts      functions that draw what is not skin, see V.drawHeads
//   after      passes whose buffers they read; key(p): what else they depend on
V.surface = {
  chunks: ["static_relief"], defines: [], slopes: [], adjust: [],
  specular: {analytic: "analyticSpecular"}, width: null, after: ["hemoglobin_rig", "albedo_traits"], keys: [], parts: [],
};

V.surfaceDefines = p => ({PI: "3.14159265358979", LEAST_TABLE_M: V.LEAST_TABLE_M.toFixed(4),
  MOST_TABLE_M: V.MOST_TABLE_M.toFixed(4), ...V.colorDefines(), ...V.lightDefines(p),
  ...Object.assign({}, ...V.surface.defines.map(f => f(p)))});

// Functions that combine the hooks.
V.surfaceJoin = p => {
  const name = "surface_join_" + p.specular_model;
  V.glsl[name] = [
    "vec2 surfaceSlope(vec2 uv) { return " +
      ["vec2(0.0)", ...V.surface.slopes.map(f => `${f}(uv)`)].join(" + ") + "; }",
    `void adjustSurface(inout SurfacePoint s) { ${V.surface.adjust.map(f => `${f}(s);`).join(" ")} }`,
    "vec3 analyticSpecular(SurfacePoint s) { return vec3(kelemenSpecular(s, s.specularNormal)); }",
    `float surfaceWidth(vec2 uv) { return ${V.surface.width ? V.surface.width + "(uv)" : "1.0"}; }`,
    `vec3 surfaceSpecular(SurfacePoint s) { return ${V.surface.specular[p.specular_model]}(s); }`,
  ].join("\n");
  return name;
};

// Positions of several heads: side by side, each slightly behind the previous one.
V.headShifts = p => Array.from({length: p.heads}, (_, i) => {
  const at = i - 0.5 * (p.heads - 1);
  return [185 * at, 0, -40 * Math.abs(at)];
});

// Camera distance at which all heads are visible.
V.FARTHEST_MM = 3000;
V.framed = heads => {
  const [width, height] = V.screen();
  const wide = 185 * (heads - 1) + 230;
  const away = Math.max(wide * height / width, 310) * 0.5 / Math.tan(0.5 * V.params.camera_fov_deg * V.RAD);
  return {camera_distance_mm: Math.min(5 * Math.round(away / 5), V.FARTHEST_MM)};
};

// Draw all heads, each with its parts that are not skin: functions (ctx, side, p, frame).
V.drawHeads = (ctx, program, uniforms, parts = []) => {
  V.headShifts(ctx.p).forEach((shift, i) => {
    const camera = V.camera(ctx.p, ctx.size, shift);
    const p = V.headParams(ctx.p, i);
    const side = V.headSide(ctx.side, ctx.p, i);
    const frame = {u_view: camera.view, u_projection: camera.projection, u_eye: camera.eye,
      ...V.lightFrame(side, p), ...uniforms};
    V.use(program, side, p, frame);
    V.drawMesh(side, p);
    parts.forEach(draw => draw(ctx, side, p, frame));
  });
};

V.meshKey = p => [V.moveKey(p), V.cameraKey(p), p.heads, p.crowd, p.gallery].join();
V.screen = () => [V.canvas.width, V.canvas.height];

V.start.push(() => {
  V.passes.push({
    name: "surface",
    get after() { return V.surface.after; },
    depth: true,
    key: p => [V.meshKey(p), V.colorKey(p), V.lightsKey(p), p.ambient, p.roughness, p.specular_intensity, p.relief, p.f0,
      p.specular_model, ...V.surface.keys.map(f => f(p))].join(),
    targets: () => ({
      irradiance: {format: "RGBA32F", size: V.screen(), space: "screen", filter: "nearest"},
      albedo: {format: "RGBA16F", size: V.screen(), space: "screen"},
      specular: {format: "RGBA16F", size: V.screen(), space: "screen"},
    }),
    draw: ctx => {
      ctx.clear(0, 0, 0, 0);
      const program = V.program(["mesh_attributes", "mesh_vertex"], ["surface_varyings",
        "surface_point", "skin_color", "kelemen_specular", "further_lights", "environment_light",
        "environment_highlight", "shadow_lookup", ...V.surface.chunks,
        V.surfaceJoin(ctx.p), "surface_fragment"], V.surfaceDefines(ctx.p));
      V.drawHeads(ctx, program, V.lightUniforms(ctx.p), V.surface.parts);
    },
    cost: p => ({taps: (8 + 25 * V.shadowed(p)) * V.screen()[0] * V.screen()[1], bytes: 32 * V.screen()[0] * V.screen()[1]}),
  });
  V.passes.push({
    name: "inspect", after: ["hemoglobin_rig", "albedo_traits"], depth: true, demanded: true,
    key: p => [V.meshKey(p), V.colorKey(p)].join(),
    targets: () => ({
      inspect: {format: "RGBA32F", size: V.screen(), space: "screen", filter: "nearest"},
      normal: {format: "RGBA32F", size: V.screen(), space: "screen", filter: "nearest"},
    }),
    draw: ctx => {
      ctx.clear(0, 0, 0, 0);
      V.drawHeads(ctx, V.program(["mesh_attributes", "mesh_vertex"],
        ["surface_varyings", "skin_color", "inspect_fragment"], V.colorDefines()), {},
      V.surface.parts.map(draw => (...of) => draw(...of, "eye_inspect_fragment")));
    },
    cost: () => ({taps: 6 * V.screen()[0] * V.screen()[1], bytes: 32 * V.screen()[0] * V.screen()[1]}),
  });
});

// An image with normals and color, lit by one light; it takes the place of the scripts of a head.
Object.assign(V.defaults, {
  heads: 1, picture_state: 0, picture_x: 0.5, picture_y: 0.5, picture_zoom: 1, picture_slopes: 1,
  picture_specular: 1, picture_roughness: 0.3, picture_aspect: 1,
});
V.screen = () => [V.canvas.width, V.canvas.height];
V.picture = () => V.scene.facts.picture;
V.NEAREST_ZOOM = 64;
V.SHARED.push("picture_x", "picture_y", "picture_zoom", "picture_aspect");

// One picture, whose passes no other head draws.
V.uploadMesh = V.buildScattering = V.drawCrowd = () => {};
V.ownPasses = () => new Set();

V.start.push(() => {
  V.params.picture_aspect = V.picture().aspect;
  const size = () => V.screen();
  const buffer = format => ({format, size: size(), space: "screen", filter: "nearest"});
  V.passes.push({
    name: "radiance", after: [],
    key: p => [p.picture_state, p.picture_x, p.picture_y, p.picture_zoom, p.picture_slopes, p.picture_specular,
      p.picture_roughness, p.light_azimuth_deg, p.light_elevation_deg, p.light_intensity, p.ambient].join(),
    targets: () => ({radiance: buffer("RGBA16F"), normal: buffer("RGBA16F"), albedo: buffer("RGBA16F"),
      ...(V.picture().layers ? {layers: buffer("RGBA32F")} : {})}),
    draw: ctx => ctx.full(V.program(["full_vertex"], ["picture_fragment"]), {
      u_light: V.direction(ctx.p.light_azimuth_deg, ctx.p.light_elevation_deg), u_aspect: size()[0] / size()[1],
    }),
    cost: () => ({taps: 3 * size()[0] * size()[1], bytes: 40 * size()[0] * size()[1]}),
  });
});

// Drag moves the picture, wheel and keys zoom, the tool Light turns the light.
V.TOOLS.orbit = "Drag or arrow keys: move the picture. Wheel, pinch, + and −: zoom.";
V.TOOLS.light = "Drag or arrow keys: move the light.";
V.TOOLS.probe = "Click, or arrow keys (Shift: ten pixels) and Enter: read the maps at a pixel.";
V.movePicture = (right, up) => V.set({
  picture_x: V.limit(V.params.picture_x - right, 0, 1), picture_y: V.limit(V.params.picture_y - up, 0, 1),
});
V.orbit = (right, down) => V.movePicture(right / 200 / V.params.picture_zoom, -down / 200 / V.params.picture_zoom);
V.turn = (right, up) => V.orbit(right, -up);
V.pan = (right, up) => V.movePicture(right / V.params.picture_zoom, up / V.params.picture_zoom);
V.zoom = factor => V.set({picture_zoom: V.limit(V.params.picture_zoom / factor, 1, V.NEAREST_ZOOM)});
V.speakPlace = () => V.announce(V.tool === "light"
  ? `Light ${Math.round(V.params.light_azimuth_deg)} degrees to the side, ${Math.round(V.params.light_elevation_deg)} up`
  : `Enlarged ${V.params.picture_zoom.toFixed(1)} times`);

V.readings = (x, y) => {
  const found = V.pixels(["normal", "albedo", "layers"], x, y);
  const {layers, color_map: color} = V.picture();
  if (!found.normal || found.normal[3] <= 0.5) return [];
  const rows = [["Normal", V.triple(found.normal)]];
  if (layers?.normal_stderr_deg) rows.push(["Its standard error", `${found.layers[1].toFixed(2)}°`]);
  if (color) rows.push([`${V.capital(color)}, white = 1`, V.triple(found.albedo)]);
  if (layers?.height_um) rows.push(["Height", `${found.layers[0].toFixed(1)} µm`]);
  return rows;
};

V.groups = [
  ["view", "View", "The picture under the light, or one map.", true],
  ["picture", "Picture", "State, relief and surface reflection.", true],
  ["light", "Light and tone", "One distant light, even light, and tone mapping.", true],
  ["cost", "Resolution and cost", "Texture reads, bytes and time per frame.", false],
  ["about", "About this picture", "Provenance, errors, and omitted parts.", false],
];
Object.assign(V.BUFFERS, {layers: "Height (red), standard error of normals (green)"});
V.registerPicture = () => {
  const {states} = V.picture();
  V.controls.push(
    {group: "picture", kind: "choice", path: ["picture_state"], label: "State", when: () => states.length > 1,
      options: () => states.map((name, i) => [i, name])},
    {group: "picture", kind: "range", path: ["picture_slopes"], min: 0, max: 8, step: 0.1, zero: 1, label: "Slopes",
      show: v => `× ${v.toFixed(1)}`, help: "Slopes of the surface times this factor."},
    {group: "picture", kind: "range", path: ["picture_specular"], min: 0, max: 4, zero: 1, label: "Surface reflection",
      show: v => `× ${v.toFixed(2)}`, help: "Of a surface with refractive index 1.4."},
    {group: "picture", kind: "range", path: ["picture_roughness"], min: 0.02, max: 1, label: "Roughness",
      help: "GGX alpha."},
    ...["light_azimuth_deg", "light_elevation_deg"].map((path, i) => ({group: "light", kind: "range", path: [path],
      min: i ? -89 : -180, max: i ? 89 : 180, step: 1, label: i ? "Light elevation" : "Light azimuth", show: V.degrees})),
    {group: "light", kind: "range", path: ["light_intensity"], min: 0, max: 10, step: 0.1, label: "Light intensity"},
    {group: "light", kind: "range", path: ["ambient"], min: 0, max: 1, label: "Ambient light"},
    {group: "light", kind: "range", path: ["exposure"], min: 0.1, max: 4, zero: 1, label: "Exposure",
      show: v => `× ${v.toFixed(2)}`},
    {group: "cost", kind: "choice", path: ["resolution"], label: "Resolution",
      options: () => [[0, "Automatic"], [256, "256 pixels"], [512, "512 pixels"], [1024, "1024 pixels"]]},
  );
};
V.describeScene = () => {
  V.describeSource();
  V.registerView();
  V.registerPicture();
};
V.start.push(() => V.setTool("light"));

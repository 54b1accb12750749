// The pass graph: the single source of the viewer's protocol.
//
// All scripts run in one strict function and share the object V:
//   V.glsl[chunk]           text of GLSL pieces (`//@chunk name` in glsl/*.glsl)
//   V.scene                 what was packed: {mesh, textures, tables, params, presets, facts,
//                           provenance, left_out, added}
//   V.params                the parameters now (starts as a copy of V.scene.params over
//                           V.defaults); flat JSON values, one level of objects (weights: {...})
//   V.defaults              each script adds its own parameters with Object.assign
//   V.passes.push(pass)     see below
//   V.start.push(fn)        called once when the scene is loaded, before the first frame
//   V.changed.push(fn)      called after each change of parameters, fn(params)
//
// A pass is {
//   name, after: [names of passes],
//   key: p => string        what it depends on besides the passes before it and the scene,
//   targets: p => ({buffer: {format, size: [w, h], space: "uv" | "screen", filter, mip}}),
//   depth: bool | name      true: it has a depth buffer; name of a pass before it: its depths hide
//                           what is behind, and ctx.full draws where that pass drew alone,
//   enabled: p => bool      false: it is left out, and its buffers read as zero,
//   demanded: bool          true: drawn only where its buffer is read or viewed,
//   draw: ctx => {},        ctx = {p, side, size: [w, h], mesh(program, uniforms),
//                           full(program, uniforms), clear(r, g, b, a), bind(buffer-list)}
//   cost: p => ({taps, bytes})   texture reads and bytes written a frame,
// }
// A pass is drawn again only where its key, its size, or a pass before it changed; that is counted
// in V.statistics. Outputs of the fragment shader are numbered as the targets are listed.
//
// The surface (V.surface in shading.js) and the scattering profile (V.profiles, V.profileName in
// scattering.js) are joints where other scripts add slopes, normals, specular models, widths.
// V.start functions may add passes and set joints; V.merged, V.set and V.readNow are in main.js.
//
// Several heads: V.headSide(side, p, i) and V.headParams(p, i) (crowd.js) are the buffers and
// parameters of head i; the passes that the surface reads are drawn for each.
//
// In GLSL these names are declared by the program builder where they are used:
//   p_name                  parameter (number or boolean: float; array of 2 to 4: vec)
//   sample_name(vec2 uv)    scene texture, in its own unit (layers: sample_name(vec3(uv, layer)))
//   table_name(vec2 at)     table of shape (rows, columns, channels): at.x along columns, at.y
//                           along rows, 0 and 1 at the outer edges of the outer texels
//   buffer_name(vec2 uv)    buffer of another pass, texel_name(ivec2 at) without filtering
//   HAS_name                defined where the scene has the texture or table `name`, or some pass
//                           makes the buffer
// Textures and UV buffers have row 0 at v = 0 in GL; V.read flips so that row 0 is the top.
V.passes = [];
V.start = [];
V.changed = [];
V.defaults = {};
V.statistics = {draws: 0, skipped: 0, passes: {}};

// Passes in an order in which each comes behind those it names.
V.ordered = () => {
  if (V.orderedOf === V.passes.length) return V.order;
  const byName = new Map(V.passes.map(pass => [pass.name, pass]));
  const state = new Map();
  const order = [];
  const visit = pass => {
    if (state.get(pass.name) === 2) return;
    if (state.get(pass.name) === 1) throw new Error(`pass ${pass.name} comes after itself`);
    state.set(pass.name, 1);
    for (const name of pass.after) {
      if (byName.has(name)) visit(byName.get(name));
    }
    state.set(pass.name, 2);
    order.push(pass);
  };
  V.passes.forEach(visit);
  V.order = order;
  V.orderedOf = V.passes.length;
  return order;
};

// One side of an A/B comparison keeps its own buffers and caches.
V.newSide = () => ({buffers: new Map(), targets: new Map(), keys: new Map(), versions: new Map()});

// Draw what changed, of other heads first. `demand` holds names of buffers that are wanted though
// nobody shows them.
V.drawGraph = (side, p, demand = new Set()) => {
  V.drawCrowd(side, p);
  V.drawPasses(side, p, demand);
};
V.drawPasses = (side, p, demand, only = null) => {
  const wanted = V.wantedPasses(p, demand);
  for (const pass of V.ordered()) {
    if (only && !only.has(pass.name)) continue;
    const record = (V.statistics.passes[pass.name] ??= {draws: 0, skipped: 0});
    if (!wanted.has(pass.name)) {
      V.dropPass(side, pass);
      continue;
    }
    const shapes = pass.targets(p);
    const before = pass.after.map(name => `${name}:${side.versions.get(name) ?? 0}`).join(",");
    const key = `${pass.key(p)}|${JSON.stringify(shapes)}|${before}`;
    if (side.keys.get(pass.name) === key) {
      record.skipped += 1;
      V.statistics.skipped += 1;
      continue;
    }
    const target = V.target(side, pass, shapes);
    V.profile?.begin(pass);
    V.bindTarget(target);
    pass.draw(V.context(side, p, target));
    V.finishTarget(target);
    V.profile?.end(pass);
    side.keys.set(pass.name, key);
    side.versions.set(pass.name, ++V.version);
    record.draws += 1;
    V.statistics.draws += 1;
  }
};
V.version = 0;

V.enabled = (pass, p) => !pass.enabled || pass.enabled(p);

// Names of the passes that a frame needs: those enabled, without demanded ones nobody asks for.
V.wantedPasses = (p, demand) => {
  const wanted = new Set();
  const byName = new Map(V.passes.map(pass => [pass.name, pass]));
  const want = pass => {
    if (!pass || wanted.has(pass.name) || !V.enabled(pass, p)) return;
    wanted.add(pass.name);
    pass.after.forEach(name => want(byName.get(name)));
  };
  for (const pass of V.passes) {
    if (!V.enabled(pass, p)) continue;
    if (pass.demanded && !Object.keys(pass.targets(p)).some(name => demand.has(name))) continue;
    want(pass);
  }
  return wanted;
};

V.dropPass = (side, pass) => {
  if (!side.keys.has(pass.name) && !side.targets.has(pass.name)) return;
  V.freeTarget(side, pass);
  side.keys.delete(pass.name);
  side.versions.set(pass.name, ++V.version);
};

V.bufferNames = p => V.passes.filter(pass => V.enabled(pass, p))
  .flatMap(pass => Object.keys(pass.targets(p)));

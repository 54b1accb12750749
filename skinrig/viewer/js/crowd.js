// Several heads, each with its own expression: blood, wrinkles, strain, shadow and mesh are drawn
// per head, and again only if its weights changed; screen passes are shared.
//
// The controls change the middle head. Of a gallery, the others are the other people, with the same
// weights. Else the others add the table's emotions and global conditions to
// its weights. Microstructure is drawn at the center of the canvas; on the other heads all of its
// slopes are in the roughness.
Object.assign(V.defaults, {crowd: 1, gallery: 0});
V.CROWD = ["happiness", "anger and surprise", "sad smile", "exercise", "surprise", "alcohol"];

V.galleryOf = p => p.heads > 1 && p.gallery > 0.5;
V.crowdOf = p => p.heads > 1 && (p.crowd > 0.5 || V.galleryOf(p));
V.middleHead = p => Math.floor(0.5 * (p.heads - 1));

// Weights that head i adds to those of the controls, with their label.
V.crowdOffset = (p, i) => {
  const middle = V.middleHead(p);
  if (!V.crowdOf(p) || V.galleryOf(p) || i === middle) return {name: "", weights: {}};
  const presets = V.scene.presets ?? {};
  const names = [...V.CROWD.filter(name => name in presets),
    ...Object.keys(presets).filter(name => name !== "neutral" && !V.CROWD.includes(name))];
  if (!names.length) return {name: "", weights: {}};
  const name = names[(i - (i > middle)) % names.length];
  return {name, weights: presets[name].weights ?? {}};
};

// Parameters of head i; the middle head has the common ones.
V.headParams = (p, i) => {
  if (!V.crowdOf(p) || i === V.middleHead(p)) return p;
  const count = V.scene.facts.people?.length ?? 1;
  const person = V.galleryOf(p) ? (p.person + i - V.middleHead(p) + count) % count : p.person;
  const weights = {...p.weights};
  for (const [name, weight] of Object.entries(V.crowdOffset(p, i).weights)) {
    weights[name] = Math.min((weights[name] ?? 0) + weight, 1.5);
  }
  const [full] = p.microstructure_variance;
  return {...p, heads: 1, person, weights, microstructure_variance: [full, 0],
    microstructure_place: [...p.microstructure_place.slice(0, 3), 0]};
};

V.headSide = (side, p, i) => !V.crowdOf(p) || i === V.middleHead(p) ? side
  : ((side.crowd ??= [])[i] ??= V.newSide());

// Passes per head: those that the surface reads, in texture space or from the light.
V.ownPasses = () => {
  const byName = new Map(V.passes.map(pass => [pass.name, pass]));
  const own = new Set();
  const add = name => {
    if (own.has(name) || !byName.has(name)) return;
    own.add(name);
    byName.get(name).after.forEach(add);
  };
  V.surface.after.forEach(add);
  return own;
};

// Heads other than the middle one.
V.otherHeads = p => V.crowdOf(p)
  ? Array.from({length: p.heads}, (_, i) => i).filter(i => i !== V.middleHead(p)) : [];

V.drawCrowd = (side, p) => {
  const others = V.otherHeads(p);
  (side.crowd ?? []).forEach((one, i) => {
    if (!one || others.includes(i)) return;
    V.passes.forEach(pass => V.dropPass(one, pass));
    if (one.mesh) {
      one.mesh.buffers.forEach(buffer => V.gl.deleteBuffer(buffer));
      V.gl.deleteVertexArray(one.mesh.vao);
    }
    delete side.crowd[i];
  });
  if (!others.length) return;
  const own = V.ownPasses();
  for (const i of others) V.drawPasses(V.headSide(side, p, i), V.headParams(p, i), new Set(), own);
};

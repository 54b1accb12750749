// Costs of a frame: passes, texture reads, bytes written, milliseconds.
//
// On a GPU, times are from timer queries. With software rendering, each pass is waited for, and
// fractions are more meaningful than milliseconds.
V.software = () => {
  if (V.softwareKnown === undefined) {
    const info = V.gl.getExtension("WEBGL_debug_renderer_info");
    V.renderer = info ? V.gl.getParameter(info.UNMASKED_RENDERER_WEBGL) : V.gl.getParameter(V.gl.RENDERER);
    V.softwareKnown = /swiftshader|llvmpipe|softpipe|software|basic render/i.test(V.renderer);
  }
  return V.softwareKnown;
};

V.passTimer = () => {
  const gl = V.gl;
  const query = V.software() ? null : gl.getExtension("EXT_disjoint_timer_query_webgl2");
  const spent = new Map();
  const open = [];
  let begun = 0;
  return {
    spent, open, query,
    begin: () => {
      if (query) {
        const handle = gl.createQuery();
        gl.beginQuery(query.TIME_ELAPSED_EXT, handle);
        open.push([null, handle]);
      } else {
        V.finish();
        begun = performance.now();
      }
    },
    end: pass => {
      if (query) {
        gl.endQuery(query.TIME_ELAPSED_EXT);
        open.at(-1)[0] = pass.name;
      } else {
        V.finish();
        spent.set(pass.name, (spent.get(pass.name) ?? 0) + performance.now() - begun);
      }
    },
  };
};

// Results of timer queries arrive some frames later.
V.collect = async timer => {
  for (const [name, handle] of timer.open) {
    for (let wait = 0; wait < 200 && !V.gl.getQueryParameter(handle, V.gl.QUERY_RESULT_AVAILABLE); wait++) {
      await new Promise(done => setTimeout(done, 5));
    }
    const disjoint = V.gl.getParameter(timer.query.GPU_DISJOINT_EXT);
    const there = V.gl.getQueryParameter(handle, V.gl.QUERY_RESULT_AVAILABLE);
    if (!disjoint && there) {
      timer.spent.set(name, (timer.spent.get(name) ?? 0) +
        V.gl.getQueryParameter(handle, V.gl.QUERY_RESULT) / 1e6);
    }
    V.gl.deleteQuery(handle);
  }
};

// Invalidate all passes, so that the next frame draws them.
V.forgetDrawn = side => {
  side.keys.clear();
  side.crowd?.forEach(one => one.keys.clear());
};

// Texture reads and bytes of a pass, summed over the heads that draw it.
V.costOf = (pass, p) => {
  const {taps, bytes} = pass.cost ? pass.cost(p) : {taps: 0, bytes: 0};
  if (!V.ownPasses().has(pass.name)) return {taps, bytes};
  return V.otherHeads(p).reduce((sum, i) => {
    const own = V.headParams(p, i);
    if (!V.enabled(pass, own)) return sum;
    const more = pass.cost ? pass.cost(own) : {taps: 0, bytes: 0};
    return {taps: sum.taps + more.taps, bytes: sum.bytes + more.bytes};
  }, {taps, bytes});
};

// Costs of n frames with all passes drawn, and of a frame in which only the light moved.
V.measure = async (n = 3) => {
  V.drawFrame();
  V.finish();
  const timer = V.passTimer();
  const frames = [];
  V.profile = timer;
  for (let i = 0; i < n; i++) {
    V.forgetDrawn(V.sideA);
    const begun = performance.now();
    V.drawFrame();
    V.finish();
    frames.push(performance.now() - begun);
  }
  V.profile = null;
  await V.collect(timer);
  const azimuth = V.params.light_azimuth_deg;
  const before = V.statistics.draws;
  V.params = {...V.params, light_azimuth_deg: azimuth + 1};
  const begun = performance.now();
  V.drawFrame();
  V.finish();
  const lightMs = performance.now() - begun;
  const lightPasses = V.statistics.draws - before;
  V.params = {...V.params, light_azimuth_deg: azimuth};
  V.drawFrame();
  const rows = V.ordered().filter(pass => V.sideA.targets.has(pass.name)).map(pass => {
    const {taps, bytes} = V.costOf(pass, V.params);
    const buffers = Object.values(pass.targets(V.params));
    return {name: pass.name, size: buffers[0]?.size ?? V.screen(), taps, bytes,
      ms: (timer.spent.get(pass.name) ?? 0) / n};
  });
  const sum = field => rows.reduce((total, row) => total + row[field], 0);
  return {rows, passes: rows.length, taps: sum("taps"), bytes: sum("bytes"), ms: sum("ms"),
    frame_ms: Math.min(...frames), light_ms: lightMs, light_passes: lightPasses, heads: V.params.heads,
    size: V.screen(), software: V.software(), renderer: V.renderer};
};

V.thousands = value => value >= 1e6 ? `${(value / 1e6).toFixed(1)} M` : value >= 1e3
  ? `${(value / 1e3).toFixed(0)} k` : String(Math.round(value));

V.buildCosts = box => {
  const button = V.element("button", {type: "button"}, "Measure a frame");
  const five = V.element("button", {type: "button"}, "Measure five heads");
  const result = V.element("div", {className: "scroll", tabIndex: 0, role: "region", "aria-label": "Costs by pass",
    hidden: true});
  const note = V.element("p", {className: "help"});
  const run = async heads => {
    button.disabled = five.disabled = true;
    const kept = V.params.heads;
    V.set({heads}, true);
    const found = await V.measure(V.software() ? 1 : 5);
    V.set({heads: kept}, true);
    V.showCosts(found, result, note);
    button.disabled = five.disabled = false;
  };
  button.onclick = () => run(V.params.heads);
  five.onclick = () => run(5);
  box.append(V.element("div", {className: "buttons"}, button, ...(V.scene.page === "head" ? [five] : [])), note, result);
};

V.showCosts = (found, result, note) => {
  const head = ["Pass", "Size", "Reads", "MB", "ms", "Fraction"];
  const row = (cells, tag = "td") => V.element("tr", {}, ...cells.map((cell, i) =>
    V.element(tag, i ? {className: "n"} : {}, cell)));
  const share = ms => found.ms > 0 ? `${Math.round(100 * ms / found.ms)} %` : "–";
  const lines = found.rows.map(one => row([V.words(one.name), one.size.join(" × "), V.thousands(one.taps),
    (one.bytes / 1e6).toFixed(1), one.ms.toFixed(2), share(one.ms)]));
  const total = row([`All ${found.passes}`, found.size.join(" × "), V.thousands(found.taps),
    (found.bytes / 1e6).toFixed(1), found.ms.toFixed(2), "100 %"], "th");
  const heading = row(head, "th");
  for (const cell of heading.children) cell.setAttribute("scope", "col");
  result.replaceChildren(V.element("table", {},
    V.element("caption", {}, `${V.scene.page !== "head" ? "The picture" : found.heads === 1 ? "One head" : `${found.heads} heads`}, all passes redrawn`),
    V.element("thead", {}, heading), V.element("tbody", {}, ...lines, total)));
  result.hidden = false;
  note.textContent = `${found.software ? "Software rendering: fractions are meaningful, milliseconds are not. " : ""}` +
    `A full frame takes ${found.frame_ms.toFixed(1)} ms. After a change of light, ${found.light_passes} passes ` +
    `are redrawn in ${found.light_ms.toFixed(1)} ms. ${V.renderer}.`;
  V.announce(`${found.passes} passes, ${V.thousands(found.taps)} texture reads, ${(found.bytes / 1e6).toFixed(1)} megabytes, ` +
    `${found.frame_ms.toFixed(0)} milliseconds`);
};

// Time of each frame, in the corner of the canvas.
V.start.push(() => {
  const draw = V.drawFrame;
  V.drawFrame = () => {
    const begun = performance.now();
    const before = V.statistics.draws;
    draw();
    if (V.software()) V.finish();
    const took = performance.now() - begun;
    document.getElementById("time").textContent =
      `${took.toFixed(took < 10 ? 1 : 0)} ms · ${V.statistics.draws - before} passes · ${V.screen().join(" × ")}`;
  };
  V.controls.push({group: "cost", kind: "own", build: V.buildCosts});
});

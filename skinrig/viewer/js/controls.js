// The controls: one declaration per parameter, from which the panel is built.
//
//   V.groups    [id, title, sentence, open]
//   V.controls  {group, kind, path, label, help, when, ...}: a control of the parameter at `path`
//     kind "range"   min, max, step, show(value) => text
//     kind "toggle"
//     kind "choice"  options() => [[value, label], ...]
//     kind "own"     build(box) => update(p) or nothing
//   V.announce(text) writes to the live region; V.afterStart.push(fn) runs after the first frame.
V.groups = [
  ["view", "View", "The final image, or a buffer of one render pass.", true],
  ["people", "People", "Blood and melanin of several people on one head.", true],
  ["expression", "Expression", "Weights of the blend shapes; blood, wrinkles and strain follow.", true],
  ["blood", "Blood and melanin",
    "Blood is blended from maps of scale and bias. A table converts blood and melanin to color.", true],
  ["reflection", "Reflection", "Specular reflection of the skin surface.", true],
  ["scattering", "Scattering", "Subsurface scattering of light in the skin.", false],
  ["traits", "Traits", "Principal differences between the faces of a population.", false],
  ["relief", "Surface topography", "Pores, wrinkles and microstructure below the resolution of the mesh.", false],
  ["light", "Light and tone", "Key, fill and rim light, environment, and tone mapping.", true],
  ["cost", "Resolution and cost", "Passes, texture reads, bytes and time per frame.", false],
  ["about", "About this face", "Provenance, errors, and omitted parts.", false],
];
V.controls = [];
V.afterStart = [];

V.signed = value => (value > 0 ? "+" : value < 0 ? "−" : "") + Math.abs(value).toFixed(2);
V.plain = value => String(Number(value.toPrecision(3)));
V.percent = value => `${Math.round(100 * value)} %`;
V.degrees = value => `${Math.round(value)}°`;
V.words = name => name.replace(/_/g, " ").replace(/([a-z])([A-Z])/g, (_, a, b) => `${a} ${b.toLowerCase()}`);
V.capital = text => text[0].toUpperCase() + text.slice(1);

V.at = (p, path) => path.reduce((value, name) => value?.[name], p);
V.changeOf = (path, value) => path.length === 1 ? {[path[0]]: value}
  : {[path[0]]: V.changeOf(path.slice(1), value)};
V.element = (tag, properties = {}, ...children) => {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name.includes("-") || name === "role" || name === "for") made.setAttribute(name, value);
    else made[name] = value;
  }
  made.append(...children);
  return made;
};

V.announce = text => {
  clearTimeout(V.announceTimer);
  V.announceTimer = setTimeout(() => { document.getElementById("live").textContent = text; }, 350);
};

// Build the elements of a control, and its update from the parameters.
V.buildControl = (control, number) => {
  const id = `c${number}`;
  const help = control.help ? V.element("p", {className: "help", id: `${id}h`}, control.help) : null;
  const described = help ? {"aria-describedby": `${id}h`} : {};
  const change = value => V.set(control.change ? control.change(value)
    : V.changeOf(control.path, value));
  const value = p => control.value ? control.value(p) : V.at(p, control.path);
  if (control.kind === "toggle") {
    const input = V.element("input", {type: "checkbox", id, ...described});
    const label = V.element("label", {className: "toggle", for: id}, input, control.label);
    const kept = on => typeof V.at(V.initial, control.path) === "number" ? Number(on) : on;
    input.onchange = () => { change(kept(input.checked)); V.announce(`${control.label}: ${input.checked ? "on" : "off"}`); };
    return {box: V.element("div", {className: "control"}, label, ...(help ? [help] : [])), input,
      update: p => { input.checked = Boolean(value(p)); }};
  }
  const label = V.element("label", {for: id}, control.label);
  if (control.kind === "choice") {
    const input = V.element("select", {id, ...described});
    const options = () => input.replaceChildren(...control.options().map(([key, text]) =>
      V.element("option", {value: JSON.stringify(key)}, text)));
    options();
    input.onfocus = () => { const kept = input.value; options(); input.value = kept; };
    input.onchange = () => {
      change(JSON.parse(input.value));
      V.announce(`${control.label}: ${input.selectedOptions[0].textContent}`);
    };
    return {box: V.element("div", {className: "control"}, label, input, ...(help ? [help] : [])),
      input, options, update: p => { input.value = JSON.stringify(value(p)); }};
  }
  const show = control.show ?? V.plain;
  const input = V.element("input", {type: "range", id, min: control.min, max: control.max,
    step: control.step ?? 0.01, ...described});
  const output = V.element("output", {for: id, "aria-live": "off"});
  const paint = () => {
    const now = Number(input.value);
    const share = x => 100 * (x - control.min) / (control.max - control.min);
    const zero = share(Math.min(control.max, Math.max(control.min, control.zero ?? 0)));
    input.style.setProperty("--from", `${Math.min(zero, share(now))}%`);
    input.style.setProperty("--to", `${Math.max(zero, share(now))}%`);
    output.textContent = show(now);
    input.setAttribute("aria-valuetext", show(now));
  };
  input.oninput = () => { change(Number(input.value)); paint(); };
  const top = V.element("div", {className: "top"}, label, output);
  return {box: V.element("div", {className: "control"}, top, input, ...(help ? [help] : [])), input,
    update: p => { input.value = value(p) ?? 0; paint(); }};
};

// Add groups and controls to the panel; those whose assets are missing are omitted.
V.buildPanel = () => {
  const panel = document.getElementById("panel");
  V.updates = [];
  let number = 0;
  for (const [id, title, lead, open] of V.groups) {
    const mine = V.controls.filter(c => c.group === id && (c.when ? c.when() : true)
      && (!c.path || c.path[0] in V.params));
    if (!mine.length) continue;
    const changed = V.element("span", {className: "changed"});
    const box = V.element("div", {className: "group"}, V.element("p", {className: "lead"}, lead));
    const details = V.element("details", {id: `group-${id}`, open},
      V.element("summary", {}, V.element("h2", {}, title), changed), box);
    for (const control of mine) {
      if (control.kind === "own") {
        const inner = V.element("div", {className: "control"});
        box.append(inner);
        const update = control.build(inner);
        if (update) V.updates.push(update);
        continue;
      }
      const made = V.buildControl(control, number++);
      box.append(made.box);
      control.made = made;
      V.updates.push(p => {
        made.update(p);
        const off = Boolean(control.off?.(p));
        made.input.disabled = off;
        made.box.classList.toggle("off", off);
      });
    }
    V.updates.push(p => {
      const count = mine.filter(c => c.path
        && JSON.stringify(V.at(p, c.path) ?? 0) !== JSON.stringify(V.at(V.initial, c.path) ?? 0)).length;
      changed.textContent = count ? `${count} changed` : "";
    });
    panel.append(details);
  }
};

V.updateControls = p => V.updates?.forEach(update => update(p));

// Parameters of the view, not of the face: both sides of a comparison share them.
V.SHARED = ["camera_yaw_deg", "camera_pitch_deg", "camera_distance_mm", "camera_fov_deg",
  "camera_target_mm", "light_azimuth_deg", "light_elevation_deg", "light_intensity", "ambient", "fill", "rim",
  "environment", "environment_intensity", "environment_azimuth_deg", "timeline_s", "difference_gain",
  "exposure", "background", "view", "view_low", "view_high", "split", "compare", "heads", "crowd", "gallery",
  "shadows", "shadow_px", "shadow_softness_mm"];

// Internal parameters of passes.
V.transient = name => /^(microstructure_(place|side_px|virtual_px|margin_px|variance|split_px)|detail_wrinkles)$/.test(name);

V.faceOf = p => JSON.parse(JSON.stringify(Object.fromEntries(
  Object.entries(p).filter(([name]) => !V.SHARED.includes(name) && !V.transient(name)))));

// Reset to the initial parameters; weights and traits added later are set to 0.
V.reset = () => {
  V.playing = false;
  const back = JSON.parse(JSON.stringify(V.initial));
  for (const name of ["weights", "traits"]) {
    for (const key of Object.keys(V.params[name] ?? {})) back[name][key] ??= 0;
  }
  for (const name of Object.keys(back)) if (V.transient(name)) delete back[name];
  V.set(back);
  V.announce("All controls are reset.");
};

V.start.push(() => {
  V.initial = JSON.parse(JSON.stringify(V.params));
  for (const name of Object.keys(V.scene.mesh.shapes)) V.initial.weights[name] ??= 0;
  V.params = V.merged(V.merged({}, V.initial), V.stateOfAddress());
  V.fitCanvas();
  V.describeScene();
  V.buildPanel();
  V.updateControls(V.params);
  V.changed.push(p => { V.updateControls(p); V.rememberState(p); });
  // some buffers exist only after all passes are registered
  window.viewer.ready.then(() => {
    V.controls.forEach(control => control.made?.options?.());
    V.updateControls(V.params);
    V.afterStart.forEach(fn => fn());
  });
  document.getElementById("reset").onclick = V.reset;
  document.getElementById("share").onclick = async () => {
    V.rememberNow(V.params);
    try {
      await navigator.clipboard.writeText(location.href);
      V.announce("Link with all settings copied.");
    } catch {
      V.announce("Copy the link with all settings from the address bar.");
    }
  };
});
